"""Wrong requests: each one a 4xx problem document that names the field, with nothing stored."""

import gzip
import json
from dataclasses import dataclass, field
from typing import Any

import pytest

from tests.service.harness import AppClient

TELEMETRY = "/v1/twins/benchsat/telemetry"
TWIN = "/v1/twins/benchsat"
FORECASTS = f"{TWIN}/forecasts"
JSON = "application/json"
NDJSON = "application/x-ndjson"


@dataclass(frozen=True)
class Case:
    """A request, and what its refusal must say."""

    name: str
    body: bytes | str | dict | list
    status: int
    says: str
    path: str = TELEMETRY
    method: str = "POST"
    kind: str = JSON
    headers: dict[str, str] = field(default_factory=dict)

    def content(self) -> bytes:
        body = self.body if isinstance(self.body, bytes | str) else json.dumps(self.body)
        return body.encode() if isinstance(body, str) else body


def columns(time: Any, **values: Any) -> dict:
    return {"time": time, "values": values}


def spec_with(**changes: Any) -> dict:
    """A specification of another twin, with some fields replaced."""
    return {
        "twin": "other",
        "channels": {"T": {"kind": "temperature", "unit": "K"}},
        "nodes": [{"id": "a", "sensor": "T"}],
        **changes,
    }


