"""The live state: residuals, anomalies and forecasts after each sample, late ones included."""

import json
import os
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from service.live import following, forecasts, tracker
from service.store.errors import Unavailable
from service.stream import past
from service.workbench.interface import Filtered, Json, Telemetry
from tests.service.conftest import SPEC, Sql
from tests.service.fakes import DEADLY, UNFIT, FakeWorkbench
from tests.service.harness import AppClient, notices, until

TWIN = "/v1/twins/benchsat"


@pytest.fixture
def client(make_client) -> AppClient:
    client = make_client(workbench=FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    return client


SCALE_K = 0.25
"""Keeps the ramp of squares within temperatures that an instrument reads; a power of two, so that sums stay exact."""


def send(client: AppClient, time_s: list[float], T_px: list[float | None], **more: list) -> None:
    values = {"T_px": T_px, "T_tank": [0.0] * len(time_s), "Q_px": [0.5] * len(time_s), **more}
    assert client.post(f"{TWIN}/telemetry", json={"time": time_s, "values": values}).status_code == 200


def calibrate(client: AppClient) -> None:
    path = client.post(f"{TWIN}/calibrations", json={"activate": True}).headers["location"]
    while client.get(path).json()["state"] in ("queued", "running"):
        time.sleep(0.02)
    assert client.get(path).json()["state"] == "succeeded"


def squares(client: AppClient) -> dict[str, float]:
    """Ramp of squares at 0..99 s, the model calibrated on them; return residuals by time."""
    send(client, list(range(100)), [SCALE_K * k * k for k in range(100)])
    calibrate(client)
    return residuals(client)


def residuals(client: AppClient, **parameters: str | int) -> dict[str, float]:
    found = client.get(f"{TWIN}/residuals", params=parameters).json()
    assert set(found["residual_K"]) == {"T_px", "T_tank"}
    assert len(found["time"]) == len(found["nis"]) == len(found["model_version"])
    return dict(zip(found["time"], found["residual_K"]["T_px"], strict=True))


def test_the_archive_is_assimilated_when_a_model_becomes_active(client: AppClient) -> None:
    assert residuals(client) == {}
    found = squares(client)
    np.testing.assert_allclose(list(found.values()), [0, *[SCALE_K * (2 * k - 1) for k in range(1, 100)]])
    part = residuals(client, start=10, stop="1970-01-01T00:00:12Z")
    assert part == {"1970-01-01T00:00:10Z": SCALE_K * 19, "1970-01-01T00:00:11Z": SCALE_K * 21}


def test_new_samples_go_on_from_the_state(client: AppClient) -> None:
    squares(client)
    send(client, [100], [SCALE_K * 10_000])
    send(client, [101, 102], [None, SCALE_K * 10_003])
    found = list(residuals(client).values())
    assert found[100:] == [SCALE_K * 199, None, None]
    assert len(found) == 103


def test_a_late_sample_gives_what_arrival_in_order_gives(client: AppClient) -> None:
    squares(client)
    for k in (100, 102, 103):
        send(client, [k], [SCALE_K * k * k])
        residuals(client)
    assert list(residuals(client).values())[-3:] == [SCALE_K * r for r in (199, 102**2 - 100**2, 205)]
    send(client, [101], [SCALE_K * 101**2])
    assert list(residuals(client).values())[-4:] == [SCALE_K * r for r in (199, 201, 203, 205)]


def test_state_survives_a_restart(make_client) -> None:
    first = make_client(workbench=FakeWorkbench)
    first.post("/v1/twins", json=SPEC)
    squares(first)
    first.close()
    second = make_client(workbench=FakeWorkbench)
    send(second, [100], [SCALE_K * 10_000])
    found = list(residuals(second).values())
    assert len(found) == 101 and found[-1] == SCALE_K * 199


@pytest.mark.parametrize("unfit", [[105], [100, 101, 102, 109], list(range(100, 180))])
def test_samples_that_cannot_be_assimilated_are_skipped(client: AppClient, unfit: list[int]) -> None:
    squares(client)
    times = list(range(100, 300))
    send(client, times, [UNFIT if k in unfit else SCALE_K * 100 for k in times])
    found = residuals(client)
    assert not {f"1970-01-01T00:0{k // 60}:{k % 60:02d}Z" for k in unfit} & found.keys()
    lost = 300 - len(found)
    text = client.get("/metrics").text
    assert (
        f"twin_skipped_samples_total {lost:.1f}" in text and f"twin_assimilated_samples_total {len(found):.1f}" in text
    )
    assert len(unfit) <= lost <= 2 * len(unfit)  # a stretch costs at most its own length of good samples after it
    assert client.get(f"{TWIN}/forecast", params={"horizon_s": 60}).status_code == 200
    send(client, [300], [SCALE_K * 101])
    assert residuals(client)["1970-01-01T00:05:00Z"] == SCALE_K


@pytest.mark.parametrize(
    ("module", "room", "name"),
    [(tracker, "progress", "lift_floor"), (tracker, "progress", "resume"), (following, "samples", "select")],
)
def test_an_outage_of_the_database_costs_no_residual(
    client: AppClient, monkeypatch: pytest.MonkeyPatch, module: ModuleType, room: str, name: str
) -> None:
    """Whatever of the assimilation it meets is done again, the start with a model too, without anybody having to ask."""
    squares(client)

    async def settled(self: tracker.Tracker, timeout_s: float) -> bool:
        return True

    monkeypatch.setattr(tracker.Tracker, "settled", settled)
    failures = iter([Unavailable("the database cannot be reached")] * 2)
    works = vars(getattr(module, room))

    def fails_at_first(*args: object) -> object:
        if (failure := next(failures, None)) is not None:
            raise failure
        return works[name](*args)

    monkeypatch.setattr(tracker, "RETRY_S", 0.1)
    monkeypatch.setattr(module, room, SimpleNamespace(**works | {name: fails_at_first}))
    calibrate(client)
    for k in range(100, 103):
        send(client, [k], [SCALE_K * k * k])
    until(lambda: len(residuals(client, version=2)) == 103)
    assert next(failures, None) is None
    np.testing.assert_allclose(list(residuals(client).values())[1:], [SCALE_K * (2 * k - 1) for k in range(1, 103)])
    assert "twin_skipped_samples_total 0.0" in client.get("/metrics").text


def test_an_archive_that_cannot_be_assimilated_says_why(client: AppClient) -> None:
    send(client, list(range(100)), [UNFIT] * 100)
    calibrate(client)
    assert residuals(client) == {}
    refused = client.get(f"{TWIN}/forecast", params={"horizon_s": 60})
    assert refused.status_code == 409 and "cannot make sense of a reading" in refused.json()["detail"]
    send(client, [100], [290.0])
    assert list(residuals(client).values()) == [0.0]


@pytest.mark.parametrize("jump_s", [-86_400.0, 86_400.0])
def test_a_jump_of_the_clock_changes_nothing_but_its_own_reading(
    client: AppClient, monkeypatch: pytest.MonkeyPatch, jump_s: float
) -> None:
    squares(client)
    before = client.get(f"{TWIN}/calibrations").json()["jobs"][0]
    real_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real_ns() + int(jump_s * 1e9))
    send(client, [100], [SCALE_K * 10_000])
    calibrate(client)
    assert len(residuals(client)) == 101
    after = client.get(f"{TWIN}/calibrations").json()["jobs"]
    assert [job["id"] for job in after][1] == before["id"]  # the newest first, whatever the clock says
    if (
        not client.app.state.service.database.is_shared
    ):  # whose clock every process comes back to within a second, in between
        assert after[0]["created"] <= after[0]["started"] <= after[0]["finished"]
    assert client.get(f"{TWIN}/forecast", params={"horizon_s": 60}).json()["model_version"] == 2
    assert client.get(TWIN).json()["active_model"] == 2
    numbers = [row["version"] for row in client.get(f"{TWIN}/models").json()["activations"]]
    assert numbers == [2, 1]


