"""Limits as an operator meets them: readings and forecasts beyond them, alarms that are acknowledged and shelved."""

import copy
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.store import alarms as store
from service.store import samples
from service.store.connection import Connection
from service.workbench.interface import Forecasted, ForecastTask
from tests.service.conftest import SPEC
from tests.service.fakes import FakeWorkbench
from tests.service.harness import AppClient, until
from tests.service.server import FAKE, Server
from tests.service.test_live import messages

TWIN = "/v1/twins/benchsat"
LIMITED: dict[str, Any] = copy.deepcopy(SPEC)
LIMITED["channels"]["T_px"]["limits"] = {"yellow": [280.0, 300.0], "red": [270.0, 310.0]}
LIMITED["channels"]["T_tank"]["limits"] = {"yellow": [None, 40.0]}
LIMITED["channels"]["Q_px"]["limits"] = {"red": [None, 100.0]}


class Warming(FakeWorkbench):
    """Foresees that T_px rises by 0.01 K/s, with 5 % and 95 % at 4 K on both sides."""

    def forecast(self, document: str, task: ForecastTask) -> Forecasted:
        made = super().forecast(document, task)
        ahead_s = (made.time_us - task.telemetry.time_us[-1]) / 1e6
        mean = made.mean["T_px"] + 0.01 * ahead_s
        made.mean["T_px"] = mean
        for q, columns in made.quantiles.items():
            columns["T_px"] = mean + 4.0 * (q - 0.5) / 0.45
            columns["T_tank"] = np.full(mean.size, 15.0)
        return made


@pytest.fixture
def client(make_client) -> AppClient:
    client = make_client(workbench=Warming)
    client.post("/v1/twins", json=LIMITED)
    return client


def send(client: AppClient, times: list[float], T_px: list[float], **more: list) -> None:
    values = {"T_px": T_px, "T_tank": [15.0] * len(times), "Q_px": [0.5] * len(times), **more}
    assert client.post(f"{TWIN}/telemetry", json={"time": times, "values": values}).status_code == 200


def alarms(client: AppClient, count: int, **wanted: Any) -> list[dict]:
    """Return the alarms once there are so many of them that are as wanted."""
    found: list[dict] = []

    def so_many() -> bool:
        rows = client.get(f"{TWIN}/alarms").json()["alarms"]
        found[:] = [row for row in rows if all(row[name] == value for name, value in wanted.items())]
        return len(found) == count

    until(so_many)
    return found


def test_a_reading_beyond_a_limit_raises_an_alarm_that_ends_with_a_dead_band(client: AppClient) -> None:
    send(client, [0, 1, 2, 3, 4], [290.0, 301.0, 290.0, 301.0, 302.5])
    (yellow,) = alarms(client, 1)
    assert (yellow["channel"], yellow["colour"], yellow["side"], yellow["limit"]) == ("T_px", "yellow", "high", 300.0)
    assert (yellow["on"], yellow["start"], yellow["stop"]) == ("measured", "1970-01-01T00:00:03Z", None)
    assert (yellow["worst"], yellow["unit"]) == (302.5, "K")
    assert yellow["message"] == "T_px is above its yellow limit of 300 K: 302.5 at worst"
    send(client, [5, 6, 7, 8], [311.0, 312.0, 299.8, 299.9])  # within the dead band of 3 noises, 0.3 K
    yellow, red = alarms(client, 2)  # what lasts comes first
    assert (yellow["stop"], red["start"]) == (None, "1970-01-01T00:00:05Z")
    assert {row["colour"]: row["stop"] for row in (red, yellow)} == {"yellow": None, "red": "1970-01-01T00:00:07Z"}
    send(client, [9, 10], [299.0, 299.0])
    (over,) = alarms(client, 1, colour="yellow", stop="1970-01-01T00:00:09Z")
    assert over["message"] == "T_px was above its yellow limit of 300 K: 312 at worst"
    told = [m["alarm"] for m in messages(client) if m["type"] == "alarm"]
    assert [(row["colour"], row["stop"] is None) for row in told] == [
        ("yellow", True),
        ("red", False),
        ("yellow", False),
    ]


def test_each_side_and_each_kind_of_channel(client: AppClient) -> None:
    send(client, [0, 1], [265.0, 264.0], T_tank=[41.0, 42.0], Q_px=[150.0, 150.0])
    rows = alarms(client, 4)
    assert {(row["channel"], row["colour"], row["side"], row["unit"]) for row in rows} == {
        ("T_px", "yellow", "low", "K"),
        ("T_px", "red", "low", "K"),
        ("T_tank", "yellow", "high", "degC"),
        ("Q_px", "red", "high", "W"),
    }
    assert [row["colour"] for row in rows] == ["red", "red", "yellow", "yellow"]
    assert "T_tank is above its yellow limit of 40 °C: 42 at worst" in [row["message"] for row in rows]
    text = client.get("/metrics").text
    assert 'twin_open_alarms{colour="red",twin="benchsat"} 2.0' in text


