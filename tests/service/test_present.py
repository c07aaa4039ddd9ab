"""A forecast is from the present, or says that it is not: however long the archive is, and while it is assimilated anew."""

import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.live.scout import Scout
from service.live.tracker import Tracker
from service.store.models import Active
from service.workbench.interface import Filtered, Json, Telemetry
from tests.service.conftest import SPEC
from tests.service.fakes import FakeWorkbench
from tests.service.harness import AppClient, notices

TWIN = "/v1/twins/benchsat"
LONG = 40_000
"""Samples, many blocks of them."""
TOLD = [
    "held the last readings",
    "no telemetry of Q_px for 11 h 5 min: what is assumed of it rests on what came before",
]
"""What a forecast from the end of them says: the power came with the first hundred only."""


class Gated(FakeWorkbench):
    """Assimilates a block of what lies before 30 000 s for each ticket that it finds; a gate lets all pass."""

    def filtered(self, document: str, telemetry: Telemetry, state: Json | None) -> Filtered:
        folder = Path(os.environ["FAKE_GATE"])
        while telemetry.time_us[-1] < 30_000e6 and not (folder / "open").exists():
            if (folder / "ticket").exists():
                (folder / "ticket").unlink()
                break
            time.sleep(0.02)
        return super().filtered(document, telemetry, state)


@pytest.fixture
def gate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The file that opens the gate, as it is in the end."""
    monkeypatch.setenv("FAKE_GATE", str(tmp_path))
    yield tmp_path / "open"
    (tmp_path / "open").touch()


def let_one_pass(gate: Path) -> None:
    ticket = gate.with_name("ticket")
    ticket.touch()
    while ticket.exists():
        time.sleep(0.02)


def send(client: AppClient, first: int, count: int) -> None:
    times = [float(k) for k in range(first, first + count)]
    values = {"T_px": [290.0 + 1e-4 * k for k in times], "T_tank": [15.0] * count, "Q_px": [0.5] * count}
    if first:
        values["Q_px"] = [None] * count  # what was commanded long ago holds still
    answer = client.post(f"{TWIN}/telemetry", json={"time": times, "values": values})
    assert answer.json()["accepted"] == count


def calibrate(client: AppClient) -> None:
    path = client.post(f"{TWIN}/calibrations", json={"activate": True, "stop": 100}).headers["location"]
    while (job := client.get(path).json())["state"] in ("queued", "running"):
        time.sleep(0.02)
    assert job["state"] == "succeeded", job


def forecast(client: AppClient) -> dict:
    answer = client.get(f"{TWIN}/forecast", params={"horizon_s": 60, "step_s": 60})
    assert answer.status_code == 200, answer.text
    return answer.json()


def iso(seconds: int) -> str:
    return f"1970-01-01T{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}Z"


def caught_up(client: AppClient) -> None:
    while client.get(TWIN).json()["catching_up"]:
        time.sleep(0.05)


def test_after_an_activation_a_forecast_is_from_the_present_at_once(
    make_client, gate: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Word of the model comes a second time meanwhile, as it does where several processes share a database."""
    send_scout = Tracker._send_scout

    async def told_again(tracker: Tracker, active: Active) -> Scout:
        tracker.model_changed()
        return await send_scout(tracker, active)

    monkeypatch.setattr(Tracker, "_send_scout", told_again)
    client = make_client(workbench=Gated)
    client.post("/v1/twins", json=SPEC)
    send(client, 0, 100)
    send(client, 100, LONG - 100)
    calibrate(client)
    found = forecast(client)  # the archive behind is locked: nothing before 30 000 s can be assimilated
    assert (found["from"], found["behind_s"]) == (iso(LONG - 1), 0.0)
    assert found["values"]["T_px"]["mean"] == [290.0 + 1e-4 * (LONG - 1)]
    assert notices(found) == TOLD
    detail = client.get(TWIN).json()
    assert detail["catching_up"] is True
    assert detail["assimilation"] == {
        "done": 0,
        "of": LONG,
        "state_time": iso(LONG - 1),
        "behind_s": 0.0,
        "since": None,
    }

    send(client, LONG, 1)  # and what comes now is followed between two blocks
    let_one_pass(gate)
    assert forecast(client)["from"] == iso(LONG)
    newest = client.get(f"{TWIN}/residuals", params={"start": LONG - 10}).json()
    assert newest["time"][-1] == iso(LONG)
    assert newest["residual_K"]["T_px"][-1] == pytest.approx(1e-4, abs=1e-9)

    gate.touch()
    caught_up(client)
    assert client.get(TWIN).json()["assimilation"]["done"] == LONG + 1
    whole = client.get(f"{TWIN}/residuals", params={"max_points": 100_000}).json()
    assert whole["samples"] == len(set(whole["time"])) == LONG + 1  # every instant once, whoever said it first
    assert whole["residual_K"]["T_px"][1:] == pytest.approx([1e-4] * LONG, abs=1e-9)


