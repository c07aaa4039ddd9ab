"""Request bodies: read once, bounded in size and time, gunzipped, before any route sees them."""

import asyncio
import zlib

from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import Refusal
from service.http.problems import Problem, late_body, problem, status_of

LEAST_RATE_BYTES_PER_S = 32 * 1024
DECODE_APART_BYTES = 64 * 1024
"""Larger bodies are unpacked in a thread, so that other requests are answered meanwhile."""
PIECE_BYTES = 16 * 1024
DRAIN_FACTOR = 5
DRAIN_S = 10.0


class Bodies:
    """ASGI layer that hands every route a whole body of at most ``max_bytes``, or answers 413, 408, 400 or 415."""

    def __init__(self, app: ASGIApp, max_bytes: int, timeout_s: float) -> None:
        """Bound bodies to ``max_bytes`` after decompression and to ``timeout_s`` plus a least rate."""
        self._app, self._max_bytes, self._timeout_s = app, max_bytes, timeout_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Read the body and pass it on as one message."""
        headers = dict(scope["headers"]) if scope["type"] == "http" else {}
        if b"content-length" not in headers and b"transfer-encoding" not in headers:
            await self._app(scope, receive, send)
            return
        try:
            body = await self.read(headers, receive)
            encoding = headers.get(b"content-encoding", b"identity").lower()
            if encoding not in (b"", b"identity"):
                body = await _decode(body, encoding, self._max_bytes)
        except Refusal as error:
            await refused(error)(scope, receive, send)
            return
        except Gone:
            return
        await self._app(scope, _replay(body, receive), send)

    async def read(self, headers: dict[bytes, bytes], receive: Receive) -> bytes:
        """Return a body as it is sent; Refusal if it is too large or too slow, Gone if its sender hangs up."""
        declared = int(headers.get(b"content-length", b"0"))
        if declared > self._max_bytes:
            if b"expect" not in headers:
                await self._drain(receive)
            raise self._too_large()
        parts: list[bytes] = []
        size, more = 0, True
        started = asyncio.get_running_loop().time()
        try:
            async with asyncio.timeout(self._timeout_s) as deadline:
                while more:
                    part, more = await _next(receive)
                    size += len(part)
                    parts.append(part)
                    if size > self._max_bytes:
                        break
                    if more:
                        deadline.reschedule(started + self._timeout_s + size / LEAST_RATE_BYTES_PER_S)
        except TimeoutError:
            raise late_body(self._timeout_s) from None
        if size > self._max_bytes:
            await self._drain(receive)
            raise self._too_large()
        return parts[0] if len(parts) == 1 else b"".join(parts)

    async def _drain(self, receive: Receive) -> None:
        """Discard some more of a body that is too large, so that its sender gets to read the answer."""
        left, more = DRAIN_FACTOR * self._max_bytes, True
        try:
            async with asyncio.timeout(DRAIN_S):
                while more and left > 0:
                    part, more = await _next(receive)
                    left -= len(part)
        except TimeoutError:
            return

    def _too_large(self) -> Problem:
        return Problem(413, f"the body is larger than {self._max_bytes} bytes; send smaller batches")


def refused(error: Refusal) -> Response:
    """Return the answer to a body that was not read to its end: nothing else can be read from that connection."""
    return problem(status_of(error), error.detail, error.errors, headers={"Connection": "close"})


class Gone(Exception):
    """The caller hung up in the middle of its body: nobody is left to answer."""


async def _next(receive: Receive) -> tuple[bytes, bool]:
    message = await receive()
    if message["type"] == "http.disconnect":
        raise Gone
    return message.get("body", b""), message.get("more_body", False)


def _replay(body: bytes, receive: Receive) -> Receive:
    """Return a ``receive`` that yields the whole body once, then whatever the server says."""
    pending = True

    async def replayed() -> Message:
        nonlocal pending
        if pending:
            pending = False
            return {"type": "http.request", "body": body, "more_body": False}
        return await receive()

    return replayed


async def _decode(body: bytes, encoding: bytes, max_bytes: int) -> bytes:
    """Return the body without its content encoding, never growing beyond ``max_bytes``."""
    if encoding not in (b"gzip", b"x-gzip"):
        raise Problem(415, "content-encoding must be gzip or absent")
    if len(body) > DECODE_APART_BYTES:
        return await asyncio.to_thread(_gunzip, body, max_bytes)
    return _gunzip(body, max_bytes)


def _gunzip(body: bytes, max_bytes: int) -> bytes:
    """Return what all members hold; several may follow one another (RFC 1952)."""
    parts: list[bytes] = []
    size, rest = 0, memoryview(body)
    while rest or not parts:
        decoder = zlib.decompressobj(wbits=31)
        while not decoder.eof:
            piece = rest[:PIECE_BYTES]  # what lies behind the end of a member is copied: let that be little
            if not piece:
                raise Problem(
                    400, "body: is not one complete gzip stream", [("body", "is not one complete gzip stream")]
                )
            try:
                parts.append(decoder.decompress(piece, max_bytes + 1 - size))
            except zlib.error:
                raise Problem(400, "body: is not valid gzip", [("body", "is not valid gzip")]) from None
            size += len(parts[-1])
            if size > max_bytes:
                raise Problem(
                    413, f"the body is larger than {max_bytes} bytes after decompression; send smaller batches"
                )
            rest = rest[len(piece) - len(decoder.unused_data) :]
    return b"".join(parts)