def test_markers_of_missing_samples_raise_nothing(client: AppClient) -> None:
    send(client, [0, 1, 2, 3], [290.0, -999.0, -999.0, 290.0], T_tank=[41.0] * 4)
    alarms(client, 1, channel="T_tank")
    send(client, [10, 11], [290.0, 290.0], T_tank=[41.0] * 2, Q_px=[150.0, 150.0])
    alarms(client, 1, channel="Q_px")
    assert {row["channel"] for row in alarms(client, 2)} == {"T_tank", "Q_px"}


def send_one(client: AppClient, channel: str, times: list[float], values: list[float]) -> None:
    """Send one channel by itself, and wait until it was looked at."""
    body = {"time": times, "values": {channel: values}}
    assert client.post(f"{TWIN}/telemetry", json=body).status_code == 200
    until(lambda: read(client, lambda connection, twin: not unseen(connection, twin)))


def read(client: AppClient, question: Callable[[Connection, int], Any]) -> Any:
    """Return what the database answers about the twin."""
    service = client.app.state.service
    return client.portal.call(lambda: service.database.read(question, service.registry.get("benchsat").key))


def unseen(connection: Connection, twin: int) -> int:
    """Return how many samples nobody has looked at."""
    seq, _ = store.watched(connection, twin)
    return int(samples.since_seq(connection, twin, len(LIMITED["channels"]), seq)[0].size)


def told(client: AppClient) -> list[tuple[str, str, bool]]:
    """Return what the stream said of alarms: channel, colour, whether it lasts."""
    found = [m["alarm"] for m in messages(client) if m["type"] == "alarm"]
    return [(row["channel"], row["colour"], row["stop"] is None) for row in found]


@pytest.mark.parametrize("ahead_s", [0.0, 60.0])
def test_a_channel_that_never_arrives_first_is_judged_by_itself(client: AppClient, ahead_s: float) -> None:
    for k in range(4):
        send_one(client, "Q_px", [k + ahead_s], [0.5])
        send_one(client, "T_px", [float(k)], [305.0])
    (alarm,) = alarms(client, 1)
    assert (alarm["start"], alarm["stop"]) == ("1970-01-01T00:00:00Z", None)


def test_a_recorder_dump_raises_an_alarm_that_is_over(client: AppClient) -> None:
    send_one(client, "T_px", [100.0, 101.0, 102.0], [290.0] * 3)
    send_one(client, "T_px", [10.0 + k for k in range(50)], [305.0] * 50)
    (alarm,) = alarms(client, 1)
    assert (alarm["start"], alarm["stop"]) == ("1970-01-01T00:00:10Z", "1970-01-01T00:01:40Z")
    assert alarm["message"] == "T_px was above its yellow limit of 300 K: 305 at worst"
    send_one(client, "T_px", [5.0, 6.0, 70.0], [305.0] * 3)  # the same alarm, known better
    (alarm,) = alarms(client, 1)
    assert alarm["start"] == "1970-01-01T00:00:05Z"
    send_one(client, "T_px", [103.0, 104.0], [305.0] * 2)
    alarms(client, 2)
    assert told(client) == [("T_px", "yellow", False), ("T_px", "yellow", True)]


def test_one_reading_ahead_of_the_others_hides_nothing(client: AppClient) -> None:
    send_one(client, "T_px", [290.0], [290.0])
    for k in range(5):  # one by one: each is looked at beside the one before
        send_one(client, "T_px", [float(k)], [305.0])
    (alarm,) = alarms(client, 1)
    assert (alarm["start"], alarm["stop"]) == ("1970-01-01T00:00:00Z", None)
    send_one(client, "T_px", [291.0], [290.0])
    alarms(client, 1, stop="1970-01-01T00:04:50Z")
    assert told(client) == [("T_px", "yellow", True), ("T_px", "yellow", False)]


