"""Twins as Foxglove sees them: events, intervals and fields in its messages, live by web socket, and a layout of what there is.

What a message has to look like is asked of Foxglove's own SDK; live messages are read by a client that speaks its protocol.
"""

import asyncio
import base64
import json
import struct
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import jsonschema_rs
import numpy as np
import pytest
import websockets
from mcap.reader import make_reader

from replay.bridges.errors import BridgeError
from replay.bridges.foxglove_messages import EVENT_TOPIC, GRID_TOPIC, LOG_TOPIC, SCHEMAS
from replay.cli.main import main
from replay.mcap_io import read_mcap
from replay.mcap_writer import McapWriter
from replay.recorder import RESIDUAL, Recorder, Sink
from service.schemas import Job, Message
from twin_core.fem.demo import demo_scenario
from twin_core.fem.film import Film
from twin_core.fem.scenario import load_scenario
from twin_core.fem.simulate import simulate

LAYOUT = Path(__file__).parents[2] / "replay" / "bridges" / "foxglove" / "layout.json"
T0_NS = 1_772_323_200_000_000_000


def anomaly(stop: str | None, cause: dict[str, Any] | None = None) -> dict[str, Any]:
    told = {"score": 7.0, "cause": cause, "message": "T_px departs from its model"}
    return {"id": 3, "sensor": "T_px", "start": "2026-03-01T00:01:00Z", "stop": stop, **told}


def diagnosis() -> Job:
    found = {"effect": "sensor_bias", "where": {"sensor": "T_px"}, "parameters": {"b_K": {"mean": 0.5, "std": 0.02}}}
    times = {"created": "2026-03-01T00:03:00Z", "started": "2026-03-01T00:03:00Z", "finished": "2026-03-01T00:04:00Z"}
    head = {"id": "j1", "kind": "diagnosis", "state": "succeeded", "progress": 1.0, "message": "", **times}
    return Job(**head, result={"verdict": "effect_added", "findings": [found]})


class Service:
    """Answers what a recorder asks when a diagnosis has ended."""

    async def jobs(self, twin: str, kind: str) -> list[Job]:
        return [diagnosis()]


def record_events(sink: Sink) -> None:
    """Let a recorder hear that an anomaly began, changed and ended, and that a diagnosis found its cause."""
    recorder = Recorder(Service(), "sat", sink, service_url="http://twin/")  # type: ignore[arg-type]
    told = [anomaly(None), anomaly(None), anomaly("2026-03-01T00:02:00Z", {"effect": "sensor_bias"})]
    bodies: list[tuple[str, dict[str, Any]]] = [("anomaly", {"anomaly": body}) for body in told]
    brief = diagnosis().model_dump(mode="json") | {"result": {"verdict": "effect_added"}}
    for seq, (kind, body) in enumerate([*bodies, ("job", {"job": brief}), ("job", {"job": brief})]):
        message = Message(type=kind, seq=seq, time="2026-03-01T00:05:00Z", **body)
        asyncio.run(recorder._take(message))
    assert recorder.tally.events == 3


def messages(path: Path, topic: str) -> list[tuple[dict[str, Any], int]]:
    """Return bodies and log times of a topic, each checked against the schema that the file states."""
    with path.open("rb") as stream:
        found = [(s, json.loads(m.data), m.log_time) for s, _, m in make_reader(stream).iter_messages(topics=[topic])]
    for schema, body, _ in found:
        assert schema is not None and schema.encoding == "jsonschema"
        assert json.loads(schema.data) == SCHEMAS[schema.name] and jsonschema_rs.is_valid(SCHEMAS[schema.name], body)
        assert set(body) == set(SCHEMAS[schema.name]["properties"])
    return [(body, log_time) for _, body, log_time in found]


def ns(time: dict[str, int]) -> int:
    return 10**9 * time["sec"] + time["nsec"]


