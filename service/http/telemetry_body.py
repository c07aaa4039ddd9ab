"""Telemetry bodies -> one batch of arrays: JSON columns or NDJSON frames, refused whole if anything is malformed."""

import contextlib
import json
import struct
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Any, NoReturn, TypeVar

import numpy as np
import orjson
from numpy.typing import NDArray

from service.errors import BadField, short
from service.http.problems import Problem
from service.instants import parse_instants
from service.store.batch import MOST_VALUES, Batch

T = TypeVar("T")


Units = Mapping[str, str | None]
"""Channel -> unit, in the order of the rows."""
TOLD_BY_THE_ARCHIVE = frozenset({"time", "values", "units", "samples", "downsampled"})
"""What the archive answers can be sent to ingest: units are compared, the others say nothing about the samples."""


def parse_columns(body: bytes, channels: Units) -> Batch:
    """Return the batch of ``{"time": [...], "values": {channel: [...]}}``; ``units`` may stand beside them.

    Raises
    ------
    Problem
        400 if the body is not JSON, 413 if it holds too many samples, 422 naming the field otherwise.
    """
    document = _load(body, "body")
    times, columns = _members(document, "", TOLD_BY_THE_ARCHIVE)
    units = document.get("units", {})
    if not isinstance(times, list):
        raise BadField("time", "must be a list")
    _check_units(units, channels)
    texts = len(document) + len(columns) + len(units) + sum(unit is not None for unit in units.values())
    _refuse_repeated(body, texts + [*map(type, times)].count(str), "")
    n_times, names = len(times), list(channels)
    _refuse_vast(n_times, channels)
    for name, column in columns.items():
        if name not in channels or type(column) is not list or len(column) != n_times:
            _refuse_column(name, column, n_times, channels)
    matrix = _matrix(columns, may_hold_booleans=b"true" in body or b"false" in body) if columns else None
    if matrix is not None and list(columns) == names:
        return Batch(parse_instants(times), matrix)
    values = np.full((len(names), n_times), np.nan)
    if matrix is not None:
        values[[names.index(name) for name in columns]] = matrix
    return Batch(parse_instants(times), values)


def _refuse_vast(n_times: int, channels: Units) -> None:
    """Refuse more samples than memory and store have room for (413)."""
    if n_times * len(channels) > MOST_VALUES:
        most = MOST_VALUES // len(channels)
        raise Problem(413, f"the body holds {n_times} samples, at most {most} fit; send smaller batches")


def _refuse_column(name: str, column: Any, n_times: int, channels: Units) -> NoReturn:
    """Say what is wrong with a column."""
    _position(channels, name, f"values.{name}")
    if not isinstance(column, list):
        raise BadField(f"values.{name}", "must be a list with one value or null per time")
    raise BadField(f"values.{name}", f"has {len(column)} values, time has {n_times}")


def _check_units(units: Any, channels: Units) -> None:
    """Refuse values in another unit than the channel's."""
    if not isinstance(units, dict):
        raise BadField("units", "must be an object with one member per channel")
    for name, unit in units.items():
        declared = _position(channels, name, f"units.{name}")
        if unit != declared:
            raise BadField(
                f"units.{name}", f"is {_show(unit)}, the channel is in {_show(declared)}; convert the values"
            )


def _show(value: Any) -> str:
    return json.dumps(value)[:60]


def _matrix(columns: dict[str, list[Any]], *, may_hold_booleans: bool) -> NDArray[np.float64]:
    """Return equally long columns as one array, (n_columns, n_times); the slow way where not all are finite numbers.

    Packing takes a third of the time of looking at types, and refuses all that is no number but true and false.
    """
    if not may_hold_booleans:
        numbers = [*chain.from_iterable(columns.values())]
        with contextlib.suppress(struct.error, OverflowError):
            matrix = np.frombuffer(struct.pack(f"{len(numbers)}d", *numbers)).reshape(len(columns), -1)
            if np.isfinite(matrix).all():
                return matrix
    return np.stack([_numbers(column, partial(_element, name)) for name, column in columns.items()])


