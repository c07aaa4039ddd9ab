"""Specifications as request bodies: JSON or YAML, parsed and checked in a process of their own if they are large."""

import asyncio
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import orjson
from fastapi import Request

from service.errors import FieldErrors
from service.http.problems import Problem, fields_of
from service.http.telemetry_body import find_non_finite
from twin_core.errors import TwinError
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import dump_spec, load_spec, parse_mapping

YAML = ("application/yaml", "application/x-yaml", "text/yaml")
MOST_BYTES = 4 * 2**20
MOST = {"nodes": 5000, "channels": 5000, "conductors": 20_000, "radiators": 20_000, "loads": 20_000, "exclude": 5000}
"""Parts of a specification that a service takes."""
APART_BYTES = 32 * 1024
"""Larger ones take so long to check that the server answers others meanwhile."""
_ITEM = {"schema": {"type": "object"}}
BODY = {"requestBody": {"required": True, "content": {"application/json": _ITEM, "application/yaml": _ITEM}}}


@dataclass(frozen=True)
class Specified:
    """A specification that was checked, and the same as plain data."""

    spec: TwinSpec
    data: dict[str, Any]


async def read_specification(request: Request) -> Specified:
    """Return the specification of a request.

    Raises
    ------
    Problem, SpecError
        If it is neither JSON nor YAML, is too large, or is no specification.
    """
    media = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    is_yaml = media in YAML
    if not is_yaml and media != "application/json" and not media.endswith("+json"):
        raise Problem(415, f"content-type must be application/json or application/yaml, got '{media[:60]}'")
    body = await request.body()
    if len(body) > MOST_BYTES:
        raise Problem(413, f"a specification must not exceed {MOST_BYTES} bytes")
    if len(body) <= (APART_BYTES // 8 if is_yaml else APART_BYTES):
        return parse(body, is_yaml)
    return await _apart(body, is_yaml)


def parse(body: bytes, is_yaml: bool) -> Specified:
    """Return the specification that a body holds."""
    document = _yaml(body) if is_yaml else _json(body)
    for field, most in MOST.items():
        given = document.get(field)
        if isinstance(given, list | dict) and len(given) > most:
            raise Problem(422, f"{field}: are {len(given)}, a twin has at most {most}", [(field, f"at most {most}")])
    spec = load_spec(document)
    return Specified(spec, dump_spec(spec))


def _yaml(body: bytes) -> dict[str, Any]:
    try:
        return parse_mapping(body.decode(), "body", may_repeat=False)
    except UnicodeDecodeError:
        raise Problem(400, "body: is not UTF-8", [("body", "is not UTF-8")]) from None


def _json(body: bytes) -> dict[str, Any]:
    try:
        document = orjson.loads(body)
    except orjson.JSONDecodeError:
        field = find_non_finite(body)
        if field is not None:
            raise Problem(422, f"{field}: is not a finite number", [(field, "is not a finite number")]) from None
        raise Problem(400, "body: not valid JSON", [("body", "not valid JSON")]) from None
    if not isinstance(document, dict):
        raise Problem(422, "body: must be a mapping of fields", [("body", "must be a mapping of fields")])
    return document


async def _apart(body: bytes, is_yaml: bool) -> Specified:
    """Parse in a process of its own: checking thousands of nodes would hold the interpreter, and with it everybody."""
    pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))
    try:
        made = await asyncio.get_running_loop().run_in_executor(pool, _checked, body, is_yaml)
    finally:
        pool.shutdown(wait=False)
    if isinstance(made, Specified):
        return made
    status, detail, errors = made
    raise Problem(status, detail, errors)


def _checked(body: bytes, is_yaml: bool) -> Specified | tuple[int, str, FieldErrors]:
    """Return the specification, or what is wrong with it as what travels between processes."""
    try:
        return parse(body, is_yaml)
    except Problem as error:
        return error.status, error.detail, error.errors
    except TwinError as error:
        return 422, str(error), fields_of(error)
