"""Which topic feeds which channel."""

import numpy as np
import pytest

from replay.errors import MappingError
from replay.mapping import apply_mapping, map_topics
from replay.recording import Recording

CHANNELS = ["T_px", "Q_px"]


@pytest.mark.parametrize("topic", ["T_px", "/T_px", "/bus/thermal/T_px", "/thermal.T_px", "/bus/T_px.reading"])
def test_last_part_of_a_topic_names_the_channel(topic: str) -> None:
    assert map_topics([topic, "/camera"], CHANNELS, ignore_others=True) == {topic: "T_px"}


def test_rename_goes_before_the_name() -> None:
    assert map_topics(["T_px", "a"], CHANNELS, {"a": "Q_px"}) == {"T_px": "T_px", "a": "Q_px"}


def test_instants_of_which_no_channel_knows_are_left_out() -> None:
    columns = {"/T_px": np.array([1.0, np.nan, 3.0]), "camera": np.array([np.nan, 2.0, 2.0])}
    mapped = apply_mapping(Recording(np.array([10, 20, 30]), columns), {"/T_px": "T_px"})
    assert (mapped.time_ns.tolist(), mapped.columns["T_px"].tolist()) == ([10, 30], [1.0, 3.0])


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


def test_a_recording_of_something_else_is_not_taken_for_one_of_the_twin() -> None:
    with pytest.raises(
        MappingError, match=r"2 of 3 topics feed no channel of the twin: /camera, /lidar; --map .* --ignore-others"
    ):
        map_topics(["T_px", "/camera", "/lidar"], CHANNELS)
    assert map_topics(["T_px", "/lidar"], CHANNELS, {"/lidar": "Q_px"}) == {"T_px": "T_px", "/lidar": "Q_px"}
