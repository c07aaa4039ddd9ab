"""A specification changes: the archive and the models stay, and the service says which of them still hold."""

import json
from typing import Any

import pytest
import yaml

from tests.service.conftest import SPEC
from tests.service.fakes import FakeWorkbench
from tests.service.harness import AppClient, until
from tests.service.test_years import TWIN, calibrate, ingest

GROWN: dict[str, Any] = {
    **SPEC,
    "channels": {
        "T_new": {"kind": "temperature", "unit": "K"},
        **SPEC["channels"],
        "Q_new": {"kind": "power", "unit": "W"},
    },
    "nodes": [{"id": "new", "sensor": "T_new"}, *SPEC["nodes"]],
    "conductors": [*SPEC["conductors"], {"between": ["new", "px"]}],
    "loads": [*SPEC["loads"], {"channel": "Q_new", "node": "new"}],
}


def put(client: AppClient, spec: dict[str, Any]) -> Any:
    return client.request("PUT", TWIN, json=spec)


def test_a_new_sensor_and_a_new_load(make_client: Any) -> None:
    client = make_client(FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    ingest(client, 0, 600)
    calibrate(client, {})
    before = client.get(f"{TWIN}/telemetry").json()
    answer = put(client, GROWN)
    assert answer.status_code == 200, answer.text
    found = answer.json()
    assert (found["revision"], found["samples"], found["active_model"]) == (2, 600, 1)
    (model,) = found["models"]
    assert not model["holds"] and model["lacks"] == [
        "sensor T_new is new",
        "node new is new",
        "conductor new – px is new",
        "load Q_new → new is new",
    ]
    assert found["channels"] == ["T_px", "T_tank", "Q_px", "T_new", "Q_new"]
    archive = client.get(f"{TWIN}/telemetry").json()
    assert {name: archive["values"][name] for name in before["values"]} == before["values"]
    assert archive["values"]["T_new"] == [None] * 600
    values = {"T_px": [290.6], "T_tank": [15.0], "Q_px": [0.5], "T_new": [280.0], "Q_new": [4.0]}
    assert client.post(f"{TWIN}/telemetry", json={"time": [600], "values": values}).json()["accepted"] == 1
    assert client.post(f"{TWIN}/telemetry", json={"time": [3], "values": {"T_new": [281.0]}}).json()["accepted"] == 1
    archive = client.get(f"{TWIN}/telemetry", params={"start": 3, "stop": 4}).json()
    assert (archive["values"]["T_new"], archive["values"]["T_tank"]) == ([281.0], [18.0])
    residuals = client.get(f"{TWIN}/residuals").json()  # the old model goes on with the sensors that it knows
    assert residuals["samples"] == 601
    assert residuals["residual_K"]["T_new"] == [None] * 601 and residuals["residual_K"]["T_px"][-1] is not None
    notices = client.get(f"{TWIN}/forecast", params={"horizon_s": 10}).json()["notices"]
    assert any("sensor T_new is new" in notice for notice in notices)
    calibrate(client, {"activate": True})
    assert put(client, GROWN).json()["models"][1]["holds"]
    former = client.get(f"{TWIN}/revisions").json()
    assert former["current"] == 2 and [r["number"] for r in former["revisions"]] == [1]
    assert former["revisions"][0]["specification"]["nodes"] == SPEC["nodes"]
    client.close()
    assert make_client(FakeWorkbench).get(TWIN).json()["revision"] == 2


def test_new_limits_raise_alarms_and_every_model_holds(make_client: Any) -> None:
    client = make_client(FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    ingest(client, 0, 600)
    calibrate(client, {})
    samples = client.get(f"{TWIN}/residuals").json()["samples"]
    limits = {"yellow": [None, 290.2]}
    limited = {**SPEC, "channels": {**SPEC["channels"], "T_px": {**SPEC["channels"]["T_px"], "limits": limits}}}
    assert put(client, limited).json()["models"][0]["holds"]
    assert client.get(f"{TWIN}/residuals").json()["samples"] == samples
    ingest(client, 600, 10)
    assert until(lambda: client.get(f"{TWIN}/alarms").json()["alarms"])[0]["channel"] == "T_px"


@pytest.mark.parametrize(
    ("change", "status", "said"),
    [
        ({"channels": {k: v for k, v in SPEC["channels"].items() if k != "Q_px"}, "loads": []}, 409, "Q_px"),
        (
            {"channels": {**SPEC["channels"], "T_tank": {"kind": "temperature", "unit": "K"}}},
            409,
            "channels.T_tank.unit",
        ),
        ({"twin": "another"}, 422, "twin"),
        ({"nodes": []}, 422, "nodes"),
    ],
)
def test_what_the_archive_could_not_follow_is_refused(
    registered: AppClient, change: dict[str, Any], status: int, said: str
) -> None:
    answer = put(registered, {**SPEC, **change})
    assert answer.status_code == status and said in answer.json()["detail"]
    assert registered.get(TWIN).json()["revision"] == 1


def test_a_twin_that_is_not_there_cannot_change(client: AppClient) -> None:
    assert put(client, SPEC).status_code == 404


def test_yaml_is_taken_as_json_is(client: AppClient) -> None:
    kind = {"Content-Type": "application/yaml"}
    assert client.post("/v1/twins", content=yaml.safe_dump(SPEC), headers=kind).status_code == 201
    assert client.post("/v1/twins", json=SPEC).status_code == 200
    bomb = "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n"
    assert "aliases" in client.post("/v1/twins", content=bomb, headers=kind).json()["detail"]
    assert client.post("/v1/twins", content="twin: [", headers=kind).status_code == 422
    assert client.post("/v1/twins", content=b"\xff", headers=kind).status_code == 400
    assert client.post("/v1/twins", content="twin: x", headers={"Content-Type": "text/plain"}).status_code == 415


def test_vast_specifications_are_refused_or_checked_apart(client: AppClient) -> None:
    names = [f"T_{k}" for k in range(800)]
    large = {
        "twin": "large",
        "channels": {name: {"kind": "temperature", "unit": "K"} for name in names},
        "nodes": [{"id": f"n{k}", "sensor": name} for k, name in enumerate(names)],
    }
    assert client.post("/v1/twins", json=large).status_code == 201
    large["twin"] = "wrong"
    large["nodes"][3]["sensor"] = "T_nowhere"  # type: ignore[index]
    answer = client.post("/v1/twins", content=json.dumps(large), headers={"Content-Type": "application/json"})
    assert answer.status_code == 422 and "T_nowhere" in answer.json()["detail"]
    large["nodes"] = [{"id": f"n{k}"} for k in range(10_000)]
    answer = client.post("/v1/twins", json=large)
    assert answer.status_code == 422 and "at most 5000" in answer.json()["detail"]


def test_a_long_name_is_not_repeated(registered: AppClient) -> None:
    long = "x" * 1_000_000
    for answer in (
        registered.post(f"{TWIN}/telemetry", json={"time": [1], "values": {long: [1.0]}}),
        registered.get(f"{TWIN}/telemetry", params={"channels": long[:5000]}),
        registered.get(f"/v1/twins/{long[:5000]}"),
        registered.get(f"/v1/{long[:5000]}"),
        registered.post(f"{TWIN}/forecasts", json={"horizon_s": 1, long: 1}),
        registered.post("/v1/twins", json={**SPEC, long: 1}),
        registered.post("/v1/twins", json={**SPEC, "nodes": [{"id": long}]}),
    ):
        assert answer.status_code in (404, 422) and len(answer.content) < 1500, answer.content[:200]
