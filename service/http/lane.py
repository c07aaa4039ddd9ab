"""A lane of its own for plain ingest: from the parser of HTTP to the intake and back, past the layers and the framework.

They cost more than taking a few samples in. Whatever is not plain, or is refused before its body is read, goes the ordinary way,
so that each of those refusals has one place; the others are made by the same functions as there.
"""

import asyncio
import time
from collections.abc import Callable, Sequence

from fastapi import FastAPI

from service.http import problems
from service.http.auth import Gate
from service.http.observe import Observe
from service.http.routes import telemetry
from service.http.routes.telemetry import OUTDATED, Parser
from service.keys import Role
from service.monitoring import tracing
from service.running.service import Service
from service.store.appending import Receipt
from service.twins.registry import Entry

BEFORE, AFTER = (part.encode() for part in telemetry.PREFIX.split("{twin}"))
MOST_BYTES = 64 * 1024
"""Of a body; a longer one is parsed for so long that a shorter way is not noticed."""
LENGTH, TYPE = b"content-length", b"content-type"
PLAIN = frozenset(
    {LENGTH, TYPE, b"host", b"authorization", b"connection", b"user-agent", b"accept", b"accept-encoding"}
    | {b"accept-language", b"x-request-id"}
)
"""Headers that ask for nothing out of the ordinary."""

Headers = Sequence[tuple[bytes, bytes]]
Reply = Callable[[int, Headers, bytes], None]
"""Who is told the answer: its status, its headers and its body."""


class Lane:
    """Takes samples in past the layers, of which it asks the same questions."""

    def __init__(self, app: FastAPI, gate: Gate, observe: Observe, max_body_bytes: int) -> None:
        """Ask the gate who may pass, let requests be counted as everywhere, and hand samples to the running service."""
        self._app, self._gate, self._observe = app, gate, observe
        self._most_bytes = min(MOST_BYTES, max_body_bytes)
        self._under_way: set[asyncio.Task[None]] = set()

    def enters(self, url: bytes, headers: Headers, client: tuple[str, int] | None) -> "Plain | None":
        """Return what answers a POST, None if it is to go the ordinary way."""
        if not (url.startswith(BEFORE) and url.endswith(AFTER)) or tracing.is_on():
            return None
        named = dict(headers)
        length, media = named.get(LENGTH, b""), named.get(TYPE, b"").decode("latin-1")
        if len(named) < len(headers) or not PLAIN.issuperset(named) or not (length.isdigit() and len(length) < 6):
            return None
        service: Service = self._app.state.service
        entry = service.registry.find(url[len(BEFORE) : -len(AFTER)].decode("latin-1"))
        parse = telemetry.parser_of(media)
        if entry is None or parse is None or int(length) > self._most_bytes:
            return None
        role = self._gate.role({"path": url.decode("latin-1"), "client": client}, named)
        return Plain(self, service, entry, parse) if role is not None and role >= Role.ingest else None

    def count(self, status: int, started_s: float) -> None:
        """Note a request that is answered."""
        self._observe.count("POST", telemetry.PREFIX, status, started_s)

    def start(self, request: "Plain") -> None:
        """Let a request be answered beside others."""
        task = asyncio.get_running_loop().create_task(request.try_again())
        self._under_way.add(task)
        task.add_done_callback(self._under_way.discard)


class _Nobody:
    """Who waits for the messages of a request that asks for none."""

    def set(self) -> None:
        """Wake nobody."""


class Plain:
    """One request that brings samples, with what the server's protocol expects of a request."""

    message_event = _Nobody()

    def __init__(self, lane: Lane, service: Service, entry: Entry, parse: Parser) -> None:
        """Wait for the body."""
        self._lane, self._service, self._entry, self._parse = lane, service, entry, parse
        self._started_s = time.perf_counter()
        self.body = bytearray()
        self.more_body, self.keep_alive = True, True
        self.response_complete, self.disconnected = False, False
        self._reply: Reply = _unheard

    def take(self, reply: Reply) -> None:
        """Take the samples in, and let somebody hear what became of them once they are stored."""
        self._reply = reply
        try:
            batch = telemetry.read(self._entry, self._parse, bytes(self.body))
        except Exception as error:
            self._fail(error)
        else:
            self._service.intake.enter(self._entry, batch, self._stored)

    def _stored(self, receipt: Receipt | None, error: BaseException | None) -> None:
        if receipt is not None:
            self._tell(telemetry.report(receipt))
        else:
            self._fail(error)

    def _fail(self, error: BaseException | None) -> None:
        """Say what went wrong, unless that may be because another process changed the twin."""
        if self._service.database.is_shared and isinstance(error, OUTDATED):
            self._lane.start(self)
        else:
            self._refuse(error)

    async def try_again(self) -> None:
        """Take the samples in with the twin as it is now."""
        try:
            report = await telemetry.taken(self._service, self._entry.name, self._parse, bytes(self.body))
        except Exception as error:
            self._refuse(error)
        else:
            self._tell(report)

    def _tell(self, report: bytes) -> None:
        self._lane.count(200, self._started_s)
        self._reply(200, ((LENGTH, b"%d" % len(report)), (TYPE, b"application/json")), report)

    def _refuse(self, error: BaseException | None) -> None:
        response = (
            problems.answer(error)
            if isinstance(error, problems.TOLD)
            else problems.crashed(telemetry.PREFIX, error or RuntimeError("no answer"))
        )
        self._lane.count(response.status_code, self._started_s)
        self._reply(response.status_code, response.raw_headers, bytes(response.body))

    def give_up(self, reply: Reply, timeout_s: float) -> None:
        """Say that the body did not arrive in time."""
        self._reply = reply
        self._refuse(problems.late_body(timeout_s))


def _unheard(_: int, __: Headers, ___: bytes) -> None:
    """Tell nobody."""
