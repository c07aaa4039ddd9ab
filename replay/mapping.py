"""Topics of a recording -> channels of a twin."""

from collections.abc import Iterable, Mapping

import numpy as np

from replay.errors import MappingError
from replay.recording import Recording

MOST_NAMED = 10
"""Topics that a message names."""


def map_topics(
    topics: Iterable[str],
    channels: Iterable[str],
    rename: Mapping[str, str] | None = None,
    *,
    ignore_others: bool = False,
) -> dict[str, str]:
    """Return which channel each topic feeds.

    With ``ignore_others`` topics that feed none are left out; otherwise they are refused, for a recording of something else
    may have some names in common with the twin.

    A topic named in ``rename`` feeds the channel given there. Any other feeds the channel of the same name, or else
    the one named by its last part: ``/bus/thermal/T_px`` and ``thermal.T_px`` both feed ``T_px``.

    Raises
    ------
    MappingError
        If ``rename`` names an unknown topic or channel, two topics feed one channel, nothing fits at all, or some topics feed
        no channel.
    """
    known, present = list(channels), list(topics)
    wanted = dict(rename or {})
    _check_rename(wanted, present, known)
    mapping: dict[str, str] = {}
    for topic in present:
        channel = wanted.get(topic) or _same_name(topic, known)
        if channel is None:
            continue
        rival = next((other for other, taken in mapping.items() if taken == channel), None)
        if rival is not None:
            raise MappingError(f"topics '{rival}' and '{topic}' both feed channel '{channel}'; rename one of them")
        mapping[topic] = channel
    if not mapping:
        raise MappingError(f"no topic ({', '.join(present)}) names a channel of the twin ({', '.join(known)})")
    own = {f"residual_{channel}" for channel in known}  # as twin record writes them
    others = [topic for topic in present if topic not in mapping and topic not in own]
    if others and not ignore_others:
        more = f" and {len(others) - MOST_NAMED} more" if len(others) > MOST_NAMED else ""
        raise MappingError(
            f"{len(others)} of {len(present)} topics feed no channel of the twin: {', '.join(others[:MOST_NAMED])}{more}; "
            "--map names the channel of a topic, --ignore-others leaves them out"
        )
    return mapping


def _check_rename(rename: Mapping[str, str], topics: list[str], channels: list[str]) -> None:
    for topic, channel in rename.items():
        if topic not in topics:
            raise MappingError(f"unknown topic '{topic}'; the recording has {', '.join(topics)}")
        if channel not in channels:
            raise MappingError(f"unknown channel '{channel}'; the twin has {', '.join(channels)}")


def _same_name(topic: str, channels: list[str]) -> str | None:
    if topic in channels:
        return topic
    bare = topic.strip("/")
    candidates = (bare, bare.rsplit("/", 1)[-1], bare.rsplit(".", 1)[-1], bare.rsplit("/", 1)[-1].split(".", 1)[0])
    return next((name for name in candidates if name in channels), None)


def apply_mapping(recording: Recording, mapping: Mapping[str, str]) -> Recording:
    """Return the recording with its columns named by channel, unmapped ones and instants without a value dropped."""
    columns = {channel: recording.columns[topic] for topic, channel in mapping.items()}
    units = {channel: recording.units[topic] for topic, channel in mapping.items() if topic in recording.units}
    seen = np.logical_or.reduce([~np.isnan(column) for column in columns.values()])
    columns = {channel: column[seen] for channel, column in columns.items()}
    return Recording(recording.time_ns[seen], columns, units, recording.metadata)
