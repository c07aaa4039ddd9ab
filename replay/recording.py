"""A recording: named columns on one strictly increasing axis of integer nanoseconds."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from replay.errors import RecordingError
from replay.wording import counted


@dataclass(frozen=True)
class Recording:
    """What a file of telemetry holds.

    Attributes
    ----------
    time_ns : (n_times,)
        Unix nanoseconds, strictly increasing.
    columns : name -> (n_times,)
        Values in the channel's own unit; NaN where the file has no message at that time.
    units : name -> unit
        As the file states them; a column without a stated unit is absent.
    metadata
        Free text pairs of the file.
    notices
        What of the file was left out.
    """

    time_ns: NDArray[np.int64]
    columns: Mapping[str, NDArray[np.float64]]
    units: Mapping[str, str] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)
    notices: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check axis and shapes; raise RecordingError naming the first offender."""
        if (np.diff(self.time_ns) <= 0).any():
            row = int(np.argmax(np.diff(self.time_ns) <= 0)) + 1
            raise RecordingError(f"row {row}: time does not increase; sort the samples and drop repeated ones")
        for name, column in self.columns.items():
            if column.shape != self.time_ns.shape:
                raise RecordingError(f"column '{name}' has {column.size} samples, the time axis {self.time_ns.size}")

    def __len__(self) -> int:
        """Return the number of instants."""
        return int(self.time_ns.size)

    @property
    def time_us(self) -> NDArray[np.int64]:
        """The axis in microseconds, rounded: what a service tells apart."""
        rounded: NDArray[np.int64] = (self.time_ns + 500) // 1000
        return rounded

    def rows(self, selection: slice | NDArray[np.bool_]) -> "Recording":
        """Return some of the instants; there may be none."""
        columns = {name: column[selection] for name, column in self.columns.items()}
        return Recording(self.time_ns[selection], columns, self.units, self.metadata, self.notices)


def align(series: Mapping[str, tuple[NDArray[np.int64], NDArray[np.float64]]]) -> Recording:
    """Put series with their own time axes on the union of these axes.

    Parameters
    ----------
    series : name -> ((n_samples,), (n_samples,))
        Nanoseconds and values in any order; of samples at the same nanosecond the first one stays, and the notices count
        the others.
    """
    axes = [times for times, _ in series.values()]
    time_ns = np.unique(np.concatenate(axes)) if axes else np.empty(0, dtype=np.int64)
    columns, same, differing = {}, 0, 0
    for name, (times, values) in series.items():
        distinct, first = np.unique(times, return_index=True)
        column = np.full(time_ns.size, np.nan)
        column[np.searchsorted(time_ns, distinct)] = values[first]
        columns[name] = column
        repeats = int(np.sum(values == column[np.searchsorted(time_ns, times)])) - distinct.size
        same, differing = same + repeats, differing + times.size - distinct.size - repeats
    return Recording(time_ns, columns, notices=tuple(_of_repeats(same, differing)))


def _of_repeats(same: int, differing: int) -> Iterator[str]:
    if same:
        yield f"{counted(same, *_REPEAT)} the instant and the value of an earlier one; dropped"
    if differing:
        yield f"{counted(differing, *_REPEAT)} the instant of an earlier one with another value; the first stays"


_REPEAT = ("sample repeats", "samples repeat")
