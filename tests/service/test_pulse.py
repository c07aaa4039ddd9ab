"""Whether telemetry is live: by the clock of the service, channel by channel, through restarts and recordings."""

import time
from typing import Any

import pytest

from service.live.pulse import Beat
from tests.service.conftest import SPEC
from tests.service.fakes import FakeWorkbench
from tests.service.harness import AppClient

TWIN = "/v1/twins/benchsat"


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time of this machine, which a test may set."""
    now = [1_800_000_000.0]
    monkeypatch.setattr(time, "time_ns", lambda: int(now[0] * 1e9))
    monkeypatch.setattr("service.fleet.bus.keep_to", lambda *_: None)  # the database has a clock of its own
    monkeypatch.setattr("service.instants._behind_us", 0)
    return now


def make(make_client: Any) -> AppClient:
    client = make_client(workbench=FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    return client


def send(client: AppClient, times: list[float], **values: list) -> None:
    answer = client.post(f"{TWIN}/telemetry", json={"time": times, "values": values})
    assert answer.json()["accepted"] == len(times)


def channels(client: AppClient) -> dict[str, dict]:
    return client.get(TWIN).json()["telemetry"]


def states(client: AppClient) -> dict[str, str]:
    return {name: row["state"] for name, row in channels(client).items()}


def test_a_channel_is_stale_after_ten_of_its_own_intervals(make_client, clock: list[float]) -> None:
    client = make(make_client)
    assert states(client) == {"T_px": "never", "T_tank": "never", "Q_px": "never"}
    begin = clock[0]
    for k in range(40):  # one channel every 10 s, the other every minute
        clock[0] = begin + 10.0 * k + 0.5
        send(client, [begin + 10.0 * k], T_px=[290.0], T_tank=[15.0 if k % 6 == 0 else None])
    found = channels(client)
    assert (found["T_px"]["interval_s"], found["T_px"]["stale_after_s"], found["T_px"]["age_s"]) == (10.0, 100.0, 0.0)
    assert (found["T_tank"]["interval_s"], found["T_tank"]["stale_after_s"]) == (60.0, 600.0)
    assert (found["T_px"]["delay_s"], found["Q_px"]["state"]) == (0.5, "never")
    last = clock[0]
    for silent_s, expected in ((99.0, ("live", "live")), (101.0, ("stale", "live")), (700.0, ("stale", "stale"))):
        clock[0] = last + silent_s
        found = channels(client)
        assert (found["T_px"]["state"], found["T_tank"]["state"]) == expected
        assert found["T_px"]["age_s"] == pytest.approx(silent_s)


def test_a_recording_is_delayed_while_it_plays_and_stale_after_it(make_client, clock: list[float]) -> None:
    client = make(make_client)
    send(client, [60.0 * k for k in range(100)], T_px=[290.0] * 100)
    assert states(client)["T_px"] == "delayed"
    clock[0] += 601.0
    assert states(client)["T_px"] == "stale"


def test_a_restart_forgets_nothing_of_it(make_client, clock: list[float]) -> None:
    first = make(make_client)
    begin = clock[0] - 100.0
    send(first, [begin, begin + 50.0, begin + 100.0], T_px=[290.0] * 3, T_tank=[15.0, None, None])
    before = channels(first)
    first.close()
    again = make_client(workbench=FakeWorkbench)
    assert channels(again) == before
    again.request("DELETE", f"{TWIN}/telemetry", params={"start": begin + 60.0})
    assert (
        channels(again)["T_px"]["interval_s"] == 50.0
        and channels(again)["T_px"]["last_time"] < before["T_px"]["last_time"]
    )


def calibrate(client: AppClient) -> None:
    """Let a first model be active."""
    path = client.post(f"{TWIN}/calibrations", json={"activate": True}).headers["location"]
    while client.get(path).json()["state"] in ("queued", "running"):
        time.sleep(0.02)


def test_a_forecast_says_that_telemetry_stopped(make_client, clock: list[float]) -> None:
    client = make(make_client)
    begin = clock[0] - 100.0
    send(client, [begin + k for k in range(100)], T_px=[290.0] * 100, T_tank=[15.0] * 100, Q_px=[0.5] * 100)
    calibrate(client)
    fresh = client.get(f"{TWIN}/forecast", params={"horizon_s": 60}).json()
    assert fresh["notices"] == ["held the last readings"]
    clock[0] += 10_000.0
    late = client.get(f"{TWIN}/forecast", params={"horizon_s": 60}).json()
    assert any("no telemetry has arrived for 2 h 47 min" in notice for notice in late["notices"])


def test_a_forecast_says_that_telemetry_arrives_late(make_client, clock: list[float]) -> None:
    client = make(make_client)
    told = []
    for late_s in (269 * 86_400.0, 300.0, 61.0, 59.0, 0.0):
        begin = clock[0] - late_s - 99.0
        send(client, [begin + k for k in range(100)], T_px=[290.0] * 100, T_tank=[15.0] * 100, Q_px=[0.5] * 100)
        if not told:
            path = client.post(f"{TWIN}/calibrations", json={"activate": True}).headers["location"]
            while client.get(path).json()["state"] in ("queued", "running"):
                time.sleep(0.02)
        found = client.get(f"{TWIN}/forecast", params={"horizon_s": 60}).json()
        assert found["behind_s"] == 0.0
        told.append([notice for notice in found["notices"][1:] if "frozen" not in notice])
        clock[0] += 1000.0
    assert told == [
        ["telemetry arrives 269 d late: this forecast starts at 2026-04-21T08:00:00Z"],
        ["telemetry arrives 5 min late: this forecast starts at 2027-01-15T08:11:40Z"],
        ["telemetry arrives 1 min 1 s late: this forecast starts at 2027-01-15T08:32:19Z"],
        [],
        [],
    ]
    send(client, [clock[0] - 1.0, clock[0]], T_px=[290.0] * 2, T_tank=[15.0] * 2)
    send(client, [clock[0] - 7200.0], T_px=[290.0], T_tank=[15.0])  # what was missing is handed in later
    assert states(client)["T_px"] == "live"
    assert all("arrives" not in text for text in client.get(f"{TWIN}/forecast?horizon_s=60").json()["notices"])


def test_a_forecast_says_that_it_begins_ahead_of_the_clock(make_client, clock: list[float]) -> None:
    """Three frames of a clock that is 250 s fast, within the tolerance, move the present; live telemetry with jitter does not."""
    client = make(make_client)

    def frames(first: float, count: int, T_px: float = 290.0) -> None:
        times = [first + k for k in range(count)]
        send(client, times, T_px=[T_px] * count, T_tank=[15.0] * count, Q_px=[0.5] * count)

    def told() -> list[str]:
        found = client.get(f"{TWIN}/forecast", params={"horizon_s": 60}).json()
        return [notice for notice in found["notices"] if "clock" in notice]

    begin = clock[0]
    frames(begin - 99.0, 100)
    calibrate(client)
    clock[0] = begin - 1.5
    assert told() == []
    clock[0] = begin
    frames(begin + 250.0, 3, 250.0)
    clock[0] = begin + 10.0
    frames(begin + 1.0, 10)
    (notice,) = told()
    assert notice == (
        "this forecast starts at 2027-01-15T08:04:12Z, 4 min 2 s ahead of this service's clock: the clock of the newest samples "
        "may be wrong; if so, DELETE /v1/twins/benchsat/telemetry takes them away"
    )
    client.request("DELETE", f"{TWIN}/telemetry", params={"start": begin + 200.0})
    assert told() == []


def test_a_forecast_names_the_sensors_that_arrive_late_while_others_do_not(make_client, clock: list[float]) -> None:
    client = make(make_client)
    begin = clock[0] - 7300.0
    send(client, [begin + k for k in range(100)], T_tank=[15.0] * 100, Q_px=[0.5] * 100)
    send(client, [clock[0] - k for k in range(100)], T_px=[290.0] * 100, Q_px=[0.5] * 100)
    calibrate(client)
    notices = client.get(f"{TWIN}/forecast", params={"horizon_s": 60}).json()["notices"]
    assert "telemetry of T_tank arrives 2 h late" in notices and states(client)["T_tank"] == "delayed"


def test_a_forecast_says_of_which_inputs_nothing_comes_any_more(make_client, clock: list[float]) -> None:
    client = make(make_client)
    begin = clock[0] - 100.0
    send(client, [begin + k for k in range(100)], T_px=[290.0] * 100, T_tank=[15.0] * 100, Q_px=[0.5] * 100)
    calibrate(client)
    ahead = {"horizon_s": 60.0, "step_s": 60.0}
    told = []
    for silent_s in (30.0, 10_800.0):
        clock[0] = begin + 99.0 + silent_s
        send(client, [clock[0] - k for k in range(20)], T_px=[290.0] * 20, T_tank=[15.0] * 20)
        told.append(client.get(f"{TWIN}/forecast", params=ahead).json()["notices"])
    line = "no telemetry of Q_px for 3 h: what is assumed of it rests on what came before"
    assert told == [["held the last readings"], ["held the last readings", line]]
    assert channels(client)["Q_px"]["state"] == "stale"
    plan = {"time": [clock[0]], "values": {"Q_px": [1.0]}}
    assert line not in client.post(f"{TWIN}/forecasts", json={**ahead, "plan": plan}).json()["notices"]
    client.request("DELETE", f"{TWIN}/telemetry", params={"start": begin + 1.0, "channels": "Q_px"})
    setting = client.get(f"{TWIN}/forecast", params=ahead).json()  # it was sent once: nobody expects it again
    assert setting["notices"][1:] == []


def test_readings_that_repeat_are_a_sign(make_client) -> None:
    client = make(make_client)
    wobble = [290.0 + 0.25 * (k * 7 % 5) for k in range(200)]
    send(
        client,
        [float(k) for k in range(200)],
        T_px=wobble,
        T_tank=[15.0 + 0.25 * (k * 3 % 7) for k in range(200)],
        Q_px=[0.5] * 200,
    )
    calibrate(client)
    send(client, [200.0 + k for k in range(60)], T_px=[290.0] * 60, T_tank=[None] * 60)
    client.get(f"{TWIN}/residuals")
    found = channels(client)
    assert "stuck" in found["T_px"]["signs"] and "dropout" in found["T_tank"]["signs"]


def test_where_nobody_noted_the_reception_a_channel_is_not_called_live() -> None:
    old = Beat(5, None, 1.0)
    assert (old.standing(6), old.silent_s(6), old.delay_s) == ("stale", None, None)


def test_a_pulse_that_is_brought_up_is_that_of_all_samples_at_once(make_client, clock: list[float]) -> None:
    """Whatever came in between, in whatever order: a flood of old samples after a few new ones, and late ones."""
    client = make(make_client)
    begin = clock[0] - 10_000.0
    send(client, [begin + k for k in range(600)], T_px=[290.0] * 600, T_tank=[15.0] * 600, Q_px=[0.5] * 600)
    assert channels(client)["T_px"]["last_time"] is not None
    send(client, [begin + 9_000.0 + k for k in range(20)], T_px=[291.0] * 20, Q_px=[0.5] * 20)
    for first in (1_000.0, 2_000.0, 3_000.0):
        send(client, [begin + first + k for k in range(700)], T_px=[290.0] * 700, Q_px=[0.5] * 700)
    send(client, [begin + 8_000.0 + k for k in range(5)], T_tank=[15.0] * 5)
    found = channels(client)
    client.close()
    again = make_client(workbench=FakeWorkbench)  # it looks through everything
    assert channels(again) == found