INGEST = [
    Case("empty body", "", 400, "body"),
    Case("not JSON", "time,T_px\n1,2", 400, "body"),
    Case("half a document", '{"time": [1], "values": {"T_px": [1', 400, "body"),
    Case("invalid UTF-8", b'{"time": [1], "values": {"\xff": [1]}}', 400, "body"),
    Case("endless nesting", "[" * 100_000, 400, "body"),
    Case("endless nesting of what is well-formed", "[" * 50_000 + "]" * 50_000, 400, "body"),
    Case("a list", [], 422, "body"),
    Case("no time", {"values": {}}, 422, "time"),
    Case("no values", {"time": []}, 422, "values"),
    Case("an unknown member", {"time": [], "values": {}, "x": 1}, 422, "x"),
    Case("below absolute zero", columns([1, 2], T_px=[290.0, -1e300]), 422, "values.T_px[1]"),
    Case("hotter than any reading", columns([1], T_px=[9998.0]), 422, "values.T_px[0]"),
    Case("another unit", columns([1], T_px=[17]) | {"units": {"T_px": "degC"}}, 422, "units.T_px"),
    Case("the unit of an unknown channel", columns([1]) | {"units": {"T_py": "K"}}, 422, "units.T_py"),
    Case("units are a list", columns([1]) | {"units": ["K"]}, 422, "units"),
    Case("time is a number", columns(1, T_px=[1]), 422, "time"),
    Case("values is a list", {"time": [1], "values": [1]}, 422, "values"),
    Case("a column is a number", columns([1], T_px=1), 422, "values.T_px"),
    Case("a short column", columns([1, 2], T_px=[1]), 422, "values.T_px"),
    Case("a long column", columns([1], T_px=[1, 2]), 422, "values.T_px"),
    Case("an unknown channel", columns([1], T_py=[1]), 422, "values.T_py"),
    Case("NaN", '{"time": [1, 2], "values": {"T_px": [1, NaN]}}', 422, "values.T_px[1]"),
    Case("minus infinity", '{"time": [1], "values": {"T_px": [-Infinity]}}', 422, "values.T_px[0]"),
    Case("an overflowing number", '{"time": [1], "values": {"T_px": [1e999]}}', 422, "values.T_px[0]"),
    Case("text for a number", columns([1], T_px=["290"]), 422, "values.T_px[0]"),
    Case("a channel twice", '{"time": [1], "values": {"T_px": [1], "T_px": [2]}}', 422, "values.T_px"),
    Case("a channel twice, spaced", '{"time" : [1], "values" : {"T_px" : [1], "T_px" : [2]}}', 422, "values.T_px"),
    Case(
        "a channel twice among units",
        '{"time": ["2026-01-01T00:00:00Z", 7], "units": {"T_px": "K"}, "values": {"T_px": [1, 2], "T_px": [1, 2]}}',
        422,
        "values.T_px",
    ),
    Case(
        "deep nesting beside the samples",
        '{"time": [1, "x"], "values": {"T_px": [1, 2]}, "samples": ' + "[" * 1000 + "]" * 1000 + "}",
        422,
        "time[1]",
    ),
    Case("times twice", '{"time": [1], "values": {"T_px": [1]}, "time": [2]}', 422, "time"),
    Case(
        "frame with a channel twice",
        '{"time": 1, "values": {}}\n{"time": 2, "values": {"T_px": 1, "T_px": 2}}',
        422,
        "line 2: values.T_px",
        kind=NDJSON,
    ),
    Case("true for a number", columns([1, 2], T_px=[290, True]), 422, "values.T_px[1]"),
    Case("a list for a number", columns([1], T_px=[[1]]), 422, "values.T_px[0]"),
    Case("an object for a number", columns([1], T_px=[{}]), 422, "values.T_px[0]"),
    Case("a time that is none", columns(["yesterday"], T_px=[1]), 422, "time[0]"),
    Case("a null time", columns([1, None], T_px=[1, 2]), 422, "time[1]"),
    Case("a true time", columns([True], T_px=[1]), 422, "time[0]"),
    Case("a NaN time", '{"time": [NaN], "values": {"T_px": [1]}}', 422, "time[0]"),
    Case("a time without offset", columns(["2026-01-01T00:00:00"], T_px=[1]), 422, "time[0]"),
    Case("a date without time", columns(["2026-01-01"], T_px=[1]), 422, "time[0]"),
    Case("February 30", columns(["2026-02-30T00:00:00Z"] * 40, T_px=[1] * 40), 422, "time[0]"),
    Case("hour 24", columns(["2026-02-03T24:00:00Z"], T_px=[1]), 422, "time[0]"),
    Case("milliseconds for seconds", columns([1767225600000], T_px=[1]), 422, "time[0]"),
    Case("a time before 1970", columns([-1], T_px=[1]), 422, "time[0]"),
    Case("the year 9999", columns(["9999-12-31T23:59:59Z"], T_px=[1]), 422, "time[0]"),
    Case("the year 1", columns(["0001-01-01T00:00:00Z"], T_px=[1]), 422, "time[0]"),
    Case("a wrong media type", columns([1]), 415, "content-type", kind="text/csv"),
    Case("a wrong encoding", columns([1]), 415, "gzip", headers={"content-encoding": "br"}),
    Case("not gzip", columns([1]), 400, "gzip", headers={"content-encoding": "gzip"}),
    Case("half a gzip", gzip.compress(b"{}" * 99)[:-9], 400, "gzip", headers={"content-encoding": "gzip"}),
    Case("rubbish after gzip", gzip.compress(b"{}") + b"\0rest", 400, "gzip", headers={"content-encoding": "gzip"}),
    Case(
        "half a second gzip", gzip.compress(b"{}") * 2 + b"\x1f\x8b", 400, "gzip", headers={"content-encoding": "gzip"}
    ),
    Case("gzip of nothing", b"", 400, "gzip", headers={"content-encoding": "gzip", "content-length": "0"}),
    Case("a bomb in pieces", gzip.compress(b" " * 500) * 200, 413, "smaller", headers={"content-encoding": "gzip"}),
    Case("a body too large", b" " * 70_000, 413, "smaller batches"),
    Case("a gzip bomb", gzip.compress(b" " * 10_000_000), 413, "smaller", headers={"content-encoding": "gzip"}),
    Case("frame not JSON", '{"time": 1, "values": {}}\n{"time"', 400, "line 2", kind=NDJSON),
    Case("frame is a list", "[]", 422, "line 1", kind=NDJSON),
    Case("two frames in a line", '{"time": 1, "values": {}},{"time": 2, "values": {}}', 400, "line 1", kind=NDJSON),
    Case("frame with a strange channel", '{"time": 1, "values": {"X": 1}}', 422, "line 1: values.X", kind=NDJSON),
    Case("frame with text", '{"time": 1, "values": {"T_px": "1"}}', 422, "line 1: values.T_px", kind=NDJSON),
    Case("frame with infinity", '{"time": 1, "values": {"T_px": Infinity}}', 422, "line 1: values.T_px", kind=NDJSON),
    Case("frame without time", '{"values": {}}', 422, "line 1: time", kind=NDJSON),
    Case(
        "frame with a bad time",
        '{"time": 1, "values": {}}\n{"time": "x", "values": {}}',
        422,
        "line 2: time",
        kind=NDJSON,
    ),
]

