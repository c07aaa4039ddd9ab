"""Two services on one database: what one does, the other knows."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from service.store.ownership import slot_of
from tests.service.conftest import SPEC
from tests.service.fakes import FakeWorkbench
from tests.service.harness import AppClient

pytestmark = pytest.mark.fleet
TWIN = "/v1/twins/benchsat"


@pytest.fixture
def pair(postgres: str, make_client: Callable[..., AppClient]) -> Iterator[tuple[AppClient, AppClient]]:
    """Two members, each of which owns half of the slots."""
    clients = [make_client(workbench=FakeWorkbench, database_url=postgres) for _ in range(2)]
    until(lambda: sorted(len(c.app.state.service.ownership.epochs) for c in clients) == [128, 128])
    yield clients[0], clients[1]


def until(holds: Callable[[], Any], wait_s: float = 30.0) -> Any:
    """Return what holds at last."""
    end_s = time.monotonic() + wait_s
    while not (found := holds()):
        assert time.monotonic() < end_s
        time.sleep(0.05)
    return found


def feed(client: AppClient, first: int, count: int = 60) -> dict[str, Any]:
    values = {
        "T_px": [290.0 + 0.01 * k for k in range(first, first + count)],
        "T_tank": [10.0] * count,
        "Q_px": [5.0] * count,
    }
    answer: dict[str, Any] = client.post(
        f"{TWIN}/telemetry", json={"time": list(range(first, first + count)), "values": values}
    ).json()
    return answer


def test_any_of_them_takes_anything(pair: tuple[AppClient, AppClient]) -> None:
    one, other = pair
    assert one.post("/v1/twins", json=SPEC).status_code == 201
    assert other.post("/v1/twins", json=SPEC).status_code == 200
    assert feed(other, 0)["accepted"] == 60
    again = feed(one, 30)
    assert (again["duplicates"], again["accepted"], again["rejected"]) == (30, 30, [])
    assert feed(other, 90)["last_time"] == one.get(TWIN).json()["last_time"]
    path = one.post(f"{TWIN}/calibrations", json={}).headers["location"]
    until(lambda: other.get(path).json()["state"] == "succeeded")
    last = one.get(TWIN).json()["last_time"]

    def forecasts() -> list[dict[str, Any]]:
        answers = [c.get(f"{TWIN}/forecast?horizon_s=60&step_s=30") for c in pair]
        return [a.json() for a in answers if a.status_code == 200 and a.json()["from"] == last]

    until(lambda: len(forecasts()) == 2)
    ours, theirs = forecasts()
    assert ours["values"] == theirs["values"] and ours["time"] == theirs["time"]
    followers = [c.app.state.service.live.find(1) is not None for c in pair]
    owners = [slot_of(1) in c.app.state.service.ownership.epochs for c in pair]
    assert sorted(followers) == [False, True] and followers == owners


def test_a_twin_deleted_elsewhere_can_be_registered_again_at_once(pair: tuple[AppClient, AppClient]) -> None:
    one, other = pair
    one.post("/v1/twins", json=SPEC)
    until(lambda: other.get(TWIN).status_code == 200)
    assert other.delete(TWIN).status_code == 204
    assert one.post("/v1/twins", json=SPEC).status_code == 201
    assert feed(one, 0)["accepted"] == 60


def test_what_one_changes_the_others_know(pair: tuple[AppClient, AppClient]) -> None:
    one, other = pair
    one.post("/v1/twins", json=SPEC)
    wider = {**SPEC, "channels": {**SPEC["channels"], "extra": {"kind": "auxiliary", "unit": "deg"}}}
    assert one.request("PUT", TWIN, json=wider).status_code == 200
    body = {"time": [5], "values": {"extra": [1.0]}}
    until(lambda: other.post(f"{TWIN}/telemetry", json=body).status_code == 200)
    hub = one.app.state.service.hub
    seq = other.get(TWIN).json()["seq"]
    until(lambda: hub.head(1) >= seq)  # readers of a stream here get what came in there
    assert one.delete(TWIN).status_code == 204
    until(lambda: other.get(TWIN).status_code == 404)
    assert other.post(f"{TWIN}/telemetry", json=body).status_code == 404