def test_another_model_has_residuals_of_its_own(client: AppClient) -> None:
    squares(client)
    calibrate(client)
    assert len(residuals(client)) == 100
    assert client.get(f"{TWIN}/residuals").json()["model_version"][0] == 2
    assert client.get(f"{TWIN}/residuals", params={"version": 1}).json()["model_version"][0] == 1


def test_forecast_from_the_state(client: AppClient) -> None:
    assert client.get(f"{TWIN}/forecast", params={"horizon_s": 60}).status_code == 409
    squares(client)
    send(client, [100], [7.0])
    found = client.get(f"{TWIN}/forecast", params={"horizon_s": 60, "step_s": 20}).json()
    assert found["time"] == [f"1970-01-01T00:0{m}:{s}Z" for m, s in ((2, "00"), (2, "20"), (2, "40"))]
    assert found["values"]["T_px"] == {"mean": [7, 7, 7], "q05": [6.55] * 3, "q50": [7] * 3, "q95": [7.45] * 3}
    assert (found["model_version"], found["from"]) == (1, "1970-01-01T00:01:40Z")
    assert found["units"] == {"T_px": "K", "T_tank": "degC"} and notices(found) == ["held the last readings"]
    plan = {"time": [110, "1970-01-01T00:02:00Z"], "values": {"Q_px": [1.0, 5.0]}}
    body = {"horizon_s": 60, "step_s": 60, "plan": plan, "quantiles": [0.975]}
    planned = client.post(f"{TWIN}/forecasts", json=body).json()
    assert planned["values"]["T_px"] == {"mean": [12.0], "q97.5": [12.475]}


