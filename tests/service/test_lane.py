"""Plain ingest goes past the framework: what it is answered is what the ordinary way answers, whatever comes over the wire."""

import asyncio
import json
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from fastapi import FastAPI

from service.http.lane import Lane, Plain
from service.http.telemetry_body import parse_columns
from service.store.appending import Receipt
from service.store.batch import Batch
from service.twins.registry import Entry
from tests.service.server import Server

pytestmark = pytest.mark.e2e

PATH = "/v1/twins/lane/telemetry"
SPEC = {
    "twin": "lane",
    "channels": {"T_a": {"kind": "temperature", "unit": "K"}, "T_b": {"kind": "temperature", "unit": "K"}},
    "nodes": [{"id": "a", "sensor": "T_a"}, {"id": "b", "sensor": "T_b"}],
}
KEYS = "ingest:taking,read:looking"
PLAIN = ("Content-Type: application/json",)
ORDINARY = (*PLAIN, "X-Anything: sends it the ordinary way")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    settings = {"assimilate": "false", "body_timeout_s": "2", "max_body_bytes": "20000"}
    with Server(tmp_path_factory.mktemp("lane"), **settings) as running:
        running.client().register(SPEC)
        yield running


def connected(server: Server) -> socket.socket:
    host, port = server.url.removeprefix("http://").split(":")
    return socket.create_connection((host, int(port)), timeout=30)


def request(body: bytes, headers: tuple[str, ...] = PLAIN, path: str = PATH, host: str = "localhost") -> bytes:
    head = (f"POST {path} HTTP/1.1", f"Host: {host}", f"Content-Length: {len(body)}", *headers)
    return "\r\n".join((*head, "", "")).encode() + body


def frame(time_s: object, a: object = 290.0, b: object = 291.0) -> bytes:
    return json.dumps({"time": [time_s], "values": {"T_a": [a], "T_b": [b]}}).encode()


def answers(connection: socket.socket, count: int) -> list[tuple[int, dict[str, str], dict]]:
    """Return (status, headers, document) of the next answers on a connection."""
    with connection.makefile("rb") as stream:
        found = []
        for _ in range(count):
            status = int(stream.readline().split()[1])
            lines = iter(lambda: stream.readline().decode().rstrip("\r\n"), "")
            headers = {name.lower(): value for name, _, value in (line.partition(": ") for line in lines)}
            found.append((status, headers, json.loads(stream.read(int(headers["content-length"])))))
    return found


def ask(server: Server, message: bytes) -> tuple[int, dict[str, str], dict]:
    with connected(server) as connection:
        connection.sendall(message)
        return answers(connection, 1)[0]


BODIES = {
    "malformed": b"{",
    "empty": b"",
    "no object": b"[]",
    "unequal columns": b'{"time": [1, 2], "values": {"T_a": [290.0]}}',
    "unknown channel": b'{"time": [1], "values": {"T_c": [290.0]}}',
    "not finite": b'{"time": [1], "values": {"T_a": [NaN]}}',
    "overflow": b'{"time": [1], "values": {"T_a": [1e999]}}',
    "text": b'{"time": [1], "values": {"T_a": ["warm"]}}',
    "boolean": b'{"time": [1], "values": {"T_a": [true]}}',
    "boolean time": b'{"time": [true], "values": {"T_a": [290.0]}}',
    "negative time": b'{"time": [-1], "values": {"T_a": [290.0]}}',
    "time too late": b'{"time": [1e12], "values": {"T_a": [290.0]}}',
    "time of no kind": b'{"time": [null], "values": {"T_a": [290.0]}}',
    "twice": b'{"time": [1], "values": {"T_a": [290.0], "T_a": [291.0]}}',
    "implausible": b'{"time": [1], "values": {"T_a": [1e9]}}',
    "no samples": b'{"time": [], "values": {}}',
    "no values": b'{"time": [1], "values": {}}',
    "another order": b'{"time": [1], "values": {"T_b": [null], "T_a": [null]}}',
}