def parse_frames(body: bytes, channels: Units) -> Batch:
    """Return the batch of NDJSON frames ``{"time": ..., "values": {channel: ...}}``, one per line.

    Raises
    ------
    Problem
        400 naming the line that is not JSON, 413 if there are too many, 422 naming line and field otherwise.
    """
    lines = [(number, line) for number, line in enumerate(body.split(b"\n"), start=1) if line.strip()]
    _refuse_vast(len(lines), channels)
    frames = [_members(_load(line, f"line {number}"), f"line {number}: ") for number, line in lines]
    n_texts = [2 + len(sample) + (type(time) is str) for time, sample in frames]
    if body.count(b'"') != 2 * sum(n_texts):
        for (number, line), n in zip(lines, n_texts, strict=True):
            _refuse_repeated(line, n, f"line {number}: ")
    known = set(channels)
    for (number, _), (_, sample) in zip(lines, frames, strict=True):
        if not known.issuperset(sample):
            stranger = next(name for name in sample if name not in known)
            _position(channels, stranger, f"line {number}: values.{stranger}")
    values = np.full((len(channels), len(frames)), np.nan)
    for row, name in enumerate(channels):
        column = [sample.get(name) for _, sample in frames]
        values[row] = _numbers(column, partial(_line_field, lines, name))
    try:
        return Batch(parse_instants([time for time, _ in frames]), values)
    except BadField as error:
        field, reason = error.errors[0]
        index = int(field.removeprefix("time[").removesuffix("]"))
        raise BadField(f"line {lines[index][0]}: time", reason) from None


def _load(body: bytes, where: str) -> Any:
    try:
        return orjson.loads(body)
    except orjson.JSONDecodeError as error:
        field = find_non_finite(body)
        if field is not None:
            raise BadField(field if where == "body" else f"{where}: {field}", "is not a finite number") from None
        raise Problem(
            400, f"{where}: not valid JSON ({error.msg.split(':')[0]})", [(where, "not valid JSON")]
        ) from None


def _refuse_repeated(body: bytes, n_texts: int, prefix: str) -> None:
    """Refuse a name that stands twice in one object, of which the parser keeps the last (422 naming it).

    Counting quotation marks is quick; only a body with others than those of the names and texts that the parser found
    is read again.
    """
    if body.count(b'"') == 2 * n_texts:
        return
    try:
        json.loads(body, object_pairs_hook=partial(_refuse_repeated_in, prefix), parse_int=float)
    except RecursionError:
        raise BadField(f"{prefix}body", "is nested too deeply") from None


def _refuse_repeated_in(prefix: str, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in pairs:
        if name in found:
            field = name if name in TOLD_BY_THE_ARCHIVE else f"values.{name}"
            raise BadField(f"{prefix}{field}", "appears twice")
        found[name] = value
    return found


def find_non_finite(body: bytes) -> str | None:
    """Return the place of the first NaN, Infinity or overflowing number, if that is what is wrong with the body."""
    try:
        return _search(json.loads(body), "")
    except (ValueError, RecursionError):
        return None


def _search(item: Any, where: str) -> str | None:
    if isinstance(item, float):
        return (where or "body") if not np.isfinite(item) else None
    if isinstance(item, dict):
        children = ((child, f"{where}.{key}" if where else key) for key, child in item.items())
    elif isinstance(item, list):
        children = ((child, f"{where}[{index}]") for index, child in enumerate(item))
    else:
        return None
    return next((found for child, place in children if (found := _search(child, place))), None)


def _members(
    document: Any, prefix: str, known: frozenset[str] = frozenset({"time", "values"})
) -> tuple[Any, dict[str, Any]]:
    """Return the two members that a body or frame must have, and refuse any other."""
    if not isinstance(document, dict):
        raise BadField(f"{prefix}body", 'must be an object {"time": ..., "values": {...}}')
    for name in ("time", "values"):
        if name not in document:
            raise BadField(f"{prefix}{name}", "is missing")
    if not known.issuperset(document):
        stranger = next(name for name in document if name not in known)
        raise BadField(f"{prefix}{stranger}", "unknown field; only time and values are expected")
    if not isinstance(document["values"], dict):
        raise BadField(f"{prefix}values", "must be an object with one member per channel")
    return document["time"], document["values"]


def _position(known: Mapping[str, T], name: str, field: str) -> T:
    if name not in known:
        raise BadField(field, f"unknown channel '{short(name)}' (known: {', '.join(known)})")
    return known[name]


def _element(name: str, index: int) -> str:
    return f"values.{name}[{index}]"


def _line_field(lines: Sequence[tuple[int, bytes]], name: str, index: int) -> str:
    return f"line {lines[index][0]}: values.{name}"


_NUMBERS = {float, int, type(None)}


def _numbers(column: list[Any], field: Callable[[int], str]) -> NDArray[np.float64]:
    """Return finite numbers with NaN for null, (n_times,); text and booleans are not numbers."""
    if not _NUMBERS.issuperset(map(type, column)):
        index = next(i for i, value in enumerate(column) if type(value) not in _NUMBERS)
        raise BadField(field(index), f"must be a finite number or null, got {_show(column[index])}")
    numbers = np.array(column, dtype=np.float64)
    if np.isinf(numbers).any():
        raise BadField(field(int(np.argmax(np.isinf(numbers)))), "is not a finite number")
    return numbers