def test_network_of_the_moment(client: AppClient) -> None:
    assert client.get(f"{TWIN}/network").status_code == 409
    squares(client)
    found = client.get(f"{TWIN}/network").json()
    assert (found["time"], found["nodes"][0]["temperature_K"]) == ("1970-01-01T00:01:39Z", SCALE_K * 99**2)


WRONG_FORECASTS = (
    ({}, "horizon_s"),
    ({"horizon_s": -5}, "horizon_s"),
    ({"horizon_s": 1e15}, "horizon_s"),
    ({"horizon_s": "long"}, "horizon_s"),
    ({"horizon_s": 10, "step_s": 20}, "step_s"),
    ({"horizon_s": 10, "step_s": 1e-9}, "step_s"),
    ({"horizon_s": 10, "quantiles": [0.5, 1.0]}, "quantiles[1]"),
    ({"horizon_s": 10, "quantiles": []}, "quantiles"),
    ({"horizon_s": 10, "plan": {"time": [1], "values": {"Q": [1]}}}, "plan.values.Q"),
    ({"horizon_s": 10, "plan": {"time": [1], "values": {"Q_px": []}}}, "plan.values.Q_px"),
    ({"horizon_s": 10, "plan": {"time": [99, 99], "values": {"Q_px": [1, 2]}}}, "plan.time[1]"),
    ({"horizon_s": 10, "plan": {"time": [105, 102], "values": {"Q_px": [1, 2]}}}, "plan.time[1]"),
    ({"horizon_s": 10, "plan": {"time": [99], "values": {"T_px": [290]}}}, "plan.values.T_px"),
    ({"horizon_s": 10, "plan": {"time": [99, 100], "values": {"Q_px": [None, None]}}}, "plan.values.Q_px"),
    ({"horizon_s": 10, "plan": {"time": [99, 100], "values": {"Q_px": [1, 1e300]}}}, "plan.values.Q_px[1]"),
    ({"horizon_s": 10, "plan": {"time": [9, 98], "values": {"Q_px": [1, 2]}}}, "plan.time: ends before"),
    ({"horizon_s": 10, "plan": {"time": [110, 120], "values": {"Q_px": [1, 2]}}}, "plan.time: begins after"),
    ({"horizon_s": 10, "plan": {"time": ["x"], "values": {"Q_px": [1]}}}, "plan.time[0]"),
)


def test_wrong_forecast_requests(client: AppClient) -> None:
    squares(client)
    for body, field in WRONG_FORECASTS:
        response = client.post(f"{TWIN}/forecasts", json=body)
        assert response.status_code == 422, (body, response.text)
        assert field in response.json()["detail"]


