"""The audit layer: every request that changes something, and every one that was refused for its key, leaves a line."""

import logging
import re
import time
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import short
from service.instants import now_us
from service.store import audit

log = logging.getLogger("service.audit")

CHANGES = frozenset({"POST", "PUT", "PATCH", "DELETE"})
NO_CHANGE = re.compile(r"/v1/twins/[^/]*/(telemetry|forecasts)")
"""Ingest is telemetry's own record, and a forecast changes nothing."""
MOST_REFUSED = 60
"""Refused requests that are written down per minute: strangers must not fill the disk. The log has all of them."""


class Audit:
    """ASGI layer in front of the gate."""

    def __init__(self, app: ASGIApp) -> None:
        """Stand in front of an application whose scope tells who called."""
        self._app = app
        self._minute, self._refused = 0, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and note what became of it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        status = 0

        async def watched(message: Message) -> None:
            nonlocal status
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                status = message["status"]
            await send(message)

        try:
            await self._app(scope, receive, watched)
        finally:
            method, path = scope.get("method", "WEBSOCKET"), scope["path"]
            is_change = method in CHANGES and not (method == "POST" and NO_CHANGE.fullmatch(path))
            if status in (401, 403):
                self._write(scope, method, path, status, refused=True)
            elif is_change and 0 < status < 500:
                self._write(scope, method, path, status)

    def _write(self, scope: Scope, method: str, path: str, status: int, *, refused: bool = False) -> None:
        state: dict[str, Any] = scope.get("state") or {}
        who, client = state.get("who", "unknown"), (scope.get("client") or ("", 0))[0]
        told = "; ".join(part for part in (scope["query_string"].decode("latin-1"), state.get("told")) if part)
        line = (who, method, short(path, 200), status, client, short(told, 200))
        if refused:
            line = (*line[:5], "")  # a query may hold a key
        names = ("who", "method", "path", "status", "client", "detail")
        log.info(
            "refused" if refused else "changed" if status < 400 else "not changed",
            extra=dict(zip(names, line, strict=True)),
        )
        if refused and not self._has_room():
            return
        service = getattr(scope["app"].state, "service", None)
        if service is not None:
            service.database.submit_then(_ignore, audit.append, now_us(), *line)

    def _has_room(self) -> bool:
        minute = int(time.monotonic() // 60)
        self._refused = self._refused + 1 if minute == self._minute else 1
        self._minute = minute
        return self._refused <= MOST_REFUSED


def _ignore(_: Any, error: BaseException | None) -> None:
    if error is not None:
        log.error("a line of the audit log was not stored", extra={"reason": str(error)})
