"""Recordings as Foxglove reads them: events as its Log message, and a layout that names what there is."""

import asyncio
import json
from pathlib import Path
from typing import Any

import jsonschema_rs
import numpy as np
from mcap.reader import make_reader

from replay.mcap_io import read_mcap
from replay.mcap_writer import INFO, WARNING, McapWriter
from replay.recorder import RESIDUAL, Recorder
from service.schemas import Message
from twin_core.fem.demo import demo_scenario

LAYOUT = Path(__file__).parents[2] / "replay" / "bridges" / "foxglove" / "layout.json"
FIELDS = {"timestamp", "level", "message", "name", "file", "line"}
"""Of foxglove.Log, https://docs.foxglove.dev/docs/sdk/schemas/log."""


def anomaly(stop: str | None, cause: dict[str, Any] | None = None) -> dict[str, Any]:
    message = "T_px departs from its model"
    return {
        "id": 3,
        "sensor": "T_px",
        "start": "2026-03-01T00:01:00Z",
        "stop": stop,
        "cause": cause,
        "message": message,
    }


def test_anomalies_are_log_messages_and_no_telemetry(tmp_path: Path) -> None:
    path = tmp_path / "pass.mcap"
    with McapWriter(path, ["T_px"], {"T_px": "K"}) as writer:
        recorder = Recorder(None, "sat", writer)  # type: ignore[arg-type]
        told = [anomaly(None), anomaly(None), anomaly("2026-03-01T00:02:00Z", {"effect": "sensor_bias"})]
        for seq, body in enumerate(told):
            message = Message(type="anomaly", seq=seq, time="2026-03-01T00:03:00Z", anomaly=body)
            asyncio.run(recorder._take(message))
        writer.add("T_px", 1_772_323_200_000_000_000, 290.0)
    with path.open("rb") as stream:
        found = [(schema, channel, message) for schema, channel, message in make_reader(stream).iter_messages()]
    logs = [(schema, json.loads(m.data), m.log_time) for schema, c, m in found if c.topic == "/events"]
    assert [body["level"] for _, body, _ in logs] == [WARNING, INFO]  # once each, however often the score changes
    assert [body["message"][:6] for _, body, _ in logs] == ["begins", "ends: "]
    assert "sensor_bias" in logs[1][1]["message"]
    for schema, body, log_time in logs:
        assert schema is not None and schema.name == "foxglove.Log" and schema.encoding == "jsonschema"
        assert jsonschema_rs.is_valid(json.loads(schema.data), body) and set(body) == FIELDS
        assert 10**9 * body["timestamp"]["sec"] + body["timestamp"]["nsec"] == log_time
    assert np.diff([log_time for _, _, log_time in logs]).tolist() == [60 * 10**9]
    assert list(read_mcap(path).columns) == ["T_px"]


def test_the_layout_names_topics_that_there_are() -> None:
    layout = json.loads(LAYOUT.read_text())
    scenario, _ = demo_scenario("none", 0)
    topics = set(scenario.channels) | {RESIDUAL.format(sensor.channel) for sensor in scenario.sensors}
    plotted = [path["value"] for panel in layout["configById"].values() for path in panel.get("paths", ())]
    assert plotted and all(value.removesuffix(".value") in topics for value in plotted)
    assert leaves(layout["layout"]) == set(layout["configById"])


def leaves(part: Any) -> set[str]:
    """Return the panels that a layout arranges."""
    return {part} if isinstance(part, str) else leaves(part["first"]) | leaves(part["second"])
