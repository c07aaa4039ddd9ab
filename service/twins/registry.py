"""The registered twins in memory, so that no request waits for the database to learn which channels it may use."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import BadField, short
from service.store.errors import Missing
from service.store.twins import Twin
from twin_core.network.plausible import plausible_range
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.quality.sentinels import marked
from twin_core.units import to_si


@dataclass(frozen=True)
class Entry:
    """What every route needs to know about a twin; none of it changes until its specification does."""

    key: int
    name: str
    channels: tuple[str, ...]
    specification: dict[str, Any]
    revision: int = 1

    @cached_property
    def spec(self) -> TwinSpec:
        """The validated specification."""
        return load_spec(self.specification)

    def know(self, spec: TwinSpec) -> None:
        """Take over a specification that was just validated: validating thousands of nodes takes a second."""
        self.__dict__["spec"] = spec

    @cached_property
    def sensors(self) -> tuple[str, ...]:
        """Every temperature channel that reads a node, in the order of the nodes."""
        return self.spec.sensors

    @cached_property
    def sensor_names(self) -> frozenset[str]:
        """The same without an order, and without validating the specification, which of thousands takes seconds."""
        declared = (node.get("sensor") or [] for node in self.specification["nodes"])
        return frozenset(name for one in declared for name in ([one] if isinstance(one, str) else one))

    @cached_property
    def limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Least and largest plausible value of each channel in its own unit, (n_channels, 1) each."""
        ranges = [plausible_range(self.spec.channels[name]) for name in self.channels]
        low, high = np.array(ranges, dtype=np.float64).T
        return low[:, None], high[:, None]

    def refuse_implausible(self, values: NDArray[np.float64], first: int = 0, prefix: str = "values.") -> None:
        """Refuse what no instrument reads (422 naming the value), since a sample that is stored stays.

        Markers of missing samples (-999, 0 K) are stored as they came: whoever reads them later masks them.

        Parameters
        ----------
        values : (n_rows, n_times)
            Of the channels from the position ``first`` on.
        """
        rows = slice(first, first + values.shape[0])
        low, high = (limit[rows] for limit in self.limits)
        wrong = (values < low) | (values > high)  # NaN compares as neither
        if not wrong.any():
            return
        for row in np.flatnonzero(wrong.any(axis=1)).tolist():
            unit = self.units[self.channels[first + row]]
            wrong[row] &= ~marked(to_si(values[row], unit), unit)
        if wrong.any():
            row, column = (int(i) for i in np.argwhere(wrong)[0])
            name = self.channels[first + row]
            limits = f"{low[row, 0]:g} to {high[row, 0]:g} {self.units[name] or ''}".strip()
            reason = f"no instrument reads {values[row, column]:g}; plausible is {limits}"
            raise BadField(f"{prefix}{name}[{column}]", reason)

    @cached_property
    def units(self) -> dict[str, str | None]:
        """Channel -> unit, in the order of the channels."""
        return {name: self.specification["channels"][name].get("unit") for name in self.channels}


class Registry:
    """Every registered twin by its name."""

    def __init__(self, twins: Iterable[Twin]) -> None:
        """Start with what the store holds."""
        self._entries: dict[str, Entry] = {}
        for twin in twins:
            self.add(twin)

    def add(self, twin: Twin) -> Entry:
        """Take in a twin and return its entry; one of the same name that was deleted since gives way."""
        known = self._entries.get(twin.name)
        return self.replace(twin) if known is None or known.key != twin.key else known

    def replace(self, twin: Twin) -> Entry:
        """Take in a twin whose specification has changed."""
        self._entries[twin.name] = _entry(twin)
        return self._entries[twin.name]

    def remove(self, name: str) -> None:
        """Forget a twin."""
        self._entries.pop(name, None)

    def find(self, name: str) -> Entry | None:
        """Return one twin, None if there is none of that name."""
        return self._entries.get(name)

    def get(self, name: str) -> Entry:
        """Return one twin; Missing if there is none of that name."""
        try:
            return self._entries[name]
        except KeyError:
            raise Missing(f"no twin '{short(name)}' is registered") from None

    def __iter__(self) -> Iterator[Entry]:
        """Iterate over the twins."""
        return iter(list(self._entries.values()))


def _entry(twin: Twin) -> Entry:
    return Entry(twin.key, twin.name, twin.channels, twin.specification, twin.revision)
