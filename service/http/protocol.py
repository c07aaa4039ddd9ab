"""Connections that open and then say too little, too slowly, or without end are closed: they would be kept for ever."""

import asyncio
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, cast

from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol, RequestResponseCycle

from service.http.lane import Headers, Lane, Plain
from service.http.problems import MEDIA_TYPE, document

MOST_HEAD_BYTES = 64 * 1024


class Joining:
    """A transport that sends the head of an answer together with what follows it at once: two packets wake a caller twice."""

    __slots__ = ("_head", "_loop", "_transport", "write")

    def __init__(self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> None:
        """Keep back what is written first."""
        self._transport, self._loop, self._head = transport, loop, b""
        self.write: Callable[[bytes], None] = self._first

    def _first(self, data: bytes) -> None:
        """Keep the head, no longer than until the event loop goes on: a stream may have nothing to say for long."""
        self._head, self.write = data, self._second
        self._loop.call_soon(self.flush)

    def _second(self, data: bytes) -> None:
        """Send the head and what follows; all else is sent as it comes."""
        self.write = self._transport.write
        self._transport.write(self._head + data)

    def flush(self) -> None:
        """Send what was kept."""
        if self.write == self._second:
            self._second(b"")

    def close(self) -> None:
        """Close the connection behind what was written."""
        self.flush()
        self._transport.close()


class PatientProtocol(HttpToolsProtocol):
    """HTTP/1.1 whose request heads are short and complete within ``patience_s``; bodies have limits of their own."""

    patience_s: ClassVar[float] = 30.0
    lane: ClassVar[Lane | None] = None
    _deadline: asyncio.TimerHandle | None = None
    _head_bytes = 0
    _in_body = False

    def connection_made(self, transport: Any) -> None:
        """Wait for the first request."""
        super().connection_made(transport)
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no more."""
        self._stop()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Begin to wait with the first bytes of a later request: the keep-alive timer ends there."""
        if not self._in_body:
            self._head_bytes += len(data)
            self._wait()
        super().data_received(data)
        if not self._in_body and self._head_bytes > MOST_HEAD_BYTES:
            self.send_400_response(f"the head of a request must not exceed {MOST_HEAD_BYTES} bytes")

    def on_message_begin(self) -> None:
        """Wait for the rest of the head."""
        super().on_message_begin()
        self._wait()

    def on_headers_complete(self) -> None:
        """Wait no more: the head was complete. A request that names no host, or two, is none."""
        hosts = sum(name == b"host" for name, _ in self.headers)
        if hosts > 1 or (hosts == 0 and self.parser.get_http_version() == "1.1"):
            raise ValueError("one Host is needed")  # the parser takes this for a malformed request
        self._in_body, before = True, self.cycle
        if self.parser.get_method() == b"POST" and (before is None or before.response_complete):
            plain = self._plain()
            if plain is not None:
                self.cycle = cast(RequestResponseCycle, plain)
                return
        self._stop()
        super().on_headers_complete()
        if self.cycle is not before:
            self.cycle.transport = cast(asyncio.Transport, Joining(self.transport, self.loop))

    def on_message_complete(self) -> None:
        """Expect the head of another request."""
        self._in_body = False
        request = self.cycle
        is_plain = type(request) is Plain and request.more_body
        super().on_message_complete()
        if is_plain:
            self._stop()
            cast(Plain, request).take(partial(self._reply, cast(Plain, request)))

    def _plain(self) -> Plain | None:
        """Return what answers a request past the framework, if it is one that may be answered so."""
        if self.lane is None or self.parser.get_http_version() != "1.1" or self.parser.should_upgrade():
            return None
        plain = self.lane.enters(self.url, self.headers, self.client)
        if plain is not None:
            plain.keep_alive = self.parser.should_keep_alive()
        return plain

    def _reply(self, request: Plain, status: int, headers: Headers, body: bytes) -> None:
        """Answer a request that was taken past the framework."""
        if request.response_complete or self.transport.is_closing():
            return
        request.response_complete = True
        lines = [b"%b: %b\r\n" % line for line in (*self.server_state.default_headers, *headers)]
        if not request.keep_alive:
            lines.append(b"connection: close\r\n")
        self.transport.write(b"".join((STATUS_LINE[status], *lines, b"\r\n", body)))
        if not request.keep_alive:
            self.transport.close()
        self.on_response_complete()

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP as every other error is answered."""
        body = document(400, msg)
        head = f"content-type: {MEDIA_TYPE}\r\ncontent-length: {len(body)}\r\nconnection: close\r\n\r\n"
        self.transport.write(b"HTTP/1.1 400 Bad Request\r\n" + head.encode() + body)
        self.transport.close()

    def _wait(self) -> None:
        if self._deadline is None:
            self._deadline = self.loop.call_later(self.patience_s, self._give_up)

    def _give_up(self) -> None:
        """Close the connection; whoever has sent a head is told why."""
        request = self.cycle
        if type(request) is Plain and request.more_body:
            plain = cast(Plain, request)
            plain.keep_alive = False
            plain.give_up(partial(self._reply, plain), self.patience_s)
        self.transport.close()

    def _stop(self) -> None:
        self._head_bytes = 0
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


def patient(patience_s: float, lane: Lane | None = None) -> type[PatientProtocol]:
    """Return the protocol with a patience, and a lane for plain ingest, of its own."""
    return type("PatientProtocol", (PatientProtocol,), {"patience_s": patience_s, "lane": lane})