ELSEWHERE = [
    Case("no such twin", columns([1]), 404, "nosuch", path="/v1/twins/nosuch/telemetry"),
    Case("no such route", "", 404, "/v1/nothing", path="/v1/nothing", method="GET"),
    Case("no such method", "", 405, "PUT", path="/v1/twins", method="PUT"),
    Case("query: start", "", 422, "start", path=TELEMETRY + "?start=noon", method="GET"),
    Case("query: stop before start", "", 422, "stop", path=TELEMETRY + "?start=9&stop=3", method="GET"),
    Case("query: stop out of range", "", 422, "stop", path=TELEMETRY + "?stop=1e300", method="GET"),
    Case("query: NaN", "", 422, "stop", path=TELEMETRY + "?stop=nan", method="GET"),
    Case("query: channel", "", 422, "channels", path=TELEMETRY + "?channels=T_px,T", method="GET"),
    Case("query: version", "", 404, "version", path="/v1/twins/benchsat/residuals?version=7", method="GET"),
    Case("query: unknown", "", 422, "maxpoints: unknown", path=TELEMETRY + "?maxpoints=9", method="GET"),
    Case("query: unknown at a list", "", 422, "limit: unknown", path="/v1/twins?limit=9", method="GET"),
    Case("query: unknown at a job", "", 422, "x: unknown", path=f"{TWIN}/calibrations/1?x=", method="GET"),
    Case("query: unknown beside a body", {"horizon_s": 9}, 422, "step_s: unknown", path=f"{FORECASTS}?step_s=3"),
    Case("query: unknown at ingest", columns([7], T_px=[1]), 422, "dry_run: unknown", path=f"{TELEMETRY}?dry_run=1"),
    Case("query: one point", "", 422, "max_points", path=TELEMETRY + "?max_points=1", method="GET"),
    Case("spec: not JSON", "{", 400, "body", path="/v1/twins"),
    Case("spec: endless nesting", "[" * 100_000, 400, "body", path="/v1/twins"),
    Case("spec: nesting that is well-formed", '{"a":' * 20_000 + "1" + "}" * 20_000, 400, "body", path="/v1/twins"),
    Case("spec: a list", [], 422, "body", path="/v1/twins"),
    Case(
        "spec: sent as a form",
        spec_with(),
        415,
        "application/json",
        path="/v1/twins",
        kind="application/x-www-form-urlencoded",
    ),
    Case(
        "forecast: sent as text", {"horizon_s": 9}, 415, "json", path="/v1/twins/benchsat/forecasts", kind="text/plain"
    ),
    Case("forecast: NaN", '{"horizon_s": NaN}', 422, "is not a finite number", path=FORECASTS),
    Case("forecast: text for a number", {"horizon_s": "600"}, 422, "horizon_s", path=FORECASTS),
    Case("forecast: a true horizon", {"horizon_s": True}, 422, "horizon_s", path=FORECASTS),
    Case("forecast: more than any number", {"horizon_s": 10**400}, 422, "horizon_s", path=FORECASTS),
    Case("forecast: text quantiles", {"horizon_s": 9, "quantiles": ["0.5"]}, 422, "quantiles[0]", path=FORECASTS),
    Case("forecast: NaN quantiles", '{"horizon_s": 9, "quantiles": [NaN]}', 422, "finite", path=FORECASTS),
    Case(
        "forecast: text in a plan",
        {"horizon_s": 9, "plan": columns([1], Q_px=["1"])},
        422,
        "plan.values.Q_px[0]",
        path=FORECASTS,
    ),
    Case("calibration: text for a choice", {"activate": "yes"}, 422, "activate", path=f"{TWIN}/calibrations"),
    Case("calibration: more than can be counted", {"samples": 10**30}, 422, "samples", path=f"{TWIN}/calibrations"),
    Case("model: more than can be counted", {"spec": {}, "rmse_K": 10**30}, 422, "64-bit", path=f"{TWIN}/models"),
    Case("model: nested past storing", '{"spec":' * 500 + "1" + "}" * 500, 422, "body", path=f"{TWIN}/models"),
    Case("diagnosis: text for a share", {"holdout": "0.3"}, 422, "holdout", path=f"{TWIN}/diagnoses"),
    Case(
        "spec: next to nothing",
        spec_with(nodes=[{"id": "a", "sensor": "T", "capacity_J_per_K": {"value": 1e-300}}]),
        422,
        "nodes[0].capacity_J_per_K.value",
        path="/v1/twins",
    ),
    Case(
        "spec: out of all proportion",
        spec_with(nodes=[{"id": "a", "sensor": "T", "capacity_J_per_K": {"guess": 1e300}}]),
        422,
        "nodes[0].capacity_J_per_K.guess",
        path="/v1/twins",
    ),
    Case("spec: no nodes", spec_with(nodes=[]), 422, "nodes", path="/v1/twins"),
    Case("spec: bad id", spec_with(twin="Other Twin"), 422, "twin", path="/v1/twins"),
    Case("spec: unknown field", spec_with(colour="red"), 422, "colour", path="/v1/twins"),
    Case(
        "spec: unknown sensor", spec_with(nodes=[{"id": "a", "sensor": "X"}]), 422, "nodes[0].sensor", path="/v1/twins"
    ),
    Case("spec: NaN", '{"twin": "other", "boundaries": {"space": {"value_K": NaN}}}', 422, "value_K", path="/v1/twins"),
    Case("spec: other under this id", spec_with(twin="benchsat"), 409, "benchsat", path="/v1/twins"),
]


