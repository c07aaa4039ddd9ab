"""Recordings from files, in the order of their time."""

from collections.abc import Sequence
from pathlib import Path

from replay.errors import RecordingError
from replay.mcap_io import read_mcap
from replay.recording import Recording


def load(paths: Sequence[Path | str]) -> list[Recording]:
    """Return the recordings of several MCAP files, the earliest first; RecordingError names a file that is wrong."""
    if not paths:
        raise RecordingError("no recording given; name at least one MCAP file")
    recordings = [read_mcap(path) for path in paths]
    return sorted(recordings, key=lambda recording: int(recording.time_ns[0]))
