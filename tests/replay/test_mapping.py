"""Which topic feeds which channel."""

import pytest

from replay.errors import MappingError
from replay.mapping import map_topics

CHANNELS = ["T_px", "Q_px"]


@pytest.mark.parametrize("topic", ["T_px", "/T_px", "/bus/thermal/T_px", "/thermal.T_px", "/bus/T_px.reading"])
def test_last_part_of_a_topic_names_the_channel(topic: str) -> None:
    assert map_topics([topic, "/camera"], CHANNELS) == {topic: "T_px"}


def test_rename_goes_before_the_name() -> None:
    assert map_topics(["T_px", "a"], CHANNELS, {"a": "Q_px"}) == {"T_px": "T_px", "a": "Q_px"}


@pytest.mark.parametrize(
    ("topics", "rename", "reason"),
    [
        (["/camera"], {}, "no topic"),
        (["T_px", "/T_px"], {}, "both feed channel 'T_px'"),
        (["T_px"], {"x": "Q_px"}, "unknown topic 'x'"),
        (["T_px"], {"T_px": "Q"}, "unknown channel 'Q'"),
    ],
)
def test_wrong_mappings_are_named(topics: list[str], rename: dict[str, str], reason: str) -> None:
    with pytest.raises(MappingError, match=reason):
        map_topics(topics, CHANNELS, rename)
