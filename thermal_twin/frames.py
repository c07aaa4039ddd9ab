"""Data frames and records: an index of instants or seconds, columns in the channels' own units."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import pandas as pd

import twin_core.telemetry
from twin_core.errors import TelemetryError
from twin_core.network.screened import screened
from twin_core.network.spec import TwinSpec
from twin_core.units import from_si, to_si


@dataclass(frozen=True, repr=False)
class Record(twin_core.telemetry.Record):
    """A record that knows its channels' own units, and so the way to a data frame and back.

    Attributes
    ----------
    units : channel name -> unit
        As the specification declares them; a channel without one stays as it is.
    """

    units: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, record: twin_core.telemetry.Record, spec: TwinSpec) -> Self:
        """Return a record of the framework as one that knows the units that a specification declares."""
        units = {name: channel.unit for name, channel in spec.channels.items() if channel.unit is not None}
        return cls(record.time_s, record.values, record.epoch_ns, record.name, record.notices, record.flaws, units)

    @classmethod
    def from_dataframe(
        cls, frame: pd.DataFrame, spec: TwinSpec, *, name: str = "data frame", masking: bool = True
    ) -> Self:
        """Return a data frame as a record.

        Parameters
        ----------
        frame
            One column per channel in the channel's unit; NaN is a missing sample. The index tells the time: instants (without a
            zone they are UTC), or numbers, which are seconds; or a column ``time`` or ``time_s`` does.
        spec
            Declares channels and units. Columns that it does not declare are left out, which a notice of the record says.
        name
            What messages call the record.
        masking
            Leave out samples that cannot be readings.

        Raises
        ------
        TelemetryError
            If the index is no time, a declared channel is missing, or a column holds no numbers.
        """
        table = frame
        for column in ("time", "time_s"):
            if column in table.columns:
                table = table.set_index(column)
        if isinstance(table.index, pd.MultiIndex):
            raise TelemetryError(f"{name}: both 'time' and 'time_s' are columns; give one")
        time_s, epoch_ns = _clock(table.index, name)
        order = np.argsort(time_s, kind="stable")
        values, ignored = {}, []
        for column in table.columns:
            channel = spec.channels.get(str(column))
            if channel is None:
                ignored.append(str(column))
                continue
            try:
                numbers = pd.to_numeric(table[column]).to_numpy(dtype=np.float64, na_value=np.nan)
            except (ValueError, TypeError) as error:
                raise TelemetryError(f"{name}: column '{column}' holds what is no number ({error})") from error
            values[str(column)] = to_si(numbers, channel.unit)[order]
        missing = [channel for channel in spec.used_channels if channel not in values]
        if missing:
            raise TelemetryError(
                f"{name}: channel '{missing[0]}' is missing; the columns are {', '.join(map(str, table.columns))}"
            )
        notices = (f"{name}: ignored columns {', '.join(ignored)}",) if ignored else ()
        record = twin_core.telemetry.Record(time_s[order], values, epoch_ns, name, notices)
        return cls.of(screened(spec, record) if masking else record, spec)

    def to_dataframe(self) -> pd.DataFrame:
        """Return the record as a data frame in the channels' own units, indexed by instant (UTC) or by seconds."""
        columns = {name: from_si(column, self.units.get(name)) for name, column in self.values.items()}
        return pd.DataFrame(columns, index=index_of(self, self.time_s))


def _clock(index: "pd.Index[Any]", name: str) -> tuple[np.ndarray, int | None]:
    """Return seconds, and the unix nanoseconds at which they begin; None where the index counts seconds itself."""
    if index.dtype == object or isinstance(index.dtype, pd.StringDtype):
        try:
            index = pd.DatetimeIndex(pd.to_datetime(index, utc=True, format="ISO8601"))
        except (ValueError, TypeError) as error:
            told = str(error).partition(". ")[0]
            raise TelemetryError(f"{name}: its index is neither instants nor seconds ({told})") from error
    if isinstance(index, pd.DatetimeIndex):
        if index.hasnans:
            raise TelemetryError(f"{name}: an instant of its index is missing")
        utc = index.tz_localize("UTC") if index.tz is None else index.tz_convert("UTC")
        unix_ns = utc.as_unit("ns").asi8
        if unix_ns.size == 0:
            raise TelemetryError(f"{name}: holds no samples")
        return (unix_ns - unix_ns.min()) / 1e9, int(unix_ns.min())
    if isinstance(index, pd.TimedeltaIndex):
        return np.asarray(index.total_seconds(), dtype=np.float64), None
    if not pd.api.types.is_numeric_dtype(index.dtype):
        raise TelemetryError(f"{name}: its index is neither instants nor seconds")
    return index.to_numpy(dtype=np.float64), None


def index_of(record: twin_core.telemetry.Record, time_s: np.ndarray) -> "pd.Index[Any]":
    """Return times on a record's axis as an index: instants in UTC where it is dated, else seconds."""
    if record.epoch_ns is None:
        return pd.Index(time_s, name="time_s")
    unix_ns = record.epoch_ns + np.round(np.asarray(time_s, dtype=np.float64) * 1e9).astype(np.int64)
    return pd.DatetimeIndex(unix_ns, tz="UTC", name="time")