def test_an_anomaly_opens_and_closes(client: AppClient) -> None:
    send(client, list(range(100)), [0.0] * 100)
    calibrate(client)
    jumps = [40.0 * (k % 2) for k in range(30)]
    send(client, list(range(100, 130)), jumps)
    residuals(client)
    (anomaly,) = client.get(f"{TWIN}/anomalies").json()["anomalies"]
    assert anomaly["cause"] is None
    assert (anomaly["sensor"], anomaly["start"], anomaly["stop"]) == ("T_px", "1970-01-01T00:01:41Z", None)
    send(client, list(range(130, 330)), [0.0] * 200)
    residuals(client)
    (closed,) = client.get(f"{TWIN}/anomalies").json()["anomalies"]
    assert closed["id"] == anomaly["id"] and closed["stop"] is not None
    assert closed["score"] >= anomaly["score"] > 5
    assert client.get(f"{TWIN}/anomalies", params={"start": 320}).json() == {"anomalies": []}


def test_a_diagnosis_names_the_cause(client: AppClient) -> None:
    send(client, list(range(100)), [0.0] * 100)
    calibrate(client)
    send(client, list(range(100, 130)), [40.0 * (k % 2) for k in range(30)])
    residuals(client)
    path = client.post(f"{TWIN}/diagnoses").headers["location"]
    while client.get(path).json()["state"] in ("queued", "running"):
        time.sleep(0.02)
    (anomaly,) = client.get(f"{TWIN}/anomalies").json()["anomalies"]
    assert anomaly["cause"]["effect"] == "constant_heat_load"
    assert anomaly["cause"]["where"] == {"node": "px"}


def counted(client: AppClient, name: str) -> float:
    lines = client.get("/metrics").text.splitlines()
    return float(next(line for line in lines if line.startswith(f"{name} ")).split()[1])


DAYS = 86_400.0
LATER = 5000 * DAYS


@pytest.mark.parametrize("wrong", ["2190-01-01T00:00:00Z", 5, LATER + 100 + 3600])
def test_a_sample_of_a_wrong_clock_moves_nothing(client: AppClient, wrong: str | float) -> None:
    send(client, [LATER + k for k in range(100)], [SCALE_K * k * k for k in range(100)])
    calibrate(client)
    residuals(client)
    send(client, [wrong], [290.0])
    send(client, [LATER + 100], [SCALE_K * 10_000])
    assert list(residuals(client).values())[-1] == SCALE_K * 199
    found = client.get(f"{TWIN}/forecast", params={"horizon_s": 60}).json()
    assert found["from"] == "1983-09-10T00:01:40Z"
    assert ("its clock may be wrong" in "".join(found["notices"])) == (wrong != 5)
    assert counted(client, "twin_assimilated_samples_total") == 101  # nothing was filtered twice


def test_once_others_follow_a_lone_sample_takes_part(client: AppClient) -> None:
    squares(client)
    send(client, [3600], [290.0])
    assert len(residuals(client)) == 100
    send(client, [3601], [291.0])
    assert list(residuals(client).values())[-2:] == [290.0 - SCALE_K * 99**2, 1.0]
    found = client.get(f"{TWIN}/forecast", params={"horizon_s": 60}).json()
    assert found["from"] == "1970-01-01T01:00:01Z" and notices(found) == ["held the last readings"]
    sent = [m for m in messages(client) if m["type"] == "residual"]
    assert [m["time"] for m in sent] == ["1970-01-01T01:00:00Z", "1970-01-01T01:00:01Z"]


def messages(client: AppClient) -> list[dict]:
    """Return every message of the twin's stream."""
    service = client.app.state.service
    twin = service.registry.get("benchsat")
    read = service.database.read
    arguments = (past.since_seq, twin.key, twin.channels, twin.sensors, 0, 10_000)
    return client.portal.call(lambda: read(*arguments))


