"""A lane of its own for plain ingest: what the layers in front of the route do for such a request, done at once.

A dozen layers cost more than taking a few samples in. Whatever is not plain, or is refused before its body is read, goes the
ordinary way, so that each of those refusals has one place.
"""

import time

from fastapi import FastAPI
from starlette.types import Receive, Scope, Send

from service.errors import Refusal
from service.http import problems
from service.http.auth import Gate
from service.http.body_limit import Bodies, Gone, refused
from service.http.observe import Observe
from service.http.routes import telemetry
from service.http.routes.telemetry import Parser
from service.keys import Role
from service.monitoring import tracing

BEFORE, AFTER = telemetry.PREFIX.split("{twin}")
LENGTH, TYPE = b"content-length", b"content-type"
PLAIN = frozenset(
    {LENGTH, TYPE, b"host", b"authorization", b"connection", b"user-agent", b"accept", b"accept-encoding"}
    | {b"accept-language", b"x-request-id", b"x-real-ip", b"x-forwarded-for", b"x-forwarded-proto", b"x-forwarded-host"}
)
"""Headers that ask for nothing out of the ordinary."""


class Application(FastAPI):
    """The application, with a lane past its layers."""

    lane: "Lane | None" = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if self.lane is None or not await self.lane.took(self, scope, receive, send):
            await super().__call__(scope, receive, send)


class Lane:
    """Takes samples in past the layers, of which it asks the same questions."""

    def __init__(self, gate: Gate, bodies: Bodies, observe: Observe) -> None:
        """Ask the gate who may pass, let bodies be read and requests be counted as everywhere."""
        self._gate, self._bodies, self._observe = gate, bodies, observe

    async def took(self, app: FastAPI, scope: Scope, receive: Receive, send: Send) -> bool:
        """Answer a request that brings samples and is plain; return False, and touch nothing of it, if it is another one."""
        if scope["type"] != "http" or scope["method"] != "POST" or scope["query_string"] or tracing.is_on():
            return False
        name = _twin_in(scope["path"])
        headers = dict(scope["headers"])
        if name is None or LENGTH not in headers or TYPE not in headers or len(headers) < len(scope["headers"]):
            return False
        parse = telemetry.parser_of(headers[TYPE].decode("latin-1"))
        if parse is None or not PLAIN.issuperset(headers) or (self._gate.role(scope, headers) or 0) < Role.ingest:
            return False
        await self._answer(app, name, headers, parse, scope, receive, send)
        return True

    async def _answer(
        self,
        app: FastAPI,
        name: str,
        headers: dict[bytes, bytes],
        parse: Parser,
        scope: Scope,
        receive: Receive,
        send: Send,
    ) -> None:
        started_s = time.perf_counter()
        try:
            body = await self._bodies.read(headers, receive)
        except Refusal as error:
            response = refused(error)
        except Gone:
            return
        else:
            try:
                told = await telemetry.taken(app.state.service, name, parse, body)
            except problems.TOLD as error:
                response = problems.answer(error)
            except Exception as error:
                response = problems.crashed(scope["path"], error)
            else:
                self._observe.count("POST", telemetry.PREFIX, 200, started_s)
                head = [(LENGTH, b"%d" % len(told)), (TYPE, b"application/json")]
                await send({"type": "http.response.start", "status": 200, "headers": head})
                await send({"type": "http.response.body", "body": told})
                return
        self._observe.count("POST", telemetry.PREFIX, response.status_code, started_s)
        await response(scope, receive, send)


def _twin_in(path: str) -> str | None:
    """Return the twin that a path to the telemetry of one names."""
    if not (path.startswith(BEFORE) and path.endswith(AFTER)):
        return None
    name = path[len(BEFORE) : -len(AFTER)]
    return name if name and "/" not in name else None