def test_late_readings_neither_end_nor_repeat_an_alarm_that_lasts(client: AppClient) -> None:
    send_one(client, "T_px", [100.0, 101.0, 110.0, 111.0], [305.0] * 4)
    send_one(client, "T_px", [104.0, 105.0], [290.0] * 2)
    send_one(client, "T_px", [50.0, 51.0, 52.0, 53.0], [305.0, 305.0, 290.0, 290.0])
    now, before = alarms(client, 2)
    assert (now["start"], now["stop"]) == ("1970-01-01T00:01:40Z", None)
    assert (before["start"], before["stop"]) == ("1970-01-01T00:00:50Z", "1970-01-01T00:00:52Z")
    assert told(client) == [("T_px", "yellow", True), ("T_px", "yellow", False)]


def test_an_alarm_survives_a_restart_as_one(make_client) -> None:
    first = make_client(workbench=Warming)
    first.post("/v1/twins", json=LIMITED)
    send(first, [0, 1], [301.0, 301.0])
    (before,) = alarms(first, 1)
    first.close()
    again = make_client(workbench=Warming)
    send(again, [2, 3, 4], [303.0, 290.0, 290.0])
    (after,) = alarms(again, 1, stop="1970-01-01T00:00:03Z")
    assert (after["id"], after["start"], after["worst"]) == (before["id"], before["start"], 303.0)


def test_acknowledging_and_shelving(client: AppClient) -> None:
    send(client, [0, 1], [301.0, 301.0])
    (alarm,) = alarms(client, 1)
    seen = client.post(f"{TWIN}/alarms/{alarm['id']}/acknowledge", json={"note": "heater test"}).json()
    assert seen["acknowledged"]["note"] == "heater test" and seen["stop"] is None
    send(client, [2, 3], [311.0, 311.0])
    red, yellow = alarms(client, 2)
    assert (red["colour"], red["acknowledged"]) == ("red", None) and yellow["acknowledged"] is not None
    shelved = client.post(f"{TWIN}/alarms/{red['id']}/shelve", json={"for_s": 3600}).json()
    assert shelved["shelved_until"] is not None
    assert [row["colour"] for row in alarms(client, 2)] == ["yellow", "red"]  # what is shelved comes later
    assert 'twin_open_alarms{colour="red",twin="benchsat"} 0.0' in client.get("/metrics").text

    before = len([m for m in messages(client) if m["type"] == "alarm"])
    send(client, [4, 5, 6, 7], [305.0, 305.0, 312.0, 312.0])  # it ends and comes again: nobody wants to hear of it
    (_, new) = alarms(client, 2, colour="red")
    assert all(row["shelved_until"] == shelved["shelved_until"] for row in (_, new))
    assert len([m for m in messages(client) if m["type"] == "alarm"]) == before
    taken_up = client.post(f"{TWIN}/alarms/{new['id']}/shelve", json={"for_s": 0}).json()
    assert taken_up["shelved_until"] is None
    assert 'twin_open_alarms{colour="red",twin="benchsat"} 1.0' in client.get("/metrics").text


@pytest.mark.parametrize("is_taken_up", [True, False])
def test_an_alarm_that_began_while_shelved_is_told_once_it_is_not(client: AppClient, is_taken_up: bool) -> None:
    send(client, [0, 1, 2, 3], [301.0, 301.0, 290.0, 290.0])
    (alarm,) = alarms(client, 1)
    shelve_s = 3600.0 if is_taken_up else 2.0
    path = f"{TWIN}/alarms/{alarm['id']}/shelve"
    assert client.post(path, json={"for_s": shelve_s}).status_code == 200
    send_one(client, "T_px", [4.0, 5.0], [301.0, 301.0])
    before = [("T_px", "yellow", False)]
    assert told(client) == before
    if is_taken_up:
        client.post(path, json={"for_s": 0})
    until(lambda: told(client) == [*before, ("T_px", "yellow", True)])
    send_one(client, "T_px", [6.0, 7.0, 8.0], [301.0, 290.0, 290.0])
    alarms(client, 0, stop=None)
    assert told(client) == [*before, ("T_px", "yellow", True), ("T_px", "yellow", False)]


@pytest.mark.parametrize(
    ("limits", "why"), [({"red": [None, 500.0]}, "removed"), (None, "removed"), ({"yellow": [None, 302.0]}, "changed")]
)
def test_a_limit_that_is_removed_ends_its_alarm(client: AppClient, limits: dict | None, why: str) -> None:
    send(client, [0, 1], [303.0, 303.0])
    alarms(client, 1, stop=None)
    revised = copy.deepcopy(SPEC)
    if limits is not None:
        revised["channels"]["T_px"]["limits"] = limits
    assert client.request("PUT", TWIN, json=revised).status_code == 200
    (ended,) = alarms(client, 1, stop="1970-01-01T00:00:01Z")
    assert ended["message"] == f"T_px was above its yellow limit of 300 K: 303 at worst; the limit was {why}"
    assert told(client) == [("T_px", "yellow", True), ("T_px", "yellow", False)]
    send(client, [2, 3], [303.0, 303.0])
    alarms(client, int(why == "changed"), stop=None)