def test_samples_of_a_wrong_past_cost_no_more_than_themselves(client: AppClient) -> None:
    send(client, [LATER + k for k in range(100)], [SCALE_K * k * k for k in range(100)])
    calibrate(client)
    before = residuals(client)
    for wrong in ([1000 * DAYS, 1000 * DAYS + 1], [1000 * DAYS + 3], [5, 6]):
        send(client, wrong, [290.0 + k for k in range(len(wrong))])
        residuals(client)
    send(client, [LATER + 100], [SCALE_K * 100**2])
    found = residuals(client)
    assert len(found) == 106 and {when: found[when] for when in before} == before
    assert list(found.values())[-1] == SCALE_K * 199
    assert found["1970-01-01T00:00:06Z"] == 1.0 and found["1972-09-27T00:00:03Z"] == -1.0
    assert counted(client, "twin_assimilated_samples_total") == 106  # nothing was filtered twice
    send(client, [LATER + 50.5], [SCALE_K * 50.5**2])  # in the present record everything is as ever
    assert len(residuals(client)) == 107
    found = client.get(f"{TWIN}/forecast", params={"horizon_s": 60}).json()
    assert found["from"] == "1983-09-10T00:01:40Z"


def test_late_samples_of_two_records_end_each_in_its_own(client: AppClient) -> None:
    squares(client)
    send(client, [LATER + k for k in range(100)], [SCALE_K * k * k for k in range(100)])
    before = residuals(client)
    send(client, [50.5, LATER + 50.5], [SCALE_K * 50.5**2] * 2)
    found = residuals(client)
    assert len(found) == 202
    for start in ("1970-01-01", "1983-09-10"):
        assert found[f"{start}T00:00:50.500000Z"] == SCALE_K * (50.5**2 - 50**2)
        assert found[f"{start}T00:00:51Z"] == SCALE_K * (51**2 - 50.5**2)
        assert found[f"{start}T00:01:39Z"] == before[f"{start}T00:01:39Z"]


class Powered(FakeWorkbench):
    """Gives the power that holds for the NIS."""

    def filtered(self, document: str, telemetry: Telemetry, state: Json | None) -> Filtered:
        power = telemetry.values["Q_px"]
        last = np.maximum.accumulate(np.where(np.isfinite(power), np.arange(power.size), 0))
        return replace(super().filtered(document, telemetry, state), nis=power[last])


@pytest.mark.parametrize(
    ("late_W", "opening_W", "expected_W"), [(5.0, None, 5.0), (5.0, 2.0, 2.0), (None, None, 0.5), (0.5, None, 0.5)]
)
def test_an_input_that_came_late_holds_over_a_long_gap(
    make_client, late_W: float | None, opening_W: float | None, expected_W: float
) -> None:
    client = make_client(workbench=Powered)
    client.post("/v1/twins", json=SPEC)
    squares(client)
    send(client, [LATER + k for k in range(10)], [290.0] * 10, Q_px=[opening_W] + [None] * 9)
    residuals(client)
    send(client, [99.5], [290.0], Q_px=[late_W])
    residuals(client)
    found = client.get(f"{TWIN}/residuals").json()
    assert found["nis"] == [0.5] * 100 + [late_W or 0.5] + [expected_W] * 10
    send(client, [LATER + 10], [290.0], Q_px=[None])
    residuals(client)
    assert client.get(f"{TWIN}/residuals", params={"start": LATER}).json()["nis"] == [expected_W] * 11


class Slow(FakeWorkbench):
    """Takes more than a second for what the archive of a test holds."""

    def filtered(self, document: str, telemetry: Telemetry, state: Json | None) -> Filtered:
        time.sleep(1.2 if telemetry.time_us.size > 90 else 0.0)
        return super().filtered(document, telemetry, state)


def test_a_clock_that_stays_wrong_does_not_hold_up_the_present(make_client) -> None:
    client = make_client(workbench=Slow)
    client.post("/v1/twins", json=SPEC)
    squares(client)
    for k in range(6):
        send(client, [0.5 + k], [SCALE_K * (0.5 + k) ** 2])
        send(client, [100 + k], [SCALE_K * (100.0 + k) ** 2])
        assert f"1970-01-01T00:01:{40 + k}Z" in residuals(client)
    until(lambda: len(residuals(client)) == 112)
    found = residuals(client)
    line = np.unique([*np.arange(6) + 0.5, *range(106)])
    expected = np.diff(SCALE_K * line**2, prepend=0.0)
    np.testing.assert_array_equal(list(found.values()), expected)
    assert counted(client, "twin_assimilated_samples_total") < 5 * 100  # each return costs a hundred


