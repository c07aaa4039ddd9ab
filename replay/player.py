"""The player: sends a recording to a service, in batches, at any rate."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from replay.clock import Clock, Pace
from replay.errors import ReplayError
from replay.missing import missing
from replay.recording import Recording
from service.client import ApiError, TwinClient, Unreachable

BATCH = 500
LATENCY_S = 0.25
"""Longest time for which a paced replay collects samples before it sends them."""


@dataclass(frozen=True)
class Tally:
    """How far a replay got, and what the service made of it."""

    total: int
    sent: int = 0
    accepted: int = 0
    duplicates: int = 0
    rejected: int = 0
    last_time: str | None = None
    quarantined: int = 0


def no_tally(tally: Tally) -> None:
    """Report nothing: the default of a replay."""


def play(
    recording: Recording,
    client: TwinClient,
    twin: str,
    *,
    rate: float | None = None,
    batch: int = BATCH,
    resume: bool = False,
    clock: Clock | None = None,
    progress: Callable[[Tally], None] = no_tally,
) -> Tally:
    """Send every sample, with columns named by channel, and return what became of them.

    Parameters
    ----------
    recording
        Its columns bear the names of the twin's channels.
    client
        Repeats what gets lost; a sample that arrives twice is recognised by the service.
    rate
        Recorded seconds per real second; None sends as fast as the service takes it.
    batch
        Most samples per request.
    resume
        Leave out the instants of which the service already holds every value.
    clock
        For tests.
    progress
        Called after each request.

    Raises
    ------
    ReplayError
        If the service refuses a request or stays out of reach.
    """
    try:
        rest = missing(recording, client, twin) if resume else recording
        return _send_all(rest, client, twin, Pace(rate, clock), _cuts(rest, rate, batch), progress)
    except (ApiError, Unreachable) as error:
        raise ReplayError(str(error)) from error


def _send_all(
    recording: Recording,
    client: TwinClient,
    twin: str,
    pace: Pace,
    cuts: Iterator[slice],
    progress: Callable[[Tally], None],
) -> Tally:
    tally = Tally(total=len(recording))
    for cut in cuts:
        part = recording.rows(cut)
        pace.wait_for(int(part.time_ns[-1]))
        report = client.ingest(twin, _times(part), _values(part))
        tally = Tally(
            tally.total,
            tally.sent + len(part),
            tally.accepted + report.accepted,
            tally.duplicates + report.duplicates,
            tally.rejected + len(report.rejected),
            report.last_time,
            tally.quarantined + len(report.quarantined),
        )
        progress(tally)
    return tally


def _cuts(recording: Recording, rate: float | None, batch: int) -> Iterator[slice]:
    """Yield slices of at most ``batch`` samples, none of which takes longer to collect than the latency allows."""
    start = 0
    while start < len(recording):
        stop = min(start + batch, len(recording))
        if rate is not None:
            latest_ns = int(recording.time_ns[start]) + int(LATENCY_S * rate * 1e9)
            due = int(np.searchsorted(recording.time_ns, latest_ns, side="right"))
            stop = max(start + 1, min(stop, due))
        yield slice(start, stop)
        start = stop


def _times(recording: Recording) -> list[str]:
    """Return RFC 3339 to the microsecond, rounded."""
    texts = np.datetime_as_string(recording.time_us.astype("datetime64[us]"), unit="us")
    return [f"{text}Z" for text in texts.tolist()]


def _values(recording: Recording) -> dict[str, list[float | None]]:
    return {
        name: [value if value == value else None for value in column.tolist()]
        for name, column in recording.columns.items()
    }
