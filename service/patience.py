"""Connections that open and then say too little, too slowly, are closed: they would otherwise be kept for ever."""

import asyncio
from typing import Any, ClassVar

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.problems import MEDIA_TYPE, document


class PatientProtocol(H11Protocol):
    """HTTP/1.1 whose request heads must be complete within ``patience_s``; bodies have a limit of their own."""

    patience_s: ClassVar[float] = 30.0
    _deadline: asyncio.TimerHandle | None = None

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
        if self._deadline is None and self.conn.their_state is h11.IDLE:
            self._wait()
        before = self.cycle
        super().data_received(data)
        if self.cycle is not before:
            self._stop()

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP as every other error is answered."""
        body = document(400, msg)
        headers = [("content-type", MEDIA_TYPE), ("content-length", str(len(body))), ("connection", "close")]
        for event in (h11.Response(status_code=400, headers=headers), h11.Data(data=body), h11.EndOfMessage()):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Wait no more: the head was complete."""
        self._stop()
        super().handle_websocket_upgrade(event)

    def _wait(self) -> None:
        self._deadline = self.loop.call_later(self.patience_s, self.transport.close)

    def _stop(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


def patient(patience_s: float) -> type[PatientProtocol]:
    """Return the protocol with a patience of its own."""
    return type("PatientProtocol", (PatientProtocol,), {"patience_s": patience_s})
