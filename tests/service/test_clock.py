"""A wrong clock moves nothing, recordings of any time can be replayed, and what is in the archive by mistake can be taken out."""

import time
from pathlib import Path

import numpy as np
import pytest

from tests.service.conftest import SPEC, Sql
from tests.service.fakes import FakeWorkbench
from tests.service.harness import AppClient

TWIN = "/v1/twins/benchsat"
DAY = 86_400.0


@pytest.fixture
def client(make_client) -> AppClient:
    client = make_client(workbench=FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    return client


def send(client: AppClient, times: list[float], T_px: float | list[float] = 290.0, **more: list) -> dict:
    readings = T_px if isinstance(T_px, list) else [T_px] * len(times)
    values = {"T_px": readings, "T_tank": [15.0] * len(times), "Q_px": [0.5] * len(times), **more}
    answer = client.post(f"{TWIN}/telemetry", json={"time": times, "values": values})
    assert answer.status_code == 200, answer.text
    return answer.json()


def whole_seconds() -> float:
    return float(int(time.time()))


def live(client: AppClient, count: int = 30) -> float:
    """Send the last half a minute, one frame per second, and return the instant of the last one."""
    now = whole_seconds()
    send(client, [now - count + k for k in range(1, count + 1)])
    return now


def detail(client: AppClient) -> dict:
    return client.get(TWIN).json()


def calibrate(client: AppClient) -> None:
    path = client.post(f"{TWIN}/calibrations", json={"activate": True}).headers["location"]
    while (job := client.get(path).json())["state"] in ("queued", "running"):
        time.sleep(0.02)
    assert job["state"] == "succeeded", job


def iso(seconds: float) -> str:
    return f"{np.datetime64(round(seconds), 's')}Z"


@pytest.mark.parametrize("ahead_s", [5 * DAY, 200 * DAY, 3600.0])
def test_frames_of_a_fast_clock_are_kept_apart_and_told(client: AppClient, ahead_s: float) -> None:
    now = live(client)
    calibrate(client)
    wrong = [now + ahead_s + k for k in range(3)]
    for instant in wrong:
        report = send(client, [instant], 250.0)
        assert (report["accepted"], report["rejected"]) == (0, [])
        assert report["quarantined"] == [{"index": 0, "reason": "ahead of the receive clock"}]
        assert report["last_time"] == iso(now)
    assert send(client, [now + 1])["accepted"] == 1
    found = detail(client)
    assert (found["last_time"], found["samples"], found["quarantined"]) == (iso(now + 1), 31, 3)
    ahead = client.get(f"{TWIN}/forecast", params={"horizon_s": 60}).json()
    assert ahead["from"] == iso(now + 1) and ahead["values"]["T_px"]["mean"][0] == 290.0
    assert any("3 samples ahead" in notice and "quarantine" in notice for notice in ahead["notices"])
    metrics = client.get("/metrics").text
    assert 'twin_ingest_samples_total{outcome="quarantined",twin="benchsat"} 3.0' in metrics
    (line,) = (row for row in metrics.splitlines() if row.startswith("twin_last_sample_timestamp_seconds{"))
    assert float(line.split()[1]) == now + 1


def test_a_sample_in_quarantine_survives_a_restart_and_is_kept_once(make_client) -> None:
    first = make_client(workbench=FakeWorkbench)
    first.post("/v1/twins", json=SPEC)
    now = live(first)
    for _ in range(3):
        assert len(send(first, [now + DAY, now + 1], [280.0, 290.0])["quarantined"]) == 1
    first.close()
    again = make_client(workbench=FakeWorkbench)
    kept = again.get(f"{TWIN}/quarantine").json()
    assert (kept["samples"], kept["time"], kept["values"]["T_px"]) == (1, [iso(now + DAY)], [280.0])
    assert kept["received"][0] >= iso(now)[:-1]


def test_a_clock_within_the_tolerance_is_believed(client: AppClient) -> None:
    now = live(client)
    assert send(client, [now + 200])["accepted"] == 1
    assert len(send(client, [now + 700])["quarantined"]) == 1


def test_the_tolerance_can_be_set_and_switched_off(make_client) -> None:
    strict = make_client(workbench=FakeWorkbench, clock_tolerance_s=5)
    strict.post("/v1/twins", json=SPEC)
    now = live(strict)
    assert len(send(strict, [now + 200])["quarantined"]) == 1
    strict.close()
    lax = make_client(workbench=FakeWorkbench, clock_tolerance_s=0)
    assert send(lax, [now + 200 * DAY])["accepted"] == 1


@pytest.mark.parametrize("begin", [0.0, 1.0e9])
def test_an_old_recording_is_taken_at_any_speed(client: AppClient, begin: float) -> None:
    for first in range(0, 3000, 500):
        assert send(client, [begin + 60.0 * k for k in range(first, first + 500)])["accepted"] == 500
    now = whole_seconds()
    assert len(send(client, [now + 5 * DAY])["quarantined"]) == 1  # long behind its end: nothing that follows from it


@pytest.mark.parametrize("batch", [1, 7, 200])
def test_a_recording_of_next_year_is_taken_as_a_whole(client: AppClient, batch: int) -> None:
    begin = whole_seconds() + 365 * DAY
    for first in range(0, 200, batch):
        times = [begin + 600.0 * k + (3 * DAY if k > 100 else 0.0) for k in range(first, min(first + batch, 200))]
        assert send(client, times)["accepted"] == len(times)
    found = detail(client)
    assert (found["samples"], found["quarantined"], found["last_time"]) == (200, 0, iso(begin + 199 * 600 + 3 * DAY))


@pytest.mark.parametrize("batch", [1, 50, 400])
def test_a_recording_may_run_on_past_the_present(client: AppClient, batch: int) -> None:
    begin = whole_seconds() - 200 * 600.0 - 50.0
    for first in range(0, 400, batch):
        times = [begin + 600.0 * k for k in range(first, first + batch)]
        assert send(client, times)["accepted"] == batch
    assert len(send(client, [begin + 400 * 600.0 + 5 * DAY])["quarantined"]) == 1
    assert detail(client)["samples"] == 400


def test_live_frames_show_that_what_came_first_was_wrong(client: AppClient) -> None:
    now = whole_seconds()
    send(client, [now + 200 * DAY + k for k in range(3)], 250.0)
    assert detail(client)["quarantined"] == 0  # it might be a simulation of next year
    report = send(client, [now])
    assert (report["accepted"], report["last_time"]) == (1, iso(now))
    found = detail(client)
    assert (found["samples"], found["quarantined"], found["first_time"], found["last_time"]) == (
        1,
        3,
        iso(now),
        iso(now),
    )
    assert client.get(f"{TWIN}/telemetry").json()["values"]["T_px"] == [290.0]
    assert client.get(f"{TWIN}/quarantine").json()["values"]["T_px"] == [250.0] * 3


def test_a_simulation_of_next_year_bears_a_sample_of_1970(client: AppClient) -> None:
    begin = whole_seconds() + 365 * DAY
    send(client, [begin + k for k in range(100)])
    assert send(client, [5.0])["accepted"] == 1
    assert detail(client)["last_time"] == iso(begin + 99)


def test_an_operator_may_let_samples_out_of_quarantine(client: AppClient) -> None:
    now = live(client)
    calibrate(client)
    ahead = [now + DAY + k for k in range(4)]
    send(client, ahead, [280.0, 281.0, 282.0, 283.0])
    released = client.post(f"{TWIN}/quarantine/release", json={"start": ahead[1], "stop": ahead[3]})
    assert released.json()["accepted"] == 2 and released.json()["last_time"] == iso(ahead[2])
    assert (detail(client)["quarantined"], detail(client)["samples"]) == (2, 32)
    assert client.get(f"{TWIN}/residuals", params={"start": now + 1}).json()["time"] == [iso(t) for t in ahead[1:3]]
    for unclear in ({}, {"all": False}, {"all": True, "start": 5}):
        refused = client.request("DELETE", f"{TWIN}/quarantine", params=unclear)
        assert refused.status_code == 422 and "all=true" in refused.json()["detail"]
    assert detail(client)["quarantined"] == 2
    gone = client.request("DELETE", f"{TWIN}/quarantine", params={"all": True}).json()
    assert (gone["samples"], gone["place"], detail(client)["quarantined"]) == (2, "quarantine", 0)
    client.post(f"{TWIN}/telemetry/deletions/{gone['id']}/undo")
    assert (detail(client)["quarantined"], detail(client)["samples"]) == (2, 32)


# ---- deletion


RAMP = [290.0 + 0.25 * k for k in range(200)]


def filled(client: AppClient) -> dict:
    """Send a ramp of 200 s, calibrate, and return its residuals."""
    send(client, [float(k) for k in range(200)], RAMP)
    calibrate(client)
    return residuals(client)


def residuals(client: AppClient) -> dict[str, float]:
    found = client.get(f"{TWIN}/residuals").json()
    return dict(zip(found["time"], found["residual_K"]["T_px"], strict=True))


def archive(client: AppClient) -> dict:
    found = client.get(f"{TWIN}/telemetry").json()
    return {"time": found["time"], **found["values"]}


def test_a_deletion_is_as_if_the_samples_had_never_come(make_client, tmp_path: Path) -> None:
    never = make_client(workbench=FakeWorkbench, database_url=f"sqlite:///{tmp_path / 'never.sqlite3'}")
    never.post("/v1/twins", json=SPEC)
    kept = [k for k in range(200) if not 50 <= k < 60]
    send(never, [float(k) for k in kept], [RAMP[k] for k in kept])
    calibrate(never)

    client = make_client(workbench=FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    before = filled(client)
    made = client.request("DELETE", f"{TWIN}/telemetry", params={"start": 50, "stop": 60}).json()
    assert (made["samples"], made["start"], made["channels"]) == (10, "1970-01-01T00:00:50Z", None)
    assert archive(client) == archive(never)
    assert residuals(client) == residuals(never) and len(before) == 200
    assert detail(client)["samples"] == 190

    undone = client.post(f"{TWIN}/telemetry/deletions/{made['id']}/undo").json()
    assert undone["undone"] is not None and undone["undo_until"] is None
    assert residuals(client) == before
    assert (archive(client)["T_px"], detail(client)["samples"]) == (RAMP, 200)
    assert client.post(f"{TWIN}/telemetry/deletions/{made['id']}/undo").status_code == 409
    assert client.post(f"{TWIN}/telemetry/deletions/99/undo").status_code == 404


def test_the_end_of_the_archive_can_go_and_with_it_the_present(client: AppClient) -> None:
    filled(client)
    send(
        client, [9e6, 9e6 + 1, 9e6 + 2], 250.0
    )  # three frames of a clock that was wrong, in the past of the receive clock
    residuals(client)
    assert client.get(f"{TWIN}/forecast", params={"horizon_s": 60}).json()["from"] == iso(9e6 + 2)
    client.request("DELETE", f"{TWIN}/telemetry", params={"start": 200})
    found = client.get(f"{TWIN}/forecast", params={"horizon_s": 60}).json()
    assert (found["from"], found["behind_s"], found["values"]["T_px"]["mean"][0]) == (iso(199), 0.0, RAMP[-1])
    assert detail(client)["last_time"] == iso(199) and len(residuals(client)) == 200


def test_the_values_of_one_channel_can_go(client: AppClient) -> None:
    filled(client)
    made = client.request("DELETE", f"{TWIN}/telemetry", params={"start": 50, "stop": 60, "channels": "T_px"}).json()
    assert (made["samples"], made["channels"]) == (10, ["T_px"])
    found = archive(client)
    assert found["T_px"] == [None if 50 <= k < 60 else RAMP[k] for k in range(200)]
    assert found["T_tank"] == [15.0] * 200 and detail(client)["samples"] == 200
    assert list(residuals(client).values())[49:62] == [0.25] + [None] * 11 + [0.25]
    # another value may take its place, and stays when the deletion is undone
    send(client, [50.0], 300.0, T_tank=[None], Q_px=[None])
    client.post(f"{TWIN}/telemetry/deletions/{made['id']}/undo")
    assert archive(client)["T_px"] == [*RAMP[:50], 300.0, *RAMP[51:]]


def test_a_deletion_is_on_record(client: AppClient, sql: Sql) -> None:
    filled(client)
    client.request("DELETE", f"{TWIN}/telemetry", params={"start": 50, "stop": 60})
    client.request("DELETE", f"{TWIN}/telemetry", params={"channels": "Q_px"})
    rows = client.get(f"{TWIN}/telemetry/deletions").json()["deletions"]
    assert [(row["place"], row["samples"], row["channels"]) for row in rows] == [
        ("archive", 190, ["Q_px"]),
        ("archive", 10, None),
    ]
    assert sql("SELECT count(*) FROM deletion") == [(2,)]


def test_after_a_day_a_deletion_is_for_ever(make_client, sql: Sql) -> None:
    first = make_client(workbench=FakeWorkbench)
    first.post("/v1/twins", json=SPEC)
    send(first, [float(k) for k in range(20)])
    made = first.request("DELETE", f"{TWIN}/telemetry", params={"stop": 10}).json()
    first.close()
    sql("UPDATE deletion SET at_us = at_us - 86401000000")
    later = make_client(workbench=FakeWorkbench)
    assert later.post(f"{TWIN}/telemetry/deletions/{made['id']}/undo").status_code == 409
    end_s = time.monotonic() + 60.0
    while sql("SELECT count(*) FROM aside") != [(0,)]:
        assert time.monotonic() < end_s, "what was deleted is still there"
        time.sleep(0.02)
    assert len(later.get(f"{TWIN}/telemetry/deletions").json()["deletions"]) == 1


WRONG = (
    ({}, "at least one of"),
    ({"start": "x"}, "start"),
    ({"start": 5, "stop": 4}, "stop"),
    ({"channels": "T_no"}, "T_no"),
    ({"begin": 5}, "begin"),
)


@pytest.mark.parametrize(("parameters", "word"), WRONG)
def test_wrong_deletions_delete_nothing(client: AppClient, parameters: dict, word: str) -> None:
    send(client, [1.0, 2.0])
    answer = client.request("DELETE", f"{TWIN}/telemetry", params=parameters)
    assert answer.status_code == 422 and word in answer.json()["detail"]
    assert detail(client)["samples"] == 2


def test_only_operators_delete(make_client) -> None:
    client = make_client(workbench=FakeWorkbench, api_keys="operate:o,ingest:i")
    for key, status in (("o", 201), ("i", 403)):
        headers = {"Authorization": f"Bearer {key}"}
        if key == "o":
            assert client.post("/v1/twins", json=SPEC, headers=headers).status_code == status
            continue
        for method, path in (
            ("DELETE", "telemetry?start=1"),
            ("POST", "telemetry/deletions/1/undo"),
            ("POST", "quarantine/release"),
            ("DELETE", "quarantine"),
        ):
            assert client.request(method, f"{TWIN}/{path}", headers=headers).status_code == status