def test_an_anomaly_ends_with_its_record(client: AppClient) -> None:
    before = lasting(client)
    send(client, [LATER + k for k in range(30)], [40.0] * 30)
    residuals(client)
    (anomaly,) = client.get(f"{TWIN}/anomalies").json()["anomalies"]
    assert anomaly["id"] == before["id"]
    assert anomaly["stop"] == "1970-01-01T00:02:09Z"


def test_after_a_long_gap_the_second_sample_brings_the_first(client: AppClient) -> None:
    squares(client)
    send(client, [LATER], [290.0])
    assert len(residuals(client)) == 100
    send(client, [LATER + 1], [291.0])
    found = residuals(client)
    assert len(found) == 102 and found["1983-09-10T00:00:01Z"] == 1.0
    send(client, [100, 101], [SCALE_K * 100**2, SCALE_K * 101**2])  # of before the gap: nothing is done again
    found = residuals(client)
    assert len(found) == 104 and found["1970-01-01T00:01:41Z"] == SCALE_K * 201
    assert counted(client, "twin_assimilated_samples_total") == 104


def test_a_sample_that_kills_the_worker_is_skipped(client: AppClient) -> None:
    squares(client)
    send(client, [100], [DEADLY])
    assert len(residuals(client)) == 100
    send(client, [101], [SCALE_K * 101**2])
    found = residuals(client)
    assert list(found)[-1] == "1970-01-01T00:01:41Z" and len(found) == 101
    assert counted(client, "twin_skipped_samples_total") == 1


def test_samples_in_order_are_never_taken_for_late_ones(client: AppClient) -> None:
    squares(client)
    for k in range(100, 400):
        send(client, [k], [SCALE_K * 100])
    assert len(residuals(client)) == 400
    assert counted(client, "twin_assimilated_samples_total") == 400


def test_a_late_sample_that_was_stored_before_a_crash_is_assimilated_after_it(make_client) -> None:
    first = make_client(workbench=FakeWorkbench)
    first.post("/v1/twins", json=SPEC)
    squares(first)
    send(first, [102], [SCALE_K * 102**2])
    residuals(first)
    first.close()
    deaf = make_client(workbench=FakeWorkbench, assimilate=False)
    send(deaf, [101], [SCALE_K * 101**2])
    deaf.close()
    again = make_client(workbench=FakeWorkbench)
    assert list(residuals(again).values())[-1] == SCALE_K * (102**2 - 101**2)


def lasting(client: AppClient, stop: int = 130) -> dict:
    """Return the one anomaly of a sensor that begins to jump at 100 s."""
    send(client, list(range(100)), [0.0] * 100)
    calibrate(client)
    send(client, list(range(100, stop)), [40.0 * (k % 2) for k in range(100, stop)])
    residuals(client)
    (anomaly,) = client.get(f"{TWIN}/anomalies").json()["anomalies"]
    return anomaly


def test_an_anomaly_outlives_a_late_sample_with_number_and_cause(client: AppClient) -> None:
    before = lasting(client)
    path = client.post(f"{TWIN}/diagnoses").headers["location"]
    while client.get(path).json()["state"] in ("queued", "running"):
        time.sleep(0.02)
    send(client, [50.5], [0.0])
    residuals(client)
    (after,) = client.get(f"{TWIN}/anomalies").json()["anomalies"]
    assert (after["id"], after["start"], after["stop"]) == (before["id"], before["start"], None)
    assert after["cause"]["effect"] == "constant_heat_load"