def calibrate(client: AppClient) -> None:
    path = client.post(f"{TWIN}/calibrations", json={"activate": True}).headers["location"]
    while client.get(path).json()["state"] in ("queued", "running"):
        time.sleep(0.02)


def test_a_forecast_says_when_a_limit_is_reached(client: AppClient) -> None:
    """At 290 K and 0.01 K/s, 300 K are reached after 1000 s; 4 K of spread are 400 s on both sides."""
    send(client, [float(k) for k in range(100)], [290.0] * 100)
    calibrate(client)
    found = client.get(f"{TWIN}/forecast", params={"horizon_s": 3600, "step_s": 60}).json()
    yellow, red = found["limits"]
    assert (yellow["channel"], yellow["colour"], yellow["limit"]) == ("T_px", "yellow", 300.0)
    assert yellow["message"] == "T_px reaches its yellow limit of 300 K in 16 min 40 s (90 %: 10 min to 23 min 20 s)"
    times = [yellow[name] for name in ("earliest", "expected", "latest")]
    assert times == ["1970-01-01T00:11:39Z", "1970-01-01T00:18:19Z", "1970-01-01T00:24:59Z"]
    assert red["message"].startswith("T_px reaches its red limit of 310 K in 33 min 20 s")
    assert set(found["values"]["T_px"]) == {"mean", "q05", "q50", "q95"}
    near = client.get(f"{TWIN}/forecast", params={"horizon_s": 900, "step_s": 60}).json()["limits"]
    assert [row["message"] for row in near] == ["T_px may reach its yellow limit of 300 K in 10 min at the earliest"]
    assert near[0]["expected"] is None


def test_a_forecast_counts_from_the_present_and_not_from_its_first_step(client: AppClient) -> None:
    """At 306 K, 310 K are reached after 400 s of a first step of 600 s; 300 K are behind."""
    send(client, [float(k) for k in range(100)], [306.0] * 100)
    calibrate(client)
    alarms(client, 1, on="measured")
    found = client.get(f"{TWIN}/forecast", params={"horizon_s": 3600, "step_s": 600}).json()
    yellow, red = found["limits"]
    assert yellow["message"] == "T_px is above its yellow limit of 300 K already"
    assert [yellow[name] for name in ("earliest", "expected", "latest")] == [found["from"]] * 3
    assert red["message"] == "T_px reaches its red limit of 310 K in 6 min 40 s (90 %: 4 min to 13 min 20 s)"
    assert red["expected"] == "1970-01-01T00:08:19Z"


def test_a_forecast_does_not_contradict_an_alarm_that_lasts(client: AppClient) -> None:
    send(client, [float(k) for k in range(101)], [301.0] * 100 + [299.9])  # within the dead band of 0.3 K
    calibrate(client)
    alarms(client, 1, on="measured", stop=None)
    (yellow, *_) = client.get(f"{TWIN}/forecast", params={"horizon_s": 3600, "step_s": 600}).json()["limits"]
    assert yellow["message"] == "T_px is above its yellow limit of 300 K already"