@pytest.mark.parametrize("case", INGEST + ELSEWHERE, ids=lambda case: case.name)
def test_wrong_request_is_refused_by_name(make_client, spec: dict, case: Case) -> None:
    client: AppClient = make_client(max_body_bytes=65_536 * 2 if "nesting" in case.name else 65_536)
    client.post("/v1/twins", json=spec)
    client.post(TELEMETRY, json=columns([5], T_px=[1]))
    headers = {"content-type": case.kind, **case.headers}
    response = client.request(case.method, case.path, content=case.content(), headers=headers)
    assert response.status_code == case.status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    problem = response.json()
    assert problem["status"] == case.status
    assert case.status in (404, 405, 409, 413, 415) or problem["errors"][0].keys() == {"field", "detail"}
    assert case.says in problem["detail"] or case.says in json.dumps(problem.get("errors", []))
    assert client.get(TELEMETRY).json()["samples"] == 1
    assert len(client.get("/v1/twins").json()["twins"]) == 1


@pytest.mark.parametrize(
    ("method", "path", "allowed"),
    [
        ("PUT", "/v1/twins", "GET, HEAD, POST"),
        ("PATCH", "/v1/twins/benchsat", "DELETE, GET, HEAD, PUT"),
        ("PUT", "/v1/twins/benchsat/telemetry", "DELETE, GET, HEAD, POST"),
        ("HEAD", "/v1/twins/benchsat/forecasts", "POST"),
        ("POST", "/assets/style.css", "GET, HEAD"),
    ],
)
def test_a_wrong_method_is_told_every_right_one(registered: AppClient, method: str, path: str, allowed: str) -> None:
    response = registered.request(method, path)
    assert (response.status_code, response.headers["allow"]) == (405, allowed)
