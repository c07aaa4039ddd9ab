"""Callers that mean harm or are broken: slow, endless, huge, malformed. The others notice nothing."""

import http.client
import json
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest

from tests.service.conftest import SPEC
from tests.service.harness import until
from tests.service.server import Server

pytestmark = pytest.mark.e2e

LATER = b"<later>"
PATIENCE_S = 60.0
ROUTE = "/v1/twins/benchsat/telemetry"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with Server(tmp_path_factory.mktemp("hostile"), body_timeout_s="1") as running:
        running.client().register(SPEC)
        yield running


def dial(server: Server) -> socket.socket:
    parts = urlsplit(server.url)
    return socket.create_connection((parts.hostname, parts.port), timeout=PATIENCE_S)


def read_to_end(connection: socket.socket) -> bytes:
    parts = []
    try:
        while part := connection.recv(65536):
            parts.append(part)
    except ConnectionResetError:
        parts.append(b"")
    return b"".join(parts)


@pytest.mark.parametrize(
    ("first", "status"),
    [
        (b"", b""),
        (b"GET /healthz HT", b""),
        (b"GET /healthz HTTP/1.1\r\nHost: x\r\nX-Slow:", b""),
        (b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n" + LATER + b"GET /he", b"200 OK"),
        (f"POST {ROUTE} HTTP/1.1\r\nHost: x\r\nContent-Length: 100\r\n\r\nabc".encode(), b"408"),
        (f"POST {ROUTE} HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n3\r\nabc\r\n".encode(), b"408"),
    ],
    ids=["silent", "half a line", "half a head", "half a second request", "half a body", "half a chunked body"],
)
def test_slow_callers_are_let_go_and_others_are_served(server: Server, first: bytes, status: bytes) -> None:
    crowd = [dial(server) for _ in range(30)]
    for part in first.split(LATER):
        for connection in crowd:
            connection.sendall(part)
        assert server.client().is_ready()
    for connection in crowd:
        answer = read_to_end(connection)
        assert status in answer.split(b"\r\n", 1)[0]
        connection.close()


@pytest.mark.parametrize(
    "head",
    [
        b"NONSENSE\r\n\r\n",
        b"GET /healthz HTTP/1.1\r\n\r\n",
        f"POST {ROUTE} HTTP/1.1\r\nHost: x\r\nContent-Length: many\r\n\r\n".encode(),
        b"GET /healthz HTTP/1.1\r\nHost: x\r\nX: " + b"a" * 200_000,
        b"GET /healthz HTTP/1.1\r\nHost: x\r\nHost: y\r\n\r\n",
        f"POST {ROUTE} HTTP/1.1\r\nHost: x\r\nContent-Length: 2\r\nTransfer-Encoding: chunked\r\n\r\n{{}}".encode(),
        f"POST {ROUTE} HTTP/1.1\r\nHost: x\r\nContent-Length: 2\r\nContent-Length: 3\r\n\r\n{{}}".encode(),
        b"GET /healthz HTTP/1.1\r\nHost: x\r\nX : y\r\n\r\n",
    ],
    ids=[
        *("no request", "no host", "no length", "endless head"),
        *("two hosts", "length and chunks", "two lengths", "blank before a colon"),
    ],
)
def test_what_is_no_http_is_told_so_as_any_other_problem(server: Server, head: bytes) -> None:
    with dial(server) as connection:
        connection.sendall(head)
        lines, _, body = read_to_end(connection).partition(b"\r\n\r\n")
    assert lines.startswith(b"HTTP/1.1 400") and b"application/problem+json" in lines
    assert json.loads(body)["status"] == 400


def test_large_bodies_are_refused_with_an_answer(server: Server) -> None:
    parts = urlsplit(server.url)
    connection = http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=PATIENCE_S)
    connection.request("POST", ROUTE, b" " * 64 * 1024 * 1024, {"Content-Type": "application/json"})
    response = connection.getresponse()
    assert response.status == 413
    assert b"smaller batches" in response.read()
    connection.close()


def test_endless_bodies_are_cut_off_without_being_kept(server: Server) -> None:
    before = resident_bytes(server.process.pid)
    connection = dial(server)
    connection.sendall(f"POST {ROUTE} HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n".encode())
    chunk = b"100000\r\n" + b"x" * 0x100000 + b"\r\n"
    sent = 0
    with pytest.raises((BrokenPipeError, ConnectionResetError)):
        for _ in range(400):
            connection.sendall(chunk)
            sent += 1
    assert sent < 400
    connection.close()
    assert resident_bytes(server.process.pid) - before < 80 * 1024 * 1024


def resident_bytes(process: int) -> int:
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) * 1024


@pytest.mark.parametrize(
    "head",
    [
        b"GET / HTTP/9.9\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"GET / HTTP/1.1\r\nHost: x\r\nContent-Length: -5\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: x\r\nContent-Length: 99999999999999999999999\r\n\r\n",
        b"GET /%00%ff%zz HTTP/1.1\r\nHost: x\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: x\r\nX: " + b"y" * 100_000 + b"\r\n\r\n",
        b"GET /v1/twins/..%2f..%2fetc/telemetry HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n",
        b"GET /metrics HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer \xff\xfe\r\nConnection: close\r\n\r\n",
    ],
)
def test_broken_requests_never_end_in_a_server_error(server: Server, head: bytes) -> None:
    connection = dial(server)
    connection.sendall(head)
    line = connection.recv(65536).split(b"\r\n", 1)[0]
    assert b" 5" not in line[8:11]
    connection.close()
    assert server.client().is_ready()
    assert "unexpected error" not in server.log()


def test_a_caller_that_hangs_up_in_the_middle(server: Server) -> None:
    for _ in range(20):
        connection = dial(server)
        connection.sendall(f"POST {ROUTE} HTTP/1.1\r\nHost: x\r\nContent-Length: 5000\r\n\r\n[1".encode())
        connection.close()
    time.sleep(0.2)
    client = server.client()
    assert client.archive("benchsat").samples == 0
    assert "unexpected error" not in server.log()


@pytest.mark.parametrize(
    "path", ["/", "/healthz", "/readyz", "/metrics", "/docs", "/assets/style.css", "/v1/twins", ROUTE, "/nowhere"]
)
def test_head_is_get_without_its_body(server: Server, path: str) -> None:
    with httpx.Client(base_url=server.url, timeout=PATIENCE_S) as client:
        asked, told = client.head(path), client.get(path)
    assert (asked.status_code, asked.content) == (told.status_code, b"")
    differing = {"date", "content-length"} if path == "/metrics" else {"date"}
    assert {n: v for n, v in asked.headers.items() if n not in differing} == {
        n: v for n, v in told.headers.items() if n not in differing
    }


def test_head_of_a_stream_ends(server: Server) -> None:
    answer = httpx.head(f"{server.url}/v1/twins/benchsat/events", timeout=PATIENCE_S)
    assert (answer.status_code, answer.headers["content-type"]) == (200, "text/event-stream; charset=utf-8")
    until(lambda: "twin_stream_readers 0.0" in httpx.get(f"{server.url}/metrics", timeout=PATIENCE_S).text)


def test_head_is_no_way_to_post(server: Server) -> None:
    assert httpx.head(f"{server.url}/v1/twins/benchsat/models/1/activate", timeout=PATIENCE_S).status_code == 405
