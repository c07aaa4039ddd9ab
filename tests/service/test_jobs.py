"""Calibrations and diagnoses as jobs, and the model versions that they leave."""

import copy
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from service.workbench.interface import DiagnosisTask, Outcome, Progress
from tests.service.conftest import SPEC, STORE
from tests.service.fakes import FakeWorkbench
from tests.service.harness import AppClient

TWIN = "/v1/twins/benchsat"


@pytest.fixture
def client(make_client) -> AppClient:
    client = make_client(workbench=FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    return client


def feed(client: AppClient, wish: float, first: int = 0, count: int = 120) -> None:
    """Send samples whose power tells the fake workbench what to do."""
    time_s = list(range(first, first + count))
    body = {"time": time_s, "values": {"T_px": [290.0] * count, "T_tank": [1.0] * count, "Q_px": [wish] * count}}
    assert client.post(f"{TWIN}/telemetry", json=body).json()["accepted"] == count


def start(client: AppClient, room: str = "calibrations", **request: Any) -> str:
    response = client.post(f"{TWIN}/{room}", json=request)
    assert response.status_code == 202, response.text
    job = response.json()
    assert job["state"] == "queued"
    assert response.headers["location"] == f"{TWIN}/{room}/{job['id']}"
    return response.headers["location"]


def finish(client: AppClient, path: str) -> dict:
    for _ in range(1500):
        job = client.get(path).json()
        if job["state"] not in ("queued", "running"):
            return job
        time.sleep(0.02)
    raise AssertionError(f"{path} does not end: {job}")


def test_first_calibration_becomes_active_with_provenance(client: AppClient) -> None:
    feed(client, 0.5)
    job = finish(client, start(client))
    assert (job["kind"], job["state"], job["progress"]) == ("calibration", "succeeded", 1.0)
    assert (job["result"]["model_version"], job["result"]["activated"]) == (1, True)
    assert job["created"] <= job["started"] <= job["finished"]
    models = client.get(f"{TWIN}/models").json()
    (model,) = models["models"]
    assert (model["version"], model["active"], model["source"]) == (1, True, "calibration")
    assert model["validation"]["rmse_K"] == 0.5
    assert model["train"]["samples"] == 96  # the last fifth is held back
    assert len(model["provenance"]["data_sha256"]) == 64
    assert model["provenance"]["code_version"]
    assert models["activations"][0]["reason"] == "the first model"
    assert client.get(f"{TWIN}/models/1").json()["model"]["spec"]["twin"] == "benchsat"
    assert client.get(TWIN).json()["active_model"] == 1


@pytest.mark.parametrize(("claim", "wins"), [(0.4, True), (0.6, False)])
def test_a_later_model_must_beat_the_active_one(client: AppClient, claim: float, wins: bool) -> None:
    feed(client, 0.5)
    finish(client, start(client))
    feed(client, claim, first=1000)
    result = finish(client, start(client))["result"]
    assert result["activated"] is wins
    assert result["rival_rmse_K"] == 0.5
    assert [m["active"] for m in client.get(f"{TWIN}/models").json()["models"]] == [not wins, wins]


def test_a_job_says_in_words_what_became_of_its_model(client: AppClient) -> None:
    messages = []
    for first, wish in ((0, 0.5), (1000, 0.4), (2000, 0.6), (3000, 17)):
        feed(client, wish, first=first)
        messages.append(finish(client, start(client))["message"])
    assert messages[0] == "version 1 is active: the first model"
    assert messages[1] == "version 2 is active: better on recent data: 0.4 K against 0.5 K of version 1"
    assert messages[2] == "version 3 is not active: not better on recent data: 0.6 K against 0.4 K of version 2"
    assert "not active: no recent data on which to compare" in messages[3]
    assert "its error is not known" in messages[3]


def test_without_new_data_nothing_can_be_beaten(client: AppClient) -> None:
    feed(client, 0.5)
    finish(client, start(client))
    feed(client, 0.1, first=1000, count=20)
    finish(client, start(client, activate=True))
    result = finish(client, start(client))["result"]
    assert result["model_version"] == 3 and not result["activated"]


def test_roll_back(client: AppClient) -> None:
    feed(client, 0.5)
    finish(client, start(client))
    finish(client, start(client, activate=True))
    assert client.get(TWIN).json()["active_model"] == 2
    assert client.post(f"{TWIN}/models/1/activate").json()["active"] is True
    assert client.get(TWIN).json()["active_model"] == 1
    assert client.post(f"{TWIN}/models/9/activate").status_code == 404


def test_diagnosis_leaves_a_report_and_an_inactive_version(client: AppClient) -> None:
    feed(client, 1.0)
    path = start(client, "diagnoses", holdout=0.25)
    job = finish(client, path)
    assert job["result"]["verdict"] == "effect_added"
    assert job["result"]["holdout_share"] == 0.25
    assert (job["result"]["model_version"], job["result"]["activated"]) == (1, False)
    page = client.get(f"{path}/report.html")
    assert page.headers["content-type"].startswith("text/html") and "found" in page.text
    model = client.get(f"{TWIN}/models/1").json()
    assert (model["source"], model["active"]) == ("diagnosis", False)
    assert model["effects"][0]["effect"] == "constant_heat_load"


def test_a_diagnosis_that_says_nothing_keeps_less_back_beside_a_fresh_anomaly(client: AppClient) -> None:
    feed(client, 1.0, count=1000)
    finish(client, start(client))
    assert finish(client, start(client, "diagnoses"))["result"]["holdout_share"] == 0.3

    def open_one(connection: Any) -> None:
        row = "1, 'T_px', 'residual', 899000000, NULL, 9.0, 1"
        connection.execute(
            f"INSERT INTO anomaly (twin, sensor, kind, start_us, stop_us, score, version) VALUES ({row})"
        )

    client.portal.call(client.app.state.service.database.write, open_one)
    assert finish(client, start(client, "diagnoses"))["result"]["holdout_share"] == pytest.approx(50.0 / 999.0)
    assert finish(client, start(client, "diagnoses", holdout=0.2))["result"]["holdout_share"] == 0.2


def test_diagnosis_can_activate_and_finding_nothing_makes_no_version(client: AppClient) -> None:
    feed(client, 1.0)
    assert finish(client, start(client, "diagnoses", activate=True))["result"]["activated"] is True
    feed(client, 0.0, first=1000)
    result = finish(client, start(client, "diagnoses", activate=True))["result"]
    assert (result["verdict"], result["model_version"]) == ("no_effect_supported", None)
    assert len(client.get(f"{TWIN}/models").json()["models"]) == 1


@pytest.mark.parametrize(
    ("wish", "message"),
    [
        (13, "its worker process died (SIGKILL)"),
        (14, "ZeroDivisionError: unexpected"),
        (15, "the balance has no solution"),
    ],
)
def test_a_job_that_goes_wrong_harms_nothing_else(client: AppClient, wish: float, message: str) -> None:
    feed(client, wish)
    job = finish(client, start(client))
    assert job["state"] == "failed" and message in job["message"]
    assert client.get(f"{TWIN}/models").json()["models"] == []
    feed(client, 0.5, first=1000)
    assert finish(client, start(client))["state"] == "succeeded"


def test_cancel_ends_a_running_job(client: AppClient) -> None:
    feed(client, 16)
    path = start(client)
    while client.get(path).json()["progress"] < 0.5:
        time.sleep(0.02)
    waiting = start(client, "diagnoses")
    assert client.get(waiting).json()["state"] == "queued"
    assert client.delete(waiting).json()["state"] == "cancelled"
    assert client.delete(path).json()["state"] == "cancelled"
    assert client.delete(path).json()["state"] == "cancelled"
    feed(client, 0.5, first=1000)
    assert finish(client, start(client))["state"] == "succeeded"


class Brief(FakeWorkbench):
    """Tells three short phases at once, and the fourth one lasts until there is a file."""

    def diagnose(self, task: DiagnosisTask, progress: Progress) -> Outcome:
        for fraction, phase in ((0.0, "reading"), (0.02, "fitting"), (0.2, "screening"), (0.21, "examining")):
            progress(fraction, phase)
        while not Path(os.environ["FAKE_GATE"]).exists():
            time.sleep(0.02)
        return super().diagnose(task, progress)


def test_a_long_phase_after_short_ones_is_told(make_client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A search that follows a quick calibration stood at 0 with the words of what came before it."""
    monkeypatch.setenv("FAKE_GATE", str(tmp_path / "gate"))
    client = make_client(workbench=Brief)
    client.post("/v1/twins", json=SPEC)
    feed(client, 1.0)
    path, until_s = start(client, "diagnoses"), time.monotonic() + 20.0
    while (job := client.get(path).json())["message"] != "examining" and time.monotonic() < until_s:
        time.sleep(0.02)
    assert (job["state"], job["progress"], job["message"]) == ("running", 0.21, "examining")
    (tmp_path / "gate").touch()
    assert finish(client, path)["progress"] == 1.0


def test_deadline(make_client) -> None:
    client = make_client(workbench=FakeWorkbench, job_deadline_s=2.0)
    client.post("/v1/twins", json=SPEC)
    feed(client, 16)
    job = finish(client, start(client))
    assert job["state"] == "failed" and "TWIN_JOB_DEADLINE_S" in job["message"]


@pytest.mark.parametrize("jobs", ["calibrations", "diagnoses"])
def test_no_search_is_longer_than_a_job_may_take(make_client, jobs: str) -> None:
    client = make_client(workbench=FakeWorkbench, job_deadline_s=50.0)
    client.post("/v1/twins", json=SPEC)
    feed(client, 16)
    refused = client.post(f"/v1/twins/benchsat/{jobs}", json={"deadline_s": 1e9})
    assert refused.status_code == 422 and [error["field"] for error in refused.json()["errors"]] == ["deadline_s"]
    assert "50 s (TWIN_JOB_DEADLINE_S)" in refused.json()["detail"]
    assert client.post(f"/v1/twins/benchsat/{jobs}", json={"deadline_s": 50.0}).status_code == 202


def test_stopping_the_service_ends_jobs_and_the_next_start_says_so(make_client) -> None:
    client = make_client(workbench=FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    feed(client, 16)
    path = start(client)
    client.close()
    again = make_client(workbench=FakeWorkbench)
    expected = (
        ("queued", "running") if STORE == "postgres" else ("cancelled",)
    )  # a shared queue hands it to the next worker
    assert again.get(path).json()["state"] in expected


def test_deleting_a_twin_ends_its_jobs(client: AppClient) -> None:
    feed(client, 16)
    path = start(client)
    assert client.delete(TWIN).status_code == 204
    assert client.get(path).status_code == 404


@pytest.mark.parametrize(
    ("room", "request_body", "field"),
    [
        ("calibrations", {"method": "magic"}, "method"),
        ("calibrations", {"start": "noon"}, "start"),
        ("calibrations", {"start": 20, "stop": 10}, "stop"),
        ("calibrations", {"speed": 1}, "speed"),
        ("diagnoses", {"holdout": 1.5}, "holdout"),
        ("diagnoses", {"holdout": True}, "holdout"),
        ("diagnoses", {"burn_in_s": -1}, "burn_in_s"),
        ("diagnoses", {"activate": "perhaps"}, "activate"),
        ("diagnoses", [], "body"),
    ],
)
def test_wrong_requests_start_nothing(client: AppClient, room: str, request_body: Any, field: str) -> None:
    feed(client, 0.5)
    response = client.post(f"{TWIN}/{room}", json=request_body)
    assert response.status_code == 422
    assert response.headers["content-type"] == "application/problem+json"
    assert field in response.json()["detail"]
    assert client.get(f"{TWIN}/{room}").json() == {"jobs": []}


def test_a_job_needs_telemetry_and_a_body_is_optional(client: AppClient) -> None:
    assert client.post(f"{TWIN}/calibrations").status_code == 422
    feed(client, 0.5)
    assert client.post(f"{TWIN}/calibrations").status_code == 202
    assert client.get(f"{TWIN}/calibrations/nosuch").status_code == 404
    assert client.get(f"{TWIN}/diagnoses/nosuch/report.html").status_code == 404


def test_a_model_made_elsewhere(client: AppClient) -> None:
    response = client.post(f"{TWIN}/models", json={"spec": SPEC, "rmse_K": 1.0, "max_step_s": 60.0})
    assert response.status_code == 201
    assert (response.json()["source"], response.json()["active"]) == ("manual", False)
    assert client.post(f"{TWIN}/models", json={"spec": {**SPEC, "twin": "other"}}).status_code == 422
    assert client.post(f"{TWIN}/models", json={}).status_code == 422


FOREIGN: list[tuple[str, Any]] = [
    ("spec.channels.T_tank.unit", lambda spec: spec["channels"]["T_tank"].update(unit="K")),
    ("spec.channels.Q_px.unit", lambda spec: spec["channels"]["Q_px"].update(unit="percent")),
    ("spec.channels.Q_new", lambda spec: spec["channels"].update(Q_new={"kind": "power", "unit": "W"})),
    ("spec.channels", lambda spec: (spec["channels"].pop("Q_px"), spec["loads"].clear())),
    ("spec.nodes[1].sensor", lambda spec: spec["nodes"][1].pop("sensor")),
    ("spec.nodes[0].id", lambda spec: spec["nodes"].reverse()),
    ("spec.nodes", lambda spec: spec["nodes"].append({"id": "inner"})),
    ("spec.twin", lambda spec: spec.update(twin="other")),
]


@pytest.mark.parametrize(("field", "change"), FOREIGN, ids=[field for field, _ in FOREIGN])
def test_a_model_of_other_channels_or_nodes_is_refused(
    client: AppClient, field: str, change: Callable[[dict[str, Any]], Any]
) -> None:
    spec = copy.deepcopy(SPEC)
    change(spec)
    response = client.post(f"{TWIN}/models", json={"spec": spec, "rmse_K": 1.0, "max_step_s": 60.0})
    assert response.status_code == 422, response.text
    assert [error["field"] for error in response.json()["errors"]] == [field]
    assert client.get(f"{TWIN}/models").json()["models"] == []


def test_a_model_with_guesses_and_couplings_of_its_own_is_taken(client: AppClient) -> None:
    spec = copy.deepcopy(SPEC)
    spec["conductors"] = []
    spec["nodes"][0]["capacity_J_per_K"] = {"guess": 1e5}
    assert client.post(f"{TWIN}/models", json={"spec": spec, "max_step_s": 60.0}).status_code == 201


@pytest.mark.parametrize("room", ["calibrations", "diagnoses"])
def test_a_job_on_a_time_without_samples_is_refused_at_once(client: AppClient, room: str) -> None:
    feed(client, 0.5)  # samples at 0 to 119 s
    for field, request in (("start", {"start": 119.5}), ("stop", {"stop": 0})):
        response = client.post(f"{TWIN}/{room}", json=request)
        assert response.status_code == 422 and response.json()["errors"][0]["field"] == field
    assert client.get(f"{TWIN}/{room}").json() == {"jobs": []}
