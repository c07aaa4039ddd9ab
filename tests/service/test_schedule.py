"""When a twin is recalibrated without being asked."""

import time
from dataclasses import replace

import pytest

from service.jobs.schedule import LONGEST_BACK_OFF_S, Watch
from service.workbench.interface import Filtered, Json, Telemetry
from tests.service.conftest import SPEC
from tests.service.fakes import FakeWorkbench
from tests.service.harness import until

TWIN = "/v1/twins/benchsat"


def test_schedule_needs_time_and_news() -> None:
    watch = Watch(calibrated_s=100.0, samples=50)
    assert not watch.due_by_schedule(1e9, None, 60)
    assert not watch.due_by_schedule(150.0, 60.0, 60)
    assert not watch.due_by_schedule(160.0, 60.0, 50)
    assert watch.due_by_schedule(160.0, 60.0, 51)


def test_an_anomaly_must_last_and_attempts_become_rarer() -> None:
    watch = Watch(0.0, 0)
    due = [second for second in range(0, 2000) if watch.due_by_anomaly(float(second), 100.0, [7])]
    assert due == [100, 300, 700, 1500]
    assert not watch.due_by_anomaly(2000.0, 100.0, [])
    assert not watch.due_by_anomaly(2001.0, 100.0, [8])
    assert watch.due_by_anomaly(2101.0, 100.0, [8])


def test_patience_zero_switches_the_trigger_off_and_back_off_is_bounded() -> None:
    watch = Watch(0.0, 0)
    assert not any(watch.due_by_anomaly(float(second), 0.0, [1]) for second in range(100))
    watch.attempts = 60
    assert not watch.due_by_anomaly(0.0, 10.0, [1])
    assert watch.due_by_anomaly(10.0, 10.0, [1])
    assert watch.not_before_s == 10.0 + LONGEST_BACK_OFF_S


@pytest.mark.parametrize("settings", [{"calibrate_every_s": 0.5}, {"anomaly_patience_s": 0.5}])
def test_a_running_service_recalibrates_by_itself(make_client, settings: dict) -> None:
    client = make_client(workbench=FakeWorkbench, **settings)
    client.post("/v1/twins", json=SPEC)

    def send(first: int, jump: float) -> None:
        values = {"T_px": [jump * (k % 2) for k in range(60)], "T_tank": [0.0] * 60, "Q_px": [0.5] * 60}
        client.post(f"{TWIN}/telemetry", json={"time": list(range(first, first + 60)), "values": values})

    send(0, 0.0)
    path = client.post(f"{TWIN}/calibrations", json={}).headers["location"]
    while client.get(path).json()["state"] in ("queued", "running"):
        time.sleep(0.02)
    send(100, 50.0)

    def by_itself() -> bool:
        jobs = client.get(f"{TWIN}/calibrations").json()["jobs"]
        return len(jobs) > 1 and jobs[0]["state"] == "succeeded"

    until(by_itself)
    newest = client.get(f"{TWIN}/models").json()["models"][-1]
    assert newest["provenance"]["settings"]["trigger"] == ("schedule" if "calibrate_every_s" in settings else "anomaly")


def test_a_refutation_must_last_and_a_model_that_recovers_is_left_alone() -> None:
    watch = Watch(0.0, 0)
    assert not watch.due_by_refutation(0.0, 100.0, True)
    assert not watch.due_by_refutation(99.0, 100.0, True)
    assert watch.due_by_refutation(100.0, 100.0, True)
    assert not watch.due_by_refutation(101.0, 100.0, False)
    assert not watch.due_by_refutation(150.0, 100.0, True)
    assert not watch.due_by_refutation(1e9, 0.0, True)


class Refuting(FakeWorkbench):
    """Says that telemetry speaks against its model."""

    def filtered(self, document: str, telemetry: Telemetry, state: Json | None) -> Filtered:
        done = super().filtered(document, telemetry, state)
        return replace(done, state=done.state | {"evidence": {"sensors": {}, "most": 30.0}})


def test_a_refuted_model_is_diagnosed_once(make_client) -> None:
    client = make_client(workbench=Refuting, anomaly_patience_s=0.5)
    client.post("/v1/twins", json=SPEC)
    values = {"T_px": [0.0] * 60, "T_tank": [0.0] * 60, "Q_px": [0.5] * 60}
    client.post(f"{TWIN}/telemetry", json={"time": list(range(60)), "values": values})
    client.post(f"{TWIN}/calibrations", json={"activate": True})
    until(lambda: client.get(f"{TWIN}/diagnoses").json()["jobs"])
    time.sleep(2.5)  # two more looks of the schedule
    assert [job["kind"] for job in client.get(f"{TWIN}/diagnoses").json()["jobs"]] == ["diagnosis"]