def test_events_are_log_messages_and_intervals_and_no_telemetry(tmp_path: Path) -> None:
    path = tmp_path / "pass.mcap"
    with McapWriter(path, ["T_px"], {"T_px": "K"}) as writer:
        record_events(writer)
        writer.add("T_px", T0_NS, 290.0)
    logs = messages(path, LOG_TOPIC)
    assert [body["level"] for body, _ in logs] == [3, 2, 3]  # once each, however often the score changes
    assert [ns(body["timestamp"]) - T0_NS for body, _ in logs] == [60 * 10**9, 120 * 10**9, 240 * 10**9]
    assert all(ns(body["timestamp"]) == log_time for body, log_time in logs)
    link = "http://twin/v1/twins/sat/diagnoses/j1/report.html"
    assert logs[1][0]["message"] == "ended: T_px departs from its model; cause: sensor_bias"
    assert logs[2][0]["message"] == f"sensor_bias at sensor T_px: b_K = 0.5 ± 0.02; report: {link}"
    intervals = messages(path, EVENT_TOPIC)
    spans = [(ns(body["start_time"]) - T0_NS, ns(body["end_time"]) - T0_NS) for body, _ in intervals]
    assert spans == [(60 * 10**9, 120 * 10**9), (240 * 10**9, 240 * 10**9)]
    about = [{item["key"]: item["value"] for item in body["metadata"]} for body, _ in intervals]
    assert [told["kind"] for told in about] == ["ANOMALY_ENDED", "FINDING"] and about[1]["link"] == link
    assert list(read_mcap(path).columns) == ["T_px"]


def test_the_schemas_are_those_of_the_sdk() -> None:
    """Field by field, the JSON Schemas are the protocol buffers of Foxglove's SDK; JSON spells time as sec and nsec."""
    foxglove = pytest.importorskip("foxglove.messages")
    descriptors = pytest.importorskip("yamcs.protobuf._vendor.google.protobuf.descriptor_pb2")
    kinds = {1: "number", 7: "integer", 9: "string", 12: "string", 14: "integer"}
    repeated, message = 3, 11

    def check(types: dict[str, Any], name: str, schema: dict[str, Any]) -> None:
        fields = {field.name: field for field in types[name].field}
        assert set(fields) == set(schema["properties"]), name
        for key, field in fields.items():
            part = schema["properties"][key]
            if field.label == repeated:
                assert part["type"] == "array"
                part = part["items"]
            inner = field.type_name.rpartition(".")[2]
            if inner == "Timestamp":
                assert set(part["properties"]) == {"sec", "nsec"}
            elif field.type == message:
                check(types, inner, part)
            else:
                assert part["type"] == kinds[field.type], key
            assert (field.type == 12) == ("contentEncoding" in part), key

    for name, schema in SCHEMAS.items():
        stated = getattr(foxglove, name.partition(".")[2]).get_schema()
        assert stated.name == name
        files = descriptors.FileDescriptorSet.FromString(stated.data)
        check({kind.name: kind for file in files.file for kind in file.message_type}, name.partition(".")[2], schema)
    types = descriptors.FileDescriptorSet.FromString(foxglove.Grid.get_schema().data)
    (element,) = [k for file in types.file for k in file.message_type if k.name == "PackedElementField"]
    assert {v.name: v.number for v in element.enum_type[0].value}["FLOAT32"] == 7


def plates() -> dict[str, Any]:
    """Two plates beside a gap, with a void corner: conduction alone, so that ``a`` settles on a straight line."""
    return {
        "scenario": "field",
        "mesh_size_m": 0.05,
        "initial_K": 300.0,
        "time": {
            "duration_s": 4000,
            "step_s": 100,
            "sample_s": 100,
            "settle_s": 400_000,
            "start": "2026-03-01T00:00:00Z",
        },
        "materials": {
            "m": {"conductivity_W_per_m_K": 20.0, "density_kg_per_m3": 1000.0, "specific_heat_J_per_kg_K": 100.0}
        },
        "regions": [
            {"id": "a", "x_m": [0.0, 0.4], "y_m": [0.0, 0.1], "material": "m"},
            {"id": "b", "x_m": [0.5, 0.6], "y_m": [0.0, 0.2], "material": "m"},
        ],
        "boundaries": {"room": {"value_K": 300.0}},
        "couplings": [{"place": "a.left", "boundary": "room", "conductance_W_per_K": 2.0}],
        "forcings": {"Q": {"kind": "power", "unit": "W", "signal": {"signal": "constant", "value": 10.0}}},
        "loads": [{"forcing": "Q", "place": "a.right"}],
        "sensors": [{"channel": "T_a", "at_m": [0.21, 0.05]}, {"channel": "T_b", "region": "b"}],
    }