def test_an_anomaly_that_a_late_sample_refutes_is_gone(client: AppClient) -> None:
    send(client, list(range(100)), [0.0] * 100)
    calibrate(client)
    send(client, [100, 101, 102], [0.0, 0.0, 60.0])
    residuals(client)
    (anomaly,) = client.get(f"{TWIN}/anomalies").json()["anomalies"]
    assert anomaly["start"] == "1970-01-01T00:01:42Z"
    send(client, [101.5], [60.0])
    residuals(client)
    (moved,) = client.get(f"{TWIN}/anomalies").json()["anomalies"]
    assert moved["start"] == "1970-01-01T00:01:41.500000Z"


def test_an_anomaly_is_told_when_it_opens_grows_or_closes_and_not_with_every_sample(
    client: AppClient, sql: Sql
) -> None:
    lasting(client)
    for k in range(130, 200):
        send(client, [k], [40.0 * (k % 2)])
        residuals(client)
    (anomaly,) = client.get(f"{TWIN}/anomalies").json()["anomalies"]
    send(client, list(range(200, 500)), [0.0] * 300)
    residuals(client)
    told = [
        json.loads(body)["anomaly"] for (body,) in sql("SELECT body FROM event WHERE type = 'anomaly' ORDER BY seq")
    ]
    assert {row["id"] for row in told} == {anomaly["id"]}
    assert told[-1]["stop"] is not None and [row["stop"] for row in told[:-1]] == [None] * (len(told) - 1)
    scores = [row["score"] for row in told[:-1]]
    assert all(after >= 1.1 * before for before, after in pairwise(scores))  # each of them is news


def test_a_rollback_finds_its_anomalies_as_they_were(client: AppClient) -> None:
    before = lasting(client)
    calibrate(client)
    residuals(client)
    (other,) = client.get(f"{TWIN}/anomalies").json()["anomalies"]
    assert (other["model_version"], other["start"]) == (2, before["start"])
    (past,) = client.get(f"{TWIN}/anomalies", params={"version": 1}).json()["anomalies"]
    assert past == before | {"stop": "1970-01-01T00:02:09Z"}
    client.post(f"{TWIN}/models/1/activate")
    residuals(client)
    assert client.get(f"{TWIN}/anomalies").json()["anomalies"] == [before]
    assert client.get(f"{TWIN}/anomalies", params={"version": 9}).status_code == 404


class Gated(FakeWorkbench):
    """Assimilates once a file is there."""

    def filtered(self, document: str, telemetry: Telemetry, state: Json | None) -> Filtered:
        while not Path(os.environ["FAKE_GATE"]).exists():
            time.sleep(0.02)
        return super().filtered(document, telemetry, state)


def test_a_twin_says_while_it_catches_up(make_client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE_GATE", str(tmp_path / "gate"))
    client = make_client(workbench=Gated)
    assert client.post("/v1/twins", json=SPEC).json()["catching_up"] is False
    send(client, list(range(100)), [290.0] * 100)
    calibrate(client)
    while client.get(TWIN).json()["catching_up"] is not True:
        time.sleep(0.02)
    with monkeypatch.context() as impatient:
        impatient.setattr(forecasts, "SETTLE_S", 0.1)
        found = client.get(f"{TWIN}/residuals").json()
        assert found["time"] == [] and found["complete"] is False
    (tmp_path / "gate").touch()
    assert len(residuals(client)) == 100 and client.get(f"{TWIN}/residuals").json()["complete"] is True
    assert client.get(TWIN).json()["catching_up"] is False
    send(client, [100], [290.0])
    assert client.get(TWIN).json()["catching_up"] is False  # one sample is nothing to catch up with


def test_what_was_stored_counts_though_word_of_it_is_late(client: AppClient, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who sees a model or a sample in the database may ask what follows from it before the tracker has heard of it."""
    for name in ("model_changed", "arrived"):
        monkeypatch.setattr(f"service.live.live.Live.{name}", lambda live, twin: None)
    assert len(squares(client)) == 100
    send(client, [100], [SCALE_K * 10_000])
    assert client.get(f"{TWIN}/forecast", params={"horizon_s": 10}).json()["from"] == "1970-01-01T00:01:40Z"
    calibrate(client)
    assert client.get(f"{TWIN}/forecast", params={"horizon_s": 10}).json()["model_version"] == 2
