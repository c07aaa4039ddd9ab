"""Streams over real sockets: order, resumption, slow readers, both transports."""

import json
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from tests.service.conftest import SPEC
from tests.service.server import Server

pytestmark = pytest.mark.e2e

PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with Server(tmp_path_factory.mktemp("streams"), stream_buffer="100") as running:
        yield running


@pytest.fixture
def twin(server: Server, request: pytest.FixtureRequest) -> Iterator[str]:
    """A fresh twin on the shared server."""
    name = "t" + str(abs(hash(request.node.name)) % 10**9)
    with server.client() as client:
        client.register({**SPEC, "twin": name})
        yield name


def send(server: Server, twin: str, *time_s: float) -> None:
    with server.client() as client:
        client.ingest(twin, time_s, {"T_px": [290.0 + t % 1000 for t in time_s]})


def socket_url(server: Server, twin: str, query: str = "") -> str:
    return server.url.replace("http", "ws") + f"/v1/twins/{twin}/stream{query}"


def test_socket_tells_each_sample_in_order(server: Server, twin: str) -> None:
    with connect(socket_url(server, twin)) as socket:
        send(server, twin, 1, 2)
        send(server, twin, 0.5)
        messages = [json.loads(socket.recv(timeout=PATIENCE_S)) for _ in range(3)]
    assert [m["seq"] for m in messages] == [1, 2, 3]
    assert messages[0] == {"type": "sample", "seq": 1, "time": "1970-01-01T00:00:01Z", "values": {"T_px": 291.0}}
    assert messages[2]["time"] == "1970-01-01T00:00:00.500000Z"


def test_duplicates_are_no_news(server: Server, twin: str) -> None:
    send(server, twin, 1)
    send(server, twin, 1, 2)
    with connect(socket_url(server, twin, "?after_seq=0")) as socket:
        assert [json.loads(socket.recv(timeout=PATIENCE_S))["values"]["T_px"] for _ in range(2)] == [291.0, 292.0]


def test_resumption_over_both_transports(server: Server, twin: str) -> None:
    send(server, twin, *range(10))
    with connect(socket_url(server, twin, "?after_seq=7")) as socket:
        assert [json.loads(socket.recv(timeout=PATIENCE_S))["seq"] for _ in range(3)] == [8, 9, 10]
    with server.client() as client:
        assert next(iter(client.events(twin, after_seq=9))).seq == 10
    headers = {"Last-Event-ID": "8"}
    with httpx.stream(
        "GET", f"{server.url}/v1/twins/{twin}/events?after_seq=0", headers=headers, timeout=PATIENCE_S
    ) as response:
        assert response.headers["content-type"].startswith("text/event-stream")
        lines = [line for line, _ in zip(response.iter_lines(), range(6), strict=False)]
    assert "id: 9" in lines and "id: 10" in lines and "id: 8" not in lines


def test_a_reader_that_lags_too_far_is_told_what_it_missed(server: Server, twin: str) -> None:
    send(server, twin, *range(300))
    with connect(socket_url(server, twin, "?after_seq=5")) as socket:
        first = json.loads(socket.recv(timeout=PATIENCE_S))
        assert (first["type"], first["first_seq"], first["last_seq"], first["count"]) == ("dropped", 6, 200, 195)
        assert first["seq"] == 200
        assert [json.loads(socket.recv(timeout=PATIENCE_S))["seq"] for _ in range(100)] == list(range(201, 301))


def test_a_batch_larger_than_what_is_kept_in_memory_reaches_its_readers(tmp_path: Path) -> None:
    with Server(tmp_path) as server:
        with server.client() as client:
            client.register(SPEC)
        with connect(socket_url(server, "benchsat")) as live:
            for start in (0, 5000):
                send(server, "benchsat", *range(start, start + 5000))
            assert [json.loads(live.recv(timeout=PATIENCE_S))["seq"] for _ in range(10_000)] == list(range(1, 10_001))
        for _ in range(2):
            with connect(socket_url(server, "benchsat", "?after_seq=7")) as late:
                assert [json.loads(late.recv(timeout=PATIENCE_S))["seq"] for _ in range(9993)] == list(range(8, 10_001))
            server.stop()
            server.start()