def test_the_field_is_a_grid_that_a_viewer_can_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Ten watts along a bar of 0.4 m: T(x) = 300 + Q/G + Q x / (k A), and nothing where no plate is."""
    (tmp_path / "s.json").write_text(json.dumps(plates()))
    out = tmp_path / "s.mcap"
    told = ["simulate", "--scenario", str(tmp_path / "s.json"), "--out", str(out)]
    assert main([*told, "--field-every", "1000s"]) == 0
    found = messages(out, GRID_TOPIC)
    assert [log_time - T0_NS for _, log_time in found] == [k * 10**12 for k in range(5)]
    for body, _ in found:
        field = np.frombuffer(base64.b64decode(body["data"]), "<f4").reshape(-1, body["column_count"])
        assert body["row_stride"] == field.strides[0] and body["cell_stride"] == field.itemsize
        size, corner = body["cell_size"], body["pose"]["position"]
        x = corner["x"] + size["x"] * (0.5 + np.arange(field.shape[1]))
        y = corner["y"] + size["y"] * (0.5 + np.arange(field.shape[0]))
        bar = np.ix_(y < 0.1, x < 0.4)
        expected = np.broadcast_to(300.0 + 10.0 / 2.0 + 10.0 * x[x < 0.4] / (20.0 * 0.1), field[bar].shape)
        np.testing.assert_allclose(field[bar], expected, atol=2e-3)  # single precision, and what has not settled yet
        np.testing.assert_allclose(field[:, x > 0.5], 300.0, atol=1e-4)
        assert np.isnan(field[y > 0.1][:, x < 0.5]).all() and np.isnan(field[:, (x > 0.4) & (x < 0.5)]).all()
    assert set(read_mcap(out).columns) == {"T_a", "T_b", "Q"}
    capsys.readouterr()
    assert main([*told, "--field-every", "150s"]) == 2
    assert "must be a multiple of the simulator's step, 100 s" in capsys.readouterr().err
    assert main([*told[:-1], str(tmp_path / "s.csv"), "--field-every", "1000s"]) == 2
    assert ".mcap" in capsys.readouterr().err


def test_pictures_read_what_sensors_read() -> None:
    """On a spacecraft whose panels are thinner than a cell of the mesh, every region's mean is the simulator's own."""
    scenario, _ = demo_scenario("none", 0)
    body = scenario.model_dump(mode="json", exclude_none=True)
    body["time"] |= {"duration_s": 600.0, "settle_s": 0.0}
    film = Film(load_scenario(body), 300.0)
    truth = simulate(load_scenario(body), watch=film.take).truth
    assert film.time_s == [0.0, 300.0, 600.0]
    step = [int(np.flatnonzero(np.isclose(truth.time_s, t))[0]) for t in film.time_s]
    height, width = film.temperature_K[0].shape
    x = film.origin_m[0] + film.cell_m * (0.5 + np.arange(width))
    y = film.origin_m[1] + film.cell_m * (0.5 + np.arange(height))
    for region in scenario.regions:
        place = np.ix_((region.y_m[0] < y) & (y < region.y_m[1]), (region.x_m[0] < x) & (x < region.x_m[1]))
        for picture, k in zip(film.temperature_K, step, strict=True):
            assert picture[place].size and np.mean(picture[place]) == pytest.approx(
                truth.region_K[region.id][k], abs=0.02
            )


# Live


@asynccontextmanager
async def viewer(url: str, topics: Iterable[str]) -> AsyncIterator[tuple[Any, dict[int, str], dict[str, Any]]]:
    """Yield a connection that speaks Foxglove's protocol and has subscribed, topics by subscription, and what is advertised.

    https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md
    """
    async with websockets.connect(url, subprotocols=[websockets.Subprotocol("foxglove.sdk.v1")], proxy=None) as socket:
        assert json.loads(await socket.recv())["op"] == "serverInfo"
        advertised: dict[str, Any] = {}
        while not set(topics) <= advertised.keys():
            said = json.loads(await asyncio.wait_for(socket.recv(), 20))
            assert said["op"] == "advertise"
            advertised |= {channel["topic"]: channel for channel in said["channels"]}
        ids = dict(enumerate(topics, start=7))
        wanted = [{"id": number, "channelId": advertised[topic]["id"]} for number, topic in ids.items()]
        await socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        yield socket, ids, advertised


async def heard(socket: Any, ids: dict[int, str], count: int) -> list[tuple[str, int, Any]]:
    """Return topic, log time and body of the next messages; the server's clock is left out."""
    found: list[tuple[str, int, Any]] = []
    while len(found) < count:
        frame = await asyncio.wait_for(socket.recv(), 20)
        if isinstance(frame, bytes) and frame[0] == 1:
            number, time_ns = struct.unpack_from("<IQ", frame, 1)
            found.append((ids[number], time_ns, json.loads(frame[13:])))
    return found