def test_a_forecast_alarm_gives_way_to_the_measured_one(client: AppClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.live.limits.FORECAST_EVERY_S", 0.1)
    send(client, [float(k) for k in range(100)], [290.0] * 100)
    calibrate(client)
    send(client, [100.0], [290.0])
    red, yellow = alarms(client, 2, on="forecast", stop=None)
    assert (red["colour"], yellow["colour"]) == ("red", "yellow")
    assert "reaches its yellow limit of 300 K in 16 min 40 s" in yellow["message"]
    assert yellow["message"].endswith(", as of 1970-01-01T00:01:40Z")  # it is read at any time after
    assert yellow["expected"] == "1970-01-01T00:18:20Z"
    send(client, [101.0, 102.0], [301.0, 301.0])
    (measured,) = alarms(client, 1, on="measured")
    (ended,) = alarms(client, 1, on="forecast", stop="1970-01-01T00:01:42Z")
    assert (measured["colour"], ended["colour"]) == ("yellow", "yellow")
    assert ended["message"].startswith("T_px was forecast to reach its yellow limit of 300 K in 16 min 40 s")
    alarms(client, 1, on="forecast", colour="red", stop=None)


def take_away(client: AppClient, start: float, stop: float, **more: str) -> None:
    """Delete samples, and wait until that was looked at."""
    params = {"start": start, "stop": stop, **more}
    assert client.request("DELETE", f"{TWIN}/telemetry", params=params).status_code == 200
    until(lambda: "taken" not in read(client, store.watched)[1])


def test_a_deletion_takes_its_alarms_along(client: AppClient) -> None:
    send(client, [0, 1, 2, 3, 4, 5, 6], [290.0, 305.0, 305.0, 290.0, 290.0, 340.0, 340.0])
    alarms(client, 3)
    take_away(client, 1, 3)
    alarms(client, 2, stop=None)
    take_away(client, 5, 7)
    assert [row["start"] for row in alarms(client, 2)] == ["1970-01-01T00:00:05Z"] * 2
    (ended,) = alarms(client, 1, stop="1970-01-01T00:00:05Z", colour="yellow")
    assert ended["message"].endswith("340 at worst; its readings were taken away")
    assert len(told(client)) == 5  # three began, of which one was over at once, and two ended
    send(client, [5, 6], [301.0, 301.0])
    (left,) = alarms(client, 1, stop=None)
    assert left["start"] == "1970-01-01T00:00:05Z"


def test_a_deletion_repeats_nothing_and_leaves_one_alarm(client: AppClient, monkeypatch: pytest.MonkeyPatch) -> None:
    send_one(client, "T_px", [0.0, 1.0, 2.0, 3.0], [305.0, 305.0, 290.0, 290.0])
    send_one(client, "T_px", [float(k) for k in range(10, 20)], [303.0, 303.0, 308.0] + [304.0] * 7)
    monkeypatch.setattr("service.live.judging.MOST_PAST", 3)
    before = told(client)
    assert before == [("T_px", "yellow", False), ("T_px", "yellow", True)]
    take_away(client, 12, 13)  # the worst of the alarm that lasts
    take_away(client, 1, 2)
    take_away(client, 0, 1, channels="Q_px")
    past, now = sorted(alarms(client, 2), key=lambda row: row["start"])
    assert (past["start"], past["stop"]) == ("1970-01-01T00:00:00Z", "1970-01-01T00:00:02Z")
    assert (now["start"], now["stop"]) == ("1970-01-01T00:00:10Z", None)
    assert told(client) == before
    take_away(client, 10, 12)
    alarms(client, 1, stop=None)
    send_one(client, "T_px", [20.0, 21.0], [290.0, 290.0])
    alarms(client, 0, stop=None)
    assert told(client) == [*before, ("T_px", "yellow", False)]


def test_what_a_deletion_leaves_of_an_alarm(client: AppClient) -> None:
    send_one(client, "T_px", [0.0, 1.0, 2.0, 3.0, 4.0], [309.0, 309.0, 303.0, 303.0, 303.0])
    take_away(client, 0, 2)
    (alarm,) = alarms(client, 1, stop=None)
    assert (alarm["start"], alarm["worst"]) == ("1970-01-01T00:00:02Z", 303.0)
    take_away(client, 3, 5)
    alarms(client, 1, stop=None, worst=303.0)
    take_away(client, 2, 3)
    alarms(client, 0, stop=None)
    assert told(client) == [("T_px", "yellow", True), ("T_px", "yellow", False)]


WRONG = (
    ("9/acknowledge", {}, 404),
    ("9/shelve", {"for_s": 1}, 404),
    ("1/shelve", {}, 422),
    ("1/shelve", {"for_s": -1}, 422),
)


@pytest.mark.parametrize(("path", "body", "status"), WRONG)
def test_wrong_requests(client: AppClient, path: str, body: dict, status: int) -> None:
    send(client, [0, 1], [301.0, 301.0])
    alarms(client, 1)
    assert client.post(f"{TWIN}/alarms/{path}", json=body).status_code == status


@pytest.mark.e2e
def test_the_python_client_speaks_of_alarms_and_deletions(tmp_path: Path) -> None:
    with Server(tmp_path, command=FAKE) as server:
        client = server.client()
        client.register(LIMITED)
        client.ingest("benchsat", [0, 1, 2], {"T_px": [290.0, 301.0, 302.0]})
        while not (found := client.alarms("benchsat")):
            time.sleep(0.05)
        assert (found[0].channel, found[0].limit) == ("T_px", 300.0)
        made = client.delete_telemetry("benchsat", start=1, channels=["T_px"])
        assert made.samples == 2 and client.archive("benchsat").values["T_px"] == [290.0, None, None]
        client.undo_deletion("benchsat", made.id)
        assert client.archive("benchsat").values["T_px"] == [290.0, 301.0, 302.0]
