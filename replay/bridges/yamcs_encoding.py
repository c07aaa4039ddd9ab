"""Rows on the way to and from Yamcs, as its interface spells them.

Yamcs' client carries protocol buffers written in Python, 0.2 to 0.4 ms per value in either direction, which would limit
the bridge to some 2,000 values per second. What is many goes another way: updates are encoded here, value by value the same
bytes, and archives are asked for as JSON.
"""

import json
import struct
from codecs import getincrementaldecoder
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from yamcs.protobuf import yamcs_pb2
from yamcs.protobuf.pvalue.pvalue_service_pb2 import LoadParameterValuesRequest, ParameterValueUpdate

from replay.bridges.instants import to_ms

CHUNK = 64 * 1024
"""Bytes that are sent or read at a time, about."""
USABLE = "ACQUIRED"
"""Status of a value that is a reading; others are invalid, expired or were never received."""
_NUMBERS = {
    "DOUBLE": "doubleValue",
    "FLOAT": "floatValue",
    "SINT32": "sint32Value",
    "UINT32": "uint32Value",
    "SINT64": "sint64Value",
    "UINT64": "uint64Value",
    "BOOLEAN": "booleanValue",
}
"""Type of a value -> member that holds it, of those that are numbers; 64 bits come as text."""
_VARINT, _FIXED64, _BYTES = 0, 1, 2
"""Wire types of protocol buffers, https://protobuf.dev/programming-guides/encoding."""


@dataclass(frozen=True)
class Row:
    """Values of one generation time, in milliseconds, by qualified name."""

    time_ms: int
    values: Mapping[str, float | str]


def _varint(number: int) -> bytes:
    found = bytearray()
    while number > 0x7F:
        found.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*found, number])


def _tag(message: Any, field: str, wire_type: int) -> bytes:
    return _varint(message.DESCRIPTOR.fields_by_name[field].number << 3 | wire_type)


def _block(tag: bytes, body: bytes) -> bytes:
    return tag + _varint(len(body)) + body


_Value = yamcs_pb2.Value
_UPDATE = _tag(LoadParameterValuesRequest, "values", _BYTES)
_NAME, _VALUE, _WHEN = (_tag(ParameterValueUpdate, f, _BYTES) for f in ("parameter", "value", "generationTime"))
_TYPE = _tag(_Value, "type", _VARINT)
_IS_DOUBLE = _TYPE + _varint(_Value.DOUBLE) + _tag(_Value, "doubleValue", _FIXED64)
_IS_TEXT = _TYPE + _varint(_Value.STRING) + _tag(_Value, "stringValue", _BYTES)
_SECONDS, _NANOS = b"\x08", b"\x10"  # fields 1 and 2 of google.protobuf.Timestamp, varints


def updates(rows: Iterable[Row]) -> Iterator[bytes]:
    """Yield rows as chunks of length-delimited ``LoadParameterValuesRequest``, one message per row."""
    names: dict[str, bytes] = {}
    chunk = bytearray()
    for row in rows:
        message = bytearray()
        when = _block(_WHEN, _timestamp(row.time_ms))
        for name, value in row.values.items():
            if name not in names:
                names[name] = _block(_NAME, name.encode())
            message += _block(_UPDATE, names[name] + _block(_VALUE, _value(value)) + when)
        chunk += _varint(len(message)) + message
        if len(chunk) >= CHUNK:
            yield bytes(chunk)
            chunk.clear()
    if chunk:
        yield bytes(chunk)


def _value(value: float | str) -> bytes:
    if isinstance(value, str):
        data = value.encode()
        return _IS_TEXT + _varint(len(data)) + data
    return _IS_DOUBLE + struct.pack("<d", value)


def _timestamp(time_ms: int) -> bytes:
    seconds, rest_ms = divmod(time_ms, 1000)
    found = b""  # zero is left out; a negative number of seconds is spelled as 64 bits
    if seconds:
        found += _SECONDS + _varint(seconds & 0xFFFF_FFFF_FFFF_FFFF)
    return found + (_NANOS + _varint(1_000_000 * rest_ms) if rest_ms else b"")


def messages(chunks: Iterable[bytes]) -> Iterator[Any]:
    """Yield JSON documents that follow one another; ValueError if the last one is incomplete."""
    scan, characters, text = json.JSONDecoder().raw_decode, getincrementaldecoder("utf-8")(), ""
    for chunk in chunks:
        text = (text + characters.decode(chunk)).lstrip()
        at = 0
        while at < len(text):
            try:
                document, at = scan(text, at)
            except ValueError:
                break  # the rest of it is under way
            yield document
            while text[at : at + 1].isspace():
                at += 1
        text = text[at:]
    if text:
        raise ValueError(f"the answer ends within a document: {text[:40]!r}")


def rows_of(document: Mapping[str, Any]) -> Iterator[Row]:
    """Yield what a JSON ``ParameterData`` holds, one row per generation time; what is no reading or no number is left out."""
    rows: dict[str, dict[str, float | str]] = {}
    for value in document.get("parameter", ()):
        number = _number(value)
        if number is not None and value.get("acquisitionStatus", USABLE) == USABLE:
            identity = value["id"]
            space = identity.get("namespace")
            name = f"{space}/{identity['name']}" if space else identity["name"]
            rows.setdefault(value["generationTime"], {})[name] = number
    found = [Row(to_ms(datetime.fromisoformat(time)), values) for time, values in rows.items()]
    yield from sorted(found, key=lambda row: row.time_ms)


def _number(value: Mapping[str, Any]) -> float | None:
    """Return a value as a number: states by their raw value."""
    for candidate in (value.get("engValue"), value.get("rawValue")):
        if candidate is not None and candidate["type"] in _NUMBERS:
            number = float(candidate[_NUMBERS[candidate["type"]]])
            if abs(number) < float("inf"):
                return number
    return None