def test_viewers_hear_samples_live_and_events_of_the_past() -> None:
    pytest.importorskip("foxglove")
    from replay.bridges.foxglove_server import FoxgloveServer

    async def watch(server: FoxgloveServer) -> None:
        topics = ["T_px", LOG_TOPIC, EVENT_TOPIC]
        async with viewer(server.url, topics) as (socket, ids, advertised):
            past = await heard(socket, ids, 5)  # three log messages and two intervals, told to whoever comes
            assert [t for t, _, _ in past].count(LOG_TOPIC) == 3 and [t for t, _, _ in past].count(EVENT_TOPIC) == 2
            async with viewer(server.url, topics) as (late, its_ids, _):
                assert sorted(await heard(late, its_ids, 5), key=str) == sorted(past, key=str)
                server.add("T_px", T0_NS, float("nan"))
                server.add("T_px", T0_NS, 290.5)
                # the first viewer was not told the past again when the second came: its next message is the sample
                assert await heard(socket, ids, 1) == [("T_px", T0_NS, {"value": 290.5})]
                assert await heard(late, its_ids, 1) == [("T_px", T0_NS, {"value": 290.5})]
        assert advertised["T_px"]["metadata"] == {"unit": "K"} and advertised["T_px"]["encoding"] == "json"
        for topic in (LOG_TOPIC, EVENT_TOPIC):
            stated = json.loads(advertised[topic]["schema"])
            assert advertised[topic]["schemaName"] == stated["title"]
            assert all(jsonschema_rs.is_valid(stated, body) for t, _, body in past if t == topic)

    with FoxgloveServer("sat", ["T_px"], {"T_px": "K"}, "127.0.0.1", 0) as server:
        record_events(server)
        asyncio.run(watch(server))
        port = int(server.url.rpartition(":")[2])
        with pytest.raises(BridgeError, match=f"cannot listen on 127.0.0.1:{port}"):
            FoxgloveServer("sat", [], {}, "127.0.0.1", port).__enter__()


def test_the_layout_names_topics_that_there_are() -> None:
    layout = json.loads(LAYOUT.read_text())
    scenario, _ = demo_scenario("none", 0)
    topics = set(scenario.channels) | {RESIDUAL.format(sensor.channel) for sensor in scenario.sensors}
    panels = layout["configById"]
    plotted = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    assert plotted and all(value.removesuffix(".value") in topics for value in plotted)
    shown = {panel["topicToRender"] for panel in panels.values() if "topicToRender" in panel}
    shown |= {topic for panel in panels.values() for topic in panel.get("topics", {})}
    shown |= {panel["topicPath"] for panel in panels.values() if "topicPath" in panel}
    assert shown == {LOG_TOPIC, EVENT_TOPIC, GRID_TOPIC}
    field = next(panel for panel in panels.values() if GRID_TOPIC in panel.get("topics", {}))
    assert field["topics"][GRID_TOPIC]["colorField"] == "temperature_K" and field["followTf"] == "section"
    assert leaves(layout["layout"]) == set(panels)


def leaves(part: Any) -> set[str]:
    """Return the panels that a layout arranges."""
    return {part} if isinstance(part, str) else leaves(part["first"]) | leaves(part["second"])