def test_what_came_late_by_much_leaves_the_present_known(make_client, gate: Path) -> None:
    client = make_client(workbench=Gated)
    client.post("/v1/twins", json=SPEC)
    gate.touch()
    send(client, 0, 100)
    send(client, 100, LONG - 100)
    calibrate(client)
    caught_up(client)
    gate.unlink()
    times = [20.5, 21.5]
    client.post(f"{TWIN}/telemetry", json={"time": times, "values": {"T_px": [290.0, 290.0]}})
    found = forecast(client)
    told = [notice for notice in notices(found) if "frozen" not in notice]  # T_tank is
    assert (found["from"], found["behind_s"], told) == (iso(LONG - 1), 0.0, TOLD)
    gate.touch()
    caught_up(client)
    assert client.get(f"{TWIN}/residuals").json()["samples"] == LONG + 2


def test_a_forecast_from_the_past_says_so(make_client, gate: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    client = make_client(workbench=Gated)
    client.post("/v1/twins", json=SPEC)
    gate.touch()
    send(client, 0, 100)
    calibrate(client)
    forecast(client)
    gate.unlink()
    send(client, 100, 7200)
    monkeypatch.setattr("service.live.forecasts.SETTLE_S", 0.3)
    found = forecast(client)
    assert (found["from"], found["behind_s"]) == (iso(99), 7200.0)
    (notice,) = [text for text in found["notices"] if "not from the present" in text]
    assert "2 h before the last sample" in notice and "100 of 7300 samples" in notice


def test_before_there_is_a_state_the_answer_asks_for_another_try(
    make_client, gate: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = make_client(workbench=Gated)
    client.post("/v1/twins", json=SPEC)
    monkeypatch.setattr("service.live.forecasts.SETTLE_S", 0.1)
    monkeypatch.setattr("service.live.forecasts.FIRST_S", 0.1)
    refused = client.get(f"{TWIN}/forecast?horizon_s=60")
    assert (refused.status_code, "Retry-After" in refused.headers) == (409, False)
    send(client, 0, 100)
    calibrate(client)
    early = client.get(f"{TWIN}/forecast?horizon_s=60")
    assert (early.status_code, "Retry-After" in early.headers) == (409, True)
    assert "still being assimilated" in early.json()["detail"]
    gate.touch()
    monkeypatch.setattr("service.live.forecasts.SETTLE_S", 60.0)
    assert forecast(client)["from"] == iso(99)


def test_a_service_that_starts_behind_a_long_archive_knows_the_present_at_once(make_client, gate: Path) -> None:
    deaf = make_client(workbench=Gated, assimilate=False)
    deaf.post("/v1/twins", json=SPEC)
    send(deaf, 0, 100)
    send(deaf, 100, LONG - 100)
    calibrate(deaf)
    deaf.close()
    client = make_client(workbench=Gated)
    assert forecast(client)["from"] == iso(LONG - 1)
    assert client.get(TWIN).json()["assimilation"]["done"] == 0
    gate.touch()
    caught_up(client)
    assert client.get(f"{TWIN}/residuals").json()["samples"] == LONG


class Powered(FakeWorkbench):
    """Gives the power that holds for the NIS."""

    def filtered(self, document: str, telemetry: Telemetry, state: Json | None) -> Filtered:
        power = telemetry.values["Q_px"]
        last = np.maximum.accumulate(np.where(np.isfinite(power), np.arange(power.size), 0))
        return replace(super().filtered(document, telemetry, state), nis=power[last])


def test_inputs_hold_that_were_commanded_long_before_the_scout_begins(make_client, gate: Path) -> None:
    client = make_client(workbench=Powered)
    client.post("/v1/twins", json=SPEC)
    send(client, 0, 100)
    send(client, 100, LONG - 100)
    calibrate(client)
    forecast(client)
    found = client.get(f"{TWIN}/residuals", params={"start": LONG - 100}).json()
    assert found["nis"] == [0.5] * 100
