"""What lists say: anomalies with the causes that explain them, models by one measure."""

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from service.workbench.interface import DiagnosisTask, Outcome, Progress
from tests.service.conftest import SPEC, Sql
from tests.service.fakes import FakeWorkbench
from tests.service.harness import AppClient

TWIN = "/v1/twins/benchsat"


class Finder(FakeWorkbench):
    """Finds a heat load at px; the held-out error of T_tank falls, too, where the diagnosis sees any power of 7 W."""

    def diagnose(self, task: DiagnosisTask, progress: Progress) -> Outcome:
        made = super().diagnose(task, progress)
        fell = 0.1 if float(task.telemetry.values["Q_px"][-1]) == 7.0 else 0.95
        report = dict(made.report or {})
        report["before"] = {"rmse_K": 1.0, "per_sensor": {"T_px": {"rmse_K": 1.0}, "T_tank": {"rmse_K": 1.0}}}
        report["after"] = {"rmse_K": 0.5, "per_sensor": {"T_px": {"rmse_K": 0.1}, "T_tank": {"rmse_K": fell}}}
        start = f"{np.datetime64(int(task.telemetry.time_us[0]), 'us')}Z"
        report["train"] = {**report["train"], "start": start}
        report["holdout"] = {"stop": report["train"]["stop"]}
        return replace(made, report=report)


@pytest.fixture
def client(make_client) -> AppClient:
    client = make_client(workbench=Finder)
    client.post("/v1/twins", json=SPEC)
    return client


def send(client: AppClient, first: int, T_px: list, T_tank: list, power_W: float = 0.5) -> None:
    count = len(T_px)
    values = {"T_px": T_px, "T_tank": T_tank, "Q_px": [power_W] * count}
    body = {"time": [float(k) for k in range(first, first + count)], "values": values}
    assert client.post(f"{TWIN}/telemetry", json=body).json()["accepted"] == count


def run(client: AppClient, room: str, body: dict[str, Any] | None = None) -> dict:
    path = client.post(f"{TWIN}/{room}", json=body or {}).headers["location"]
    while (job := client.get(path).json())["state"] in ("queued", "running"):
        time.sleep(0.02)
    assert job["state"] == "succeeded", job
    return job


def jumps(count: int) -> list[float]:
    return [40.0 * (k % 2) for k in range(count)]


def anomalies(client: AppClient) -> list[dict]:
    client.get(f"{TWIN}/residuals")  # what is stored is assimilated
    return client.get(f"{TWIN}/anomalies").json()["anomalies"]


def wobble(count: int) -> list[float]:
    return [0.25 * (k * 7 % 5) for k in range(count)]


def test_open_anomalies_come_first(client: AppClient) -> None:
    send(client, 0, [0.0] * 100, [0.0] * 100)
    run(client, "calibrations", {"activate": True})
    send(client, 100, jumps(300), [0.0] * 50 + jumps(30) + [0.0] * 220)
    rows = anomalies(client)
    assert [(row["sensor"], row["stop"] is None) for row in rows[:2]] == [("T_px", True), ("T_tank", False)]
    assert rows[0]["start"] < rows[1]["start"]
    assert rows[0]["message"] == "T_px departs from its model"


@pytest.mark.parametrize(("power_W", "explained"), [(0.5, {"T_px"}), (7.0, {"T_px", "T_tank"})])
def test_a_cause_goes_to_what_it_explains(client: AppClient, power_W: float, explained: set[str]) -> None:
    send(client, 0, wobble(100), wobble(100))
    run(client, "calibrations", {"activate": True})
    send(client, 100, jumps(40), jumps(40))
    anomalies(client)
    send(client, 140, [None] * 40, jumps(40), power_W)  # px goes away: no heat explains that
    run(client, "diagnoses")
    rows = anomalies(client)
    known = {(row["sensor"], row["kind"]) for row in rows if row["cause"] is not None}
    assert {sensor for sensor, kind in known if kind == "residual"} == explained
    assert ("T_px", "dropout") in {(row["sensor"], row["kind"]) for row in rows}
    assert ("T_px", "dropout") not in known


def test_what_lies_outside_the_diagnosed_time_keeps_no_cause(client: AppClient) -> None:
    send(client, 0, [0.0] * 100, [0.0] * 100)
    run(client, "calibrations", {"activate": True})
    send(client, 100, [*jumps(30), *[0.0] * 200], [0.0] * 230)
    assert len(anomalies(client)) >= 1
    run(client, "diagnoses", {"start": 250})
    assert all(row["cause"] is None for row in anomalies(client))


def test_a_cause_outlives_another_model_that_does_not_have_it(client: AppClient) -> None:
    send(client, 0, [0.0] * 100, [0.0] * 100)
    run(client, "calibrations", {"activate": True})
    send(client, 100, jumps(30), [0.0] * 30)
    anomalies(client)
    found = run(client, "diagnoses")["result"]["model_version"]
    run(client, "calibrations", {"activate": True})
    (again,) = [row for row in anomalies(client) if row["kind"] == "residual"]
    assert again["model_version"] == 3 and again["cause"]["effect"] == "constant_heat_load"
    client.post(f"{TWIN}/models/{found}/activate")  # this one has the effect, and yet the sensor jumps
    (still,) = [row for row in anomalies(client) if row["kind"] == "residual"]
    assert still["model_version"] == found and still["cause"] is None


def test_errors_in_one_list_are_of_one_measure(client: AppClient) -> None:
    send(client, 0, wobble(100), wobble(100), 0.5)
    run(client, "calibrations")
    send(client, 100, jumps(100), wobble(100), 0.25)
    run(client, "calibrations")
    run(client, "diagnoses")
    rows = client.get(f"{TWIN}/models").json()["models"]
    assert [row["error"]["rmse_K"] for row in rows] == [0.5, 0.25, 0.1]
    stretch = {(row["error"]["start"], row["error"]["stop"], row["error"]["samples"]) for row in rows}
    assert stretch == {("1970-01-01T00:00:00Z", "1970-01-01T00:03:19Z", 200)}
    client.request("DELETE", f"{TWIN}/telemetry", params={"start": 150})
    again = client.get(f"{TWIN}/models").json()["models"]
    assert {row["error"]["samples"] for row in again} == {150}


def test_a_forecast_says_which_sensors_are_in_doubt(make_client: Any, sql: Sql) -> None:
    client = make_client(workbench=FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    send(client, 0, [290.0 + 0.1 * k for k in range(100)], wobble(100))
    run(client, "calibrations")
    ahead = f"{TWIN}/forecast?horizon_s=10&step_s=1"
    before = client.get(ahead).json()["notices"]
    line = "T_tank is frozen: it repeats one reading; what the forecast says of it may be wrong"
    assert line not in before
    sql(
        "INSERT INTO anomaly (twin, sensor, kind, start_us, stop_us, score, version)"
        " VALUES (1, 'T_tank', 'stuck', 50000000, NULL, 9.0, 1), (1, 'T_px', 'stuck', 1, 2, 9.0, 1),"
        " (1, 'T_px', 'residual', 1, NULL, 9.0, 1)"
    )
    assert client.get(ahead).json()["notices"] == [*before, line]
