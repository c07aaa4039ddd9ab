"""Streams: the same numbered messages over a web socket and as server-sent events."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Annotated

import orjson
from fastapi import APIRouter, Header, Query, WebSocket, WebSocketDisconnect
from starlette.responses import StreamingResponse

from service.errors import BadField
from service.http.auth import SUBPROTOCOL
from service.http.deps import NamedTwin, Running, reads
from service.stream.hub import Hub
from service.stream.messages import Json
from service.twins.registry import Entry

router = APIRouter(prefix="/v1/twins/{twin}", tags=["streams"])

AfterSeq = Annotated[int | None, Query(ge=0, le=2**62, description="Number of the last message already seen.")]


@router.get("/events", dependencies=[reads], response_class=StreamingResponse)
async def events(
    service: Running,
    twin: NamedTwin,
    after_seq: AfterSeq = None,
    last_event_id: Annotated[str | None, Header(description="What a browser sends when it reconnects.")] = None,
) -> StreamingResponse:
    """Stream samples, residuals, anomalies, jobs and model switches as server-sent events."""
    if last_event_id:
        if not last_event_id.isdecimal() or len(last_event_id) > 18:
            raise BadField("Last-Event-ID", "must be the number of a message")
        after_seq = int(last_event_id)
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(
        _server_sent(service.hub, twin, after_seq), headers=headers, media_type="text/event-stream"
    )


async def _server_sent(hub: Hub, twin: Entry, after_seq: int | None) -> AsyncIterator[bytes]:
    yield b"retry: 2000\n\n"
    async for piece in hub.follow(twin, after_seq):
        yield b"".join(map(_event, piece)) or b": still here\n\n"


def _event(message: Json) -> bytes:
    return b"id: %d\ndata: %b\n\n" % (message["seq"], orjson.dumps(message))


@router.websocket("/stream")
async def stream(socket: WebSocket, service: Running, twin: NamedTwin, after_seq: AfterSeq = None) -> None:
    """Stream the same messages, one JSON text each."""
    offered = socket.scope.get("subprotocols", [])
    await socket.accept(subprotocol=next((p for p in offered if p.startswith(SUBPROTOCOL)), None))
    sender = asyncio.create_task(_send(socket, service.hub, twin, after_seq))
    listener = asyncio.create_task(_listen(socket))
    await asyncio.wait([sender, listener], return_when=asyncio.FIRST_COMPLETED)
    for task in (sender, listener):
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect):
            await task
    if not listener.cancelled():
        return
    with contextlib.suppress(RuntimeError):  # the peer may have gone at the same moment
        await socket.close(1001, "the stream has ended")


async def _send(socket: WebSocket, hub: Hub, twin: Entry, after_seq: int | None) -> None:
    async for piece in hub.follow(twin, after_seq):
        for message in piece:
            await socket.send_text(orjson.dumps(message).decode())


async def _listen(socket: WebSocket) -> None:
    """Return when the reader goes; what it says is ignored."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        continue