def test_a_reader_that_does_not_read_slows_nobody(server: Server, twin: str) -> None:
    with connect(socket_url(server, twin), max_queue=1) as lazy, connect(socket_url(server, twin)) as eager:
        for start in range(0, 100_000, 5000):
            send(server, twin, *range(start, start + 5000))
        seen = 0
        while seen < 100_000:
            seen = json.loads(eager.recv(timeout=PATIENCE_S))["seq"]
        position, missed = 0, 0
        while position < 100_000:
            message = json.loads(lazy.recv(timeout=PATIENCE_S))
            if message["type"] == "dropped":
                assert message["first_seq"] == position + 1
                missed += message["count"]
            else:
                assert message["seq"] == position + 1
            position = message["seq"]
    assert missed > 0


def test_numbers_go_on_after_a_restart(tmp_path: Path) -> None:
    with Server(tmp_path) as server:
        with server.client() as client:
            client.register(SPEC)
        send(server, "benchsat", 1, 2, 3)
        server.stop()
        server.start()
        send(server, "benchsat", 4)
        with connect(socket_url(server, "benchsat", "?after_seq=1")) as socket:
            assert [json.loads(socket.recv(timeout=PATIENCE_S))["seq"] for _ in range(3)] == [2, 3, 4]


def test_streams_end_with_their_twin_and_with_the_server(tmp_path: Path) -> None:
    with Server(tmp_path) as server, server.client() as client:
        client.register(SPEC)
        client.register({**SPEC, "twin": "other"})
        with connect(socket_url(server, "benchsat")) as first, connect(socket_url(server, "other")) as second:
            client.delete("benchsat")
            with pytest.raises(ConnectionClosed):
                first.recv(timeout=PATIENCE_S)
            server.stop()
            with pytest.raises(ConnectionClosed):
                second.recv(timeout=PATIENCE_S)


def test_strangers_and_unknown_twins_are_refused(tmp_path: Path) -> None:
    with Server(tmp_path, api_keys="read:r,operate:o") as server:
        with server.client("o") as client:
            client.register(SPEC)
        key = {"Authorization": "Bearer r"}
        for url, headers, status, field in (
            (socket_url(server, "benchsat"), {}, 401, None),
            (socket_url(server, "nosuch"), {}, 401, None),
            (socket_url(server, "benchsat"), {"Authorization": "Bearer x"}, 401, None),
            (socket_url(server, "nosuch"), key, 404, None),
            (socket_url(server, "benchsat", "?after_seq=-1"), key, 422, "after_seq"),
            (socket_url(server, "benchsat", "?after_seq=x"), key, 422, "after_seq"),
            (socket_url(server, "benchsat", "?after=1"), key, 422, "after"),
            (socket_url(server, "benchsat").replace("/stream", "/streams"), key, 404, None),
            (socket_url(server, "benchsat").replace("/stream", "/telemetry"), key, 404, None),
            (server.url.replace("http", "ws") + "/assets/style.css", {}, 404, None),
        ):
            with pytest.raises(InvalidStatus) as refused:
                connect(url, additional_headers=headers)
            response = refused.value.response
            assert response.status_code == status
            assert response.headers["content-type"] == "application/problem+json"
            document = json.loads(response.body)
            assert document["status"] == status and document["detail"]
            assert [error["field"] for error in document.get("errors", [])] == ([field] if field else [])
        with connect(socket_url(server, "benchsat"), subprotocols=["bearer.r"]) as socket:
            assert socket.subprotocol == "bearer.r"
        with connect(socket_url(server, "benchsat"), additional_headers=key):
            pass
        assert "connection rejected (401" in server.log() and '"level":"error"' not in server.log()
