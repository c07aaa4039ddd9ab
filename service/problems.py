"""Errors on the wire: ``application/problem+json`` (RFC 9457), for everything that can go wrong."""

import logging
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

import orjson
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response

from service.store.gone import TwinGone
from twin_core.errors import TwinError

MEDIA_TYPE = "application/problem+json"
log = logging.getLogger("service")

_UNREADABLE = "There was an error parsing the body"
"""What FastAPI says of a body that its parser cannot cope with, such as one that is nested too deeply."""

FieldErrors = Sequence[tuple[str, str]]


class Problem(Exception):
    """A request that is answered with a problem document."""

    def __init__(self, status: int, detail: str, errors: FieldErrors = ()) -> None:
        """Remember the status, one clear line and the fields to blame as (field, what is wrong)."""
        super().__init__(detail)
        self.status, self.detail, self.errors = status, detail, errors


class BadField(Problem):
    """One field of a request is wrong (422)."""

    def __init__(self, field: str, reason: str, status: int = 422) -> None:
        """Name the field as the caller wrote it."""
        super().__init__(status, f"{field}: {reason}", [(field, reason)])


def document(status: int, detail: str, errors: FieldErrors = ()) -> bytes:
    """Return the document of one problem."""
    content: dict[str, Any] = {
        "type": "about:blank",
        "title": HTTPStatus(status).phrase,
        "status": status,
        "detail": detail,
    }
    if errors:
        content["errors"] = [{"field": field, "detail": reason} for field, reason in errors]
    return orjson.dumps(content)


def problem(status: int, detail: str, errors: FieldErrors = (), headers: Mapping[str, str] | None = None) -> Response:
    """Return the response for one problem."""
    return Response(document(status, detail, errors), status, dict(headers or {}), MEDIA_TYPE)


def install(app: FastAPI) -> None:
    """Answer every error of the application with a problem document."""
    app.add_exception_handler(Problem, _on_problem)
    app.add_exception_handler(HTTPException, _on_http)
    app.add_exception_handler(RequestValidationError, _on_validation)
    app.add_exception_handler(TwinError, _on_twin_error)
    app.add_exception_handler(TwinGone, _on_gone)
    app.add_exception_handler(Exception, _on_crash)


async def _on_problem(_: Request, error: Exception) -> Response:
    assert isinstance(error, Problem)
    return problem(error.status, error.detail, error.errors)


async def _on_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    detail = error.detail
    if error.status_code == 404 and detail == "Not Found":
        detail = f"no such resource: {request.url.path}"
    elif error.status_code == 400 and detail == _UNREADABLE:
        return problem(400, "body: not valid JSON", [("body", "not valid JSON")])
    elif error.status_code == 405:
        detail = f"{request.method} is not possible here"
    return problem(error.status_code, str(detail), headers=error.headers)


async def _on_validation(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    media = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if not _is_json(media) and any(
        item["loc"] == ("body",) and isinstance(item["input"], bytes) for item in error.errors()
    ):
        return problem(415, f"content-type must be application/json, got '{media[:60]}'")
    if any(item["type"] == "json_invalid" for item in error.errors()):
        return problem(400, "body: not valid JSON", [("body", "not valid JSON")])
    errors = [(_field(item["loc"]), item["msg"].removeprefix("Value error, ")) for item in error.errors()]
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


async def _on_twin_error(_: Request, error: Exception) -> Response:
    field, separator, reason = str(error).partition(": ")
    errors = [(field, reason)] if separator and " " not in field else []
    return problem(422, str(error), errors)


async def _on_gone(_: Request, error: Exception) -> Response:
    return problem(404, "the twin was deleted meanwhile")


async def _on_crash(request: Request, error: Exception) -> Response:
    log.error("unexpected error", exc_info=error, extra={"path": request.url.path})
    return problem(500, "unexpected error; it has been logged")
