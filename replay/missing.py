"""What a resumed replay still has to send: everything in a recording that the service does not hold."""

import numpy as np
from numpy.typing import NDArray

from replay.recording import Recording
from service.client import TwinClient

PAGE = 20_000
"""Most instants of a recording that are compared in one request."""

Archived = tuple[NDArray[np.int64], dict[str, NDArray[np.float64]]]


def missing(recording: Recording, client: TwinClient, twin: str) -> Recording:
    """Return the instants of which the service lacks a value, or holds another one and has yet to say so.

    Only the span that recording and archive share is read, page by page: what comes before or after is missing.
    """
    head = client.twin(twin)
    if head.first_time is None or head.last_time is None:
        return recording
    time_us = recording.time_us
    first = int(np.searchsorted(time_us, _us(head.first_time)))
    stop = int(np.searchsorted(time_us, _us(head.last_time), side="right"))
    held = np.zeros(len(recording), dtype=np.bool_)
    for start in range(first, stop, PAGE):
        page = slice(start, min(start + PAGE, stop))
        held[page] = _held(recording.rows(page), client, twin)
    return recording.rows(~held)


def _held(part: Recording, client: TwinClient, twin: str) -> NDArray[np.bool_]:
    """Return of which instants the service holds every value, (n_times,)."""
    time_us = part.time_us
    known_us, known = _archive(client, twin, list(part.columns), int(time_us[0]), int(time_us[-1]) + 1)
    if known_us.size == 0:
        return np.zeros(time_us.size, dtype=np.bool_)
    place = np.minimum(np.searchsorted(known_us, time_us), known_us.size - 1)
    held: NDArray[np.bool_] = known_us[place] == time_us
    for name, column in part.columns.items():
        held &= np.isnan(column) | (known[name][place] == column)
    return held


def _archive(client: TwinClient, twin: str, channels: list[str], start_us: int, stop_us: int) -> Archived:
    """Return every sample with start <= time < stop, in halves where the service would thin it out."""
    part = client.archive(twin, start=_text(start_us), stop=_text(stop_us), channels=channels)
    if part.downsampled and stop_us - start_us > 1:
        middle_us = (start_us + stop_us) // 2
        halves = [_archive(client, twin, channels, *span) for span in ((start_us, middle_us), (middle_us, stop_us))]
        times, columns = zip(*halves, strict=True)
        return np.concatenate(times), {name: np.concatenate([c[name] for c in columns]) for name in channels}
    values = {name: np.array(part.values[name], dtype=np.float64) for name in channels}
    return np.array([time.removesuffix("Z") for time in part.time], dtype="datetime64[us]").astype(np.int64), values


def _us(time: str) -> int:
    return int(np.datetime64(time.removesuffix("Z"), "us").astype(np.int64))


def _text(instant_us: int) -> str:
    return f"{np.datetime64(instant_us, 'us')}Z"
