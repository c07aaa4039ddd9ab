"""Errors on the wire: ``application/problem+json`` (RFC 9457), for everything that can go wrong."""

import logging
import re
from collections.abc import Mapping, Sequence
from http import HTTPMethod, HTTPStatus
from typing import Any

import orjson
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError, WebSocketRequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import Match, Mount
from starlette.types import Receive, Scope, Send

from service.errors import LONGEST_LINE, LONGEST_NAME, BadField, FieldErrors, NotYet, Refusal, TooLittle, TooMuch, short
from service.live.engine import WorkerDied
from service.store.errors import Conflicting, DiskFull, Missing, TwinGone, Unavailable
from twin_core.errors import TwinError

_LONG = re.compile(rf"[^\s']{{{LONGEST_NAME + 1},}}")
MOST_ERRORS = 20
RETRY_S = 1
"""After so long it is worth asking again: a database that is away is looked for as often."""
MEDIA_TYPE = "application/problem+json"
log = logging.getLogger("service")

_UNREADABLE = "There was an error parsing the body"
"""What FastAPI says of a body that its parser cannot cope with, such as one that is nested too deeply."""


class Problem(Refusal):
    """A request that is answered with a problem document of one status."""

    def __init__(self, status: int, detail: str, errors: FieldErrors = ()) -> None:
        """Remember the status, one clear line and the fields to blame as (field, what is wrong)."""
        super().__init__(detail, errors)
        self.status = status


def late_body(timeout_s: float) -> Problem:
    """Return the refusal of a body that takes too long to arrive."""
    return Problem(408, f"the body did not arrive within {timeout_s:g} s")


STATUS: Mapping[type[Refusal], int] = {
    BadField: 422,
    TooLittle: 422,
    TooMuch: 429,
    Missing: 404,
    Conflicting: 409,
    DiskFull: 507,
    Unavailable: 503,
    WorkerDied: 503,
}
"""What each refusal is in HTTP."""


def status_of(error: Refusal) -> int:
    """Return the status that a refusal is answered with."""
    if isinstance(error, Problem):
        return error.status
    return next((status for kind, status in STATUS.items() if isinstance(error, kind)), 409)


def document(status: int, detail: str, errors: FieldErrors = ()) -> bytes:
    """Return the document of one problem."""
    content: dict[str, Any] = {
        "type": "about:blank",
        "title": HTTPStatus(status).phrase,
        "status": status,
        "detail": _told(detail),
    }
    if errors:
        content["errors"] = [{"field": short(field), "detail": _told(reason)} for field, reason in errors[:MOST_ERRORS]]
    return orjson.dumps(content)


def _told(line: str) -> str:
    """Return a line in which no name is repeated at length."""
    return short(_LONG.sub(lambda found: short(found[0]), line[: 10 * LONGEST_LINE]), LONGEST_LINE)


def problem(status: int, detail: str, errors: FieldErrors = (), headers: Mapping[str, str] | None = None) -> Response:
    """Return the response for one problem."""
    return Response(document(status, detail, errors), status, dict(headers or {}), MEDIA_TYPE)


def install(app: FastAPI) -> None:
    """Answer every error of the application with a problem document."""
    for kind in TOLD:
        app.add_exception_handler(kind, _on_told)
    app.add_exception_handler(HTTPException, _on_http)
    app.add_exception_handler(RequestValidationError, _on_validation)
    app.add_exception_handler(WebSocketRequestValidationError, _on_socket_validation)
    app.add_exception_handler(Exception, _on_crash)
    app.router.default = _nothing_there


TOLD = (Refusal, TwinError, TwinGone)
"""Errors that say what the caller did wrong, or what became of what it asked for."""


def answer(error: Exception) -> Response:
    """Return the response for one of these errors."""
    if isinstance(error, Refusal):
        status = status_of(error)
        headers = {"Retry-After": str(RETRY_S)} if status == 503 or isinstance(error, NotYet) else None
        return problem(status, error.detail, error.errors, headers)
    if isinstance(error, TwinGone):
        return problem(404, "the twin was deleted meanwhile")
    assert isinstance(error, TwinError)
    return problem(422, str(error), fields_of(error))


def fields_of(error: TwinError) -> FieldErrors:
    """Return the fields that an error of the core names."""
    told = [line.partition(": ") for line in getattr(error, "problems", (str(error),))]
    return [(field, reason) for field, separator, reason in told if separator and " " not in field]


async def _nothing_there(scope: Scope, receive: Receive, send: Send) -> None:
    """Refuse a path that leads nowhere; the framework would close web sockets there without a word."""
    raise HTTPException(404)


async def _on_told(_: Request, error: Exception) -> Response:
    return answer(error)


async def _on_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    detail = error.detail
    if error.status_code == 404 and detail == "Not Found":
        detail = f"no such resource: {request.url.path}"
    elif error.status_code == 400 and detail == _UNREADABLE:
        return problem(400, "body: not valid JSON", [("body", "not valid JSON")])
    elif error.status_code == 405:
        return problem(405, f"{request.method} is not possible here", headers={"Allow": _allowed(request)})
    return problem(error.status_code, str(detail), headers=error.headers)


def _allowed(request: Request) -> str:
    """Return the methods of every route on the request's path; the framework knows those of one route only."""
    methods = {method.value for method in HTTPMethod if _takes(request, method)}
    methods = methods or {"GET"}  # a mounted folder of files
    if "GET" in methods:
        methods.add("HEAD")
    return ", ".join(sorted(methods))


def _takes(request: Request, method: str) -> bool:
    scope = {**request.scope, "method": method}
    routes = (route for route in request.app.routes if not isinstance(route, Mount))
    return any(route.matches(dict(scope))[0] is Match.FULL for route in routes)


async def _on_validation(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    media = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if not _is_json(media) and any(
        item["loc"] == ("body",) and isinstance(item["input"], bytes) for item in error.errors()
    ):
        return problem(415, f"content-type must be application/json, got '{media[:60]}'")
    if any(item["type"] == "json_invalid" for item in error.errors()):
        return problem(400, "body: not valid JSON", [("body", "not valid JSON")])
    return _bad_fields(error.errors())


async def _on_socket_validation(_: Request, error: Exception) -> Response:
    assert isinstance(error, WebSocketRequestValidationError)
    return _bad_fields(error.errors())


def _bad_fields(items: Sequence[Any]) -> Response:
    errors = [(_field(item["loc"]), item["msg"].removeprefix("Value error, ")) for item in items]
    return problem(422, "; ".join(f"{field}: {reason}" for field, reason in errors[:3]), errors)


def _is_json(media: str) -> bool:
    return media == "application/json" or media.endswith("+json")


def _field(location: Sequence[str | int]) -> str:
    """Return ``a.b[2]`` for a location such as ('body', 'a', 'b', 2)."""
    parts = location[1:] if location and location[0] in ("body", "query", "path", "header") else location
    text = ""
    for part in parts:
        text += f"[{part}]" if isinstance(part, int) else f"{'.' if text else ''}{part}"
    return text or "body"


async def _on_crash(request: Request, error: Exception) -> Response:
    return crashed(request.url.path, error)


def crashed(path: str, error: BaseException) -> Response:
    """Return the response to a request in which something went wrong that nobody foresaw, and log that."""
    log.error("unexpected error", exc_info=error, extra={"path": path})
    return problem(500, "unexpected error; it has been logged")