@pytest.mark.parametrize("name", BODIES)
def test_the_lane_answers_as_the_ordinary_way_does(server: Server, name: str) -> None:
    plain, ordinary = (ask(server, request(BODIES[name], headers)) for headers in (PLAIN, ORDINARY))
    if name in ("no values", "another order"):  # the first of them is stored, the second one is known already
        assert plain[0] == ordinary[0] == 200
    else:
        assert (plain[0], plain[2]) == (ordinary[0], ordinary[2])
        assert plain[1]["content-type"] == ordinary[1]["content-type"]


def test_samples_known_and_contradicted_are_told_alike(server: Server) -> None:
    assert ask(server, request(frame(1000)))[2]["accepted"] == 1
    for headers in (PLAIN, ORDINARY):
        assert ask(server, request(frame(1000), headers))[2] == {
            "accepted": 0,
            "duplicates": 1,
            "rejected": [],
            "last_time": "1970-01-01T00:16:40Z",
        }
        conflict = ask(server, request(frame(1000, a=280.0), headers))[2]
        assert conflict["rejected"] == [{"index": 0, "reason": "conflict"}]


def test_an_instant_is_the_same_alone_and_in_company(server: Server) -> None:
    for time_s in (2000.1234567, 2001, 2002.0000005, 1.7e9 + 0.333333):
        alone = ask(server, request(frame(time_s)))[2]
        body = json.dumps({"time": [time_s, 3000], "values": {"T_a": [290.0, None], "T_b": [291.0, None]}}).encode()
        together = ask(server, request(body))[2]
        assert alone["accepted"] == 1
        assert together["rejected"] == []
        assert together["duplicates"] >= 1  # the same instant, to the microsecond


def test_requests_that_follow_without_waiting_are_answered_in_their_order(server: Server) -> None:
    messages = [
        request(frame(5000)),
        request(frame(5000)),
        request(frame(5001), ORDINARY),
        b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n",
        request(b"{"),
        request(frame(5002)),
    ]
    with connected(server) as connection:
        connection.sendall(b"".join(messages))
        found = answers(connection, len(messages))
    assert [status for status, _, _ in found] == [200, 200, 200, 200, 400, 200]
    assert [document.get("accepted") for _, _, document in found] == [1, 0, 1, None, None, 1]


def test_a_request_may_come_byte_by_byte(server: Server) -> None:
    with connected(server) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for byte in request(frame(6000)):
            connection.sendall(bytes([byte]))
        assert answers(connection, 1)[0][2]["accepted"] == 1


def test_a_connection_is_closed_where_that_is_asked_for(server: Server) -> None:
    with connected(server) as connection:
        connection.sendall(request(frame(7000), (*PLAIN, "Connection: close")))
        status, headers, _ = answers(connection, 1)[0]
        assert (status, headers["connection"]) == (200, "close")
        assert connection.recv(1) == b""


def test_a_body_that_never_comes_is_refused(server: Server) -> None:
    with connected(server) as connection:
        connection.sendall(request(frame(8000))[:-1])
        status, headers, document = answers(connection, 1)[0]
        assert status == 408
        assert document["detail"] == "the body did not arrive within 2 s"
        assert headers["connection"] == "close"
        assert connection.recv(1) == b""
    assert ask(server, request(frame(8000)))[2]["accepted"] == 1  # nothing of it was stored


@pytest.mark.parametrize("headers", [PLAIN, ORDINARY], ids=["plain", "ordinary"])
def test_a_body_beyond_the_limit_is_refused(server: Server, headers: tuple[str, ...]) -> None:
    times = [8100.0 + k for k in range(2000)]
    body = json.dumps({"time": times, "values": {"T_a": [290.0] * len(times)}}).encode()
    assert len(body) > 20_000
    status, _, document = ask(server, request(body, headers))
    assert (status, "20000 bytes" in document["detail"]) == (413, True)


def test_whoever_hangs_up_harms_nobody(server: Server) -> None:
    for stop in (10, 80, -1, None):
        with connected(server) as connection:
            connection.sendall(request(frame(9000))[:stop])
    assert ask(server, request(frame(9001)))[0] == 200


