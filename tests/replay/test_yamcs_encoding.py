"""Rows as Yamcs spells them: the oracle is Yamcs' own client, which spells them slowly."""

import json
from typing import Any

import pytest

pytest.importorskip("yamcs")

from yamcs.client import ParameterData
from yamcs.client.core.helpers import delimit_protobuf, to_server_time
from yamcs.client.tmtc.client import _build_value_proto
from yamcs.protobuf._vendor.google.protobuf.json_format import MessageToJson
from yamcs.protobuf.pvalue import pvalue_pb2, pvalue_service_pb2

from replay.bridges.instants import to_datetime
from replay.bridges.yamcs_encoding import CHUNK, Row, messages, rows_of, updates
from replay.bridges.yamcs_gateway import _rows

ROWS = [
    Row(1_772_323_200_000, {"/SAT/T_a": 293.15, "/SAT/T_b": -0.0, "/SAT/state": "CATCHING_UP"}),
    Row(1_772_323_200_001, {"/SAT/T_a": 1e-300, "/SAT/gr\u00fc\u00df": 5.0}),
    Row(0, {"/SAT/T_a": 0.0}),
    Row(-1, {"/SAT/T_a": 1.0, "/SAT/long": "x" * 300}),
    Row(4_102_444_800_999, {}),
]


def test_updates_are_the_bytes_of_the_client() -> None:
    made = []
    for row in ROWS:
        message = pvalue_service_pb2.LoadParameterValuesRequest()
        for name, value in row.values.items():
            item = message.values.add()
            item.parameter = name
            item.value.MergeFrom(_build_value_proto(value))
            item.generationTime.MergeFrom(to_server_time(to_datetime(row.time_ms)))
        made.append(message)
    assert b"".join(updates(ROWS)) == b"".join(delimit_protobuf(iter(made)))


def test_updates_come_in_chunks() -> None:
    rows = [Row(k, {"/SAT/long": "x" * 1000}) for k in range(200)]
    chunks = list(updates(rows))
    assert len(chunks) > 2 and max(map(len, chunks)) < CHUNK + 2000
    assert b"".join(chunks) == b"".join(b"".join(updates([row])) for row in rows)
    assert list(updates([])) == []


def parameter_data() -> Any:
    """Return values of every kind that Yamcs sends: numbers, states, what is invalid, infinite or unknown."""
    data = pvalue_pb2.ParameterData()
    value, status = pvalue_pb2.ParameterValue, pvalue_pb2.AcquisitionStatus
    kinds: list[tuple[str, dict[str, Any], dict[str, Any] | None, str]] = [
        ("double", {"type": "DOUBLE", "doubleValue": 1.5}, None, "ACQUIRED"),
        ("float", {"type": "FLOAT", "floatValue": 0.25}, None, "ACQUIRED"),
        ("sint64", {"type": "SINT64", "sint64Value": -(2**40)}, None, "ACQUIRED"),
        ("uint64", {"type": "UINT64", "uint64Value": 2**40}, None, "ACQUIRED"),
        ("uint32", {"type": "UINT32", "uint32Value": 7}, None, "ACQUIRED"),
        ("sint32", {"type": "SINT32", "sint32Value": -7}, None, "ACQUIRED"),
        ("bool", {"type": "BOOLEAN", "booleanValue": True}, None, "ACQUIRED"),
        ("state", {"type": "ENUMERATED", "stringValue": "ON"}, {"type": "UINT32", "uint32Value": 3}, "ACQUIRED"),
        ("text", {"type": "STRING", "stringValue": "7"}, None, "ACQUIRED"),
        ("nan", {"type": "DOUBLE", "doubleValue": float("nan")}, None, "ACQUIRED"),
        ("inf", {"type": "DOUBLE", "doubleValue": float("inf")}, None, "ACQUIRED"),
        ("stale", {"type": "DOUBLE", "doubleValue": 1.0}, None, "EXPIRED"),
        ("wrong", {"type": "DOUBLE", "doubleValue": 1.0}, None, "INVALID"),
    ]
    for k, (name, eng, raw, said) in enumerate(kinds):
        item = value()
        item.id.namespace, item.id.name = ("/SAT", name) if k % 2 else ("", f"/SAT/{name}")
        for part, members in ((item.engValue, eng), (item.rawValue, raw)):
            for member, content in (members or {}).items():
                setattr(part, member, getattr(part, content) if member == "type" else content)
        item.acquisitionStatus = status.Value(said)
        item.generationTime.FromDatetime(to_datetime(1_772_323_200_000 - (k % 3)).replace(tzinfo=None))
        data.parameter.append(item)
    return data


def test_json_holds_the_rows_that_the_client_reads() -> None:
    data = parameter_data()
    found = list(rows_of(json.loads(MessageToJson(data))))
    assert found == list(_rows(ParameterData(data)))
    assert {name for row in found for name in row.values} == {
        f"/SAT/{name}" for name in ("double", "float", "sint64", "uint64", "uint32", "sint32", "bool", "state")
    }
    assert [row.time_ms for row in found] == sorted(row.time_ms for row in found)


@pytest.mark.parametrize("size", [1, 2, 3, 7, 10_000])
def test_documents_are_found_however_they_are_cut(size: int) -> None:
    documents = [{"a": "} {\n\u00e4\u20ac"}, {"b": [1, {"c": None}]}, {}]
    text = "".join(
        json.dumps(d, indent=2, ensure_ascii=False) + gap for d, gap in zip(documents, ["", "\n ", "\n"], strict=True)
    )
    data = text.encode()
    assert list(messages(data[k : k + size] for k in range(0, len(data), size))) == documents
    with pytest.raises(ValueError, match="ends within a document"):
        list(messages([data, b'{"a": ']))