def test_strangers_are_refused_before_their_body_is_read(server: Server) -> None:
    for headers in (PLAIN, ORDINARY):
        assert ask(server, request(frame(1), headers, host="public.example.org"))[0] == 403
    assert ask(server, request(frame(1), (*PLAIN, "Origin: http://elsewhere.example.org")))[0] == 403
    for path in ("/v1/twins/nobody/telemetry", "/v1/twins/a/b/telemetry", "/v1/twins//telemetry"):
        assert ask(server, request(frame(1), path=path))[0] == 404
    assert ask(server, request(frame(1), path=f"{PATH}?slip=1"))[0] == 422
    assert ask(server, request(frame(1), ("Content-Type: text/plain",)))[0] == 415


def test_requests_are_counted_on_either_way(server: Server) -> None:
    def counted(status: int) -> float:
        text = scraped(server)
        label = f'twin_http_requests_total{{method="POST",route="/v1/twins/{{twin}}/telemetry",status="{status}"}} '
        return sum(float(line.removeprefix(label)) for line in text.splitlines() if line.startswith(label))

    for status, body in ((200, frame(10_000)), (400, b"{")):
        before = counted(status)
        for headers in (PLAIN, ORDINARY):
            ask(server, request(body, headers))
        assert counted(status) == before + 2


def scraped(server: Server) -> str:
    with connected(server) as connection:
        connection.sendall(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        return b"".join(iter(lambda: connection.recv(65536), b"")).decode()


def test_keys_are_asked_for(tmp_path: Path) -> None:
    with Server(tmp_path, assimilate="false", api_keys=f"{KEYS},operate:all") as server:
        server.client("all").register(SPEC)
        for sent, status in (((), 401), (("wrong",), 401), (("looking",), 403), (("taking",), 200)):
            headers = (*PLAIN, *(f"Authorization: Bearer {key}" for key in sent))
            assert ask(server, request(frame(status), headers))[0] == status


def test_what_is_under_way_is_answered_before_the_service_ends(tmp_path: Path) -> None:
    with Server(tmp_path, assimilate="false") as server:
        server.client().register(SPEC)
        with connected(server) as connection:
            message = request(frame(1))
            connection.sendall(message[:-1])
            time.sleep(0.2)  # the head has been read
            server.process.terminate()
            time.sleep(0.2)  # and the service knows that it is to end
            connection.sendall(message[-1:])
            status, headers, document = answers(connection, 1)[0]
        assert (status, headers["connection"], document["accepted"]) == (200, "close", 1)


def entry(specification: dict) -> Entry:
    return Entry(1, "lane", tuple(specification["channels"]), specification)


class Elsewhere:
    """A service among several, which learns of a twin's new channel only when it asks."""

    def __init__(self) -> None:
        self.wider = entry({**SPEC, "channels": {**SPEC["channels"], "T_c": SPEC["channels"]["T_b"]}})
        self.database = SimpleNamespace(is_shared=True)
        self.stored: list[int] = []
        self.intake = self

    async def find(self, name: str) -> Entry:
        return entry(SPEC)

    async def find_now(self, name: str) -> Entry:
        return self.wider

    async def store(self, twin: Entry, batch: Batch) -> Receipt:
        self.stored.append(len(twin.channels))
        return Receipt(np.zeros(batch.time_us.size, dtype=np.int8), 1, int(batch.time_us[-1]))


@pytest.mark.parametrize(("channel", "status", "stored"), [("T_c", 200, [3]), ("T_d", 422, [])])
def test_a_channel_that_came_elsewhere_is_taken_at_once(channel: str, status: int, stored: list[int]) -> None:
    service = Elsewhere()
    counted: list[int] = []
    observe = SimpleNamespace(count=lambda *told: counted.append(told[2]))
    lane = Lane(FastAPI(), cast(Any, None), cast(Any, observe), 10_000)

    async def answered() -> tuple[int, bytes]:
        heard: asyncio.Future[tuple[int, bytes]] = asyncio.get_running_loop().create_future()
        plain = Plain(lane, cast(Any, service), entry(SPEC), parse_columns)
        plain.body += json.dumps({"time": [1], "values": {channel: [290.0]}}).encode()
        plain.take(lambda status, _, body: heard.set_result((status, body)))
        return await heard

    found, body = asyncio.run(answered())
    assert (found, service.stored, counted) == (status, stored, [status])
    assert (json.loads(body).get("accepted") == 1) == (status == 200)
