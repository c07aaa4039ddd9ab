"""Two services on one database: what one does, the other knows."""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from service.fleet.ownership import Leases
from service.jobs import outcome
from service.running.member import Member
from service.store import twins
from service.store.ownership import SLOTS, Changed, Holding, slot_of
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


WIDER = {**SPEC, "channels": {**SPEC["channels"], "extra": {"kind": "auxiliary", "unit": "deg"}}}


@pytest.fixture
def deaf(pair: tuple[AppClient, AppClient], monkeypatch: pytest.MonkeyPatch) -> tuple[AppClient, AppClient]:
    """Two members; the second one hears nothing of what the first one changes, neither by a hint nor by a look."""
    applied, second = Member._apply, pair[1].app.state.service

    async def apply(self: Member, one: Changed) -> None:
        if self._service is not second:
            await applied(self, one)

    monkeypatch.setattr(Member, "_apply", apply)
    return pair


def test_a_channel_that_came_elsewhere_is_taken_at_once(deaf: tuple[AppClient, AppClient]) -> None:
    one, other = deaf
    one.post("/v1/twins", json=SPEC)
    assert other.get(TWIN).status_code == 200
    assert one.request("PUT", TWIN, json=WIDER).status_code == 200
    answer = other.post(f"{TWIN}/telemetry", json={"time": [5], "values": {"extra": [1.0]}})
    assert answer.status_code == 200, answer.text
    refused = other.post(f"{TWIN}/telemetry", json={"time": [5], "values": {"another": [1.0]}})
    assert refused.status_code == 422 and "unknown channel 'another'" in refused.json()["detail"]


def test_a_channel_that_came_elsewhere_can_be_asked_for_at_once(deaf: tuple[AppClient, AppClient]) -> None:
    one, other = deaf
    one.post("/v1/twins", json=SPEC)
    assert other.get(TWIN).status_code == 200
    assert one.request("PUT", TWIN, json=WIDER).status_code == 200
    one.post(f"{TWIN}/telemetry", json={"time": [5], "values": {"extra": [1.0]}})
    answer = other.get(f"{TWIN}/telemetry?channels=extra")
    assert answer.status_code == 200 and answer.json()["values"] == {"extra": [1.0]}


@pytest.mark.parametrize("first", ["GET", "PUT", "POST"])
def test_a_twin_registered_anew_elsewhere_is_there_at_once(deaf: tuple[AppClient, AppClient], first: str) -> None:
    one, other = deaf
    one.post("/v1/twins", json=SPEC)
    assert other.get(TWIN).status_code == 200
    assert one.delete(TWIN).status_code == 204
    assert one.post("/v1/twins", json=WIDER).status_code == 201
    if first == "GET":
        assert other.get(TWIN).json()["channels"] == list(WIDER["channels"])
    elif first == "PUT":
        assert other.request("PUT", TWIN, json=WIDER).status_code == 200
    assert feed(other, 0)["accepted"] == 60
    assert other.get(TWIN).json()["samples"] == 60
    assert one.delete(TWIN).status_code == 204
    assert other.get(TWIN).status_code == 404


def test_a_twin_registered_anew_elsewhere_is_followed_by_its_owner(pair: tuple[AppClient, AppClient]) -> None:
    one, other = pair
    for _ in range(6):  # numbers that belong to either of them
        one.post("/v1/twins", json=SPEC)
        until(lambda: other.get(TWIN).status_code == 200)
        assert one.delete(TWIN).status_code == 204
        assert one.post("/v1/twins", json=SPEC).status_code == 201
        key = one.app.state.service.registry.get("benchsat").key
        until(lambda key=key: any(c.app.state.service.live.find(key) is not None for c in pair))  # type: ignore[misc]
        assert other.delete(TWIN).status_code == 204


def activate(client: AppClient) -> None:
    model = {"spec": SPEC, "rmse_K": 1.0, "max_step_s": 60.0}
    assert client.post(f"{TWIN}/models", json=model).status_code == 201
    assert client.post(f"{TWIN}/models/1/activate").status_code == 200


@pytest.fixture
def may_hear(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Members hear of what others change only while it is set."""
    applied, event = Member._apply, threading.Event()

    async def apply(self: Member, one: Changed) -> None:
        if event.is_set():
            await applied(self, one)

    monkeypatch.setattr(Member, "_apply", apply)
    return event


def test_an_owner_that_knew_of_a_twin_before_it_heard_of_it_hears_of_its_model(
    pair: tuple[AppClient, AppClient], may_hear: threading.Event
) -> None:
    """A request has let it begin to follow the twin; the first word that it hears of it tells of a model that came since."""
    pair[0].post("/v1/twins", json=SPEC)
    feed(pair[0], 0)
    assert [c.get(TWIN).status_code for c in pair] == [200, 200]
    lives = [c.app.state.service.live for c in pair]
    tracker = until(lambda: lives[0].find(1) or lives[1].find(1))
    until(lambda: not tracker._wake.is_set() and not tracker._new_model)  # it has seen that there is no model
    other = next(c for c, live in zip(pair, lives, strict=True) if live.find(1) is None)
    activate(other)
    may_hear.set()
    until(lambda: other.get(TWIN).json()["assimilation"]["done"] == 60, 90.0)


def test_an_owner_that_tells_something_itself_still_hears_of_samples(
    pair: tuple[AppClient, AppClient], may_hear: threading.Event
) -> None:
    """Its own message has the last number when it hears of samples that another process stored just before."""
    may_hear.set()
    pair[0].post("/v1/twins", json=SPEC)
    feed(pair[0], 0)
    activate(pair[0])
    until(lambda: any(follows(client) for client in pair))
    owner = next(client for client in pair if follows(client))
    other = pair[1] if owner is pair[0] else pair[0]
    until(lambda: owner.get(TWIN).json()["assimilation"]["done"] == 60, 90.0)
    may_hear.clear()
    feed(other, 60, 10)
    hub = owner.app.state.service.hub
    owner.portal.call(hub.write, 1, outcome.tell, 1, [("stale", {"state": "live", "channels": [], "text": "heard"})])
    may_hear.set()
    tracker = owner.app.state.service.live.find(1)
    # nobody asks, which would let it look
    assert until(lambda: tracker.position is not None and tracker.position.n_samples == 70)


def follows(client: AppClient) -> bool:
    """Whether a process follows the first twin."""
    return client.app.state.service.live.find(1) is not None


def test_every_process_says_how_far_the_owner_is(pair: tuple[AppClient, AppClient]) -> None:
    one, other = pair
    one.post("/v1/twins", json=SPEC)
    assert one.get(TWIN).json()["assimilation"] is None and other.get(TWIN).json()["assimilation"] is None
    feed(one, 0)
    activate(one)

    def told() -> list[Any]:
        return [(d["assimilation"], d["catching_up"]) for d in (c.get(TWIN).json() for c in pair)]

    done = {"done": 60, "of": 60, "state_time": "1970-01-01T00:00:59Z", "behind_s": 0.0, "since": None}
    until(lambda: told() == [(done, False)] * 2, 90.0)  # a worker process starts first
    one.post(f"{TWIN}/telemetry", json={"time": [100_000], "values": {"T_px": [290.0]}})  # a lone one waits for company
    done |= {"done": 61, "of": 61}
    until(lambda: told() == [(done, False)] * 2)


def test_a_process_that_follows_nothing_says_what_is_left(postgres: str, make_client: Callable[..., AppClient]) -> None:
    beside = make_client(workbench=FakeWorkbench, database_url=postgres, assimilate=False)
    beside.post("/v1/twins", json=SPEC)
    feed(beside, 0, 6000)
    activate(beside)
    detail = beside.get(TWIN).json()
    left = {"done": 0, "of": 6000, "state_time": None, "behind_s": 0.0, "since": None}
    assert (detail["assimilation"], detail["catching_up"]) == (left, True)
    make_client(workbench=FakeWorkbench, database_url=postgres)
    assert until(lambda: beside.get(TWIN).json()["assimilation"]["done"] == 6000)
    assert not beside.get(TWIN).json()["catching_up"]


def test_a_tracker_of_a_former_tenure_gives_way(postgres: str, make_client: Callable[..., AppClient]) -> None:
    """A twin is added just before word of a new tenure comes: what was begun in the former one can write nothing."""
    client = make_client(workbench=FakeWorkbench, database_url=postgres)
    service = client.app.state.service
    leases: Leases = service.ownership
    until(lambda: len(leases.epochs) == SLOTS)

    async def add_between() -> None:
        made, _ = await service.database.write(twins.register, "benchsat", SPEC)
        present = leases._holding
        leases._holding = Holding({slot: epoch - 1 for slot, epoch in present.epochs.items()}, 1)
        service.add_twin(made)
        leases._holding = present

    client.portal.call(add_between)
    feed(client, 0)
    activate(client)
    assert until(lambda: client.get(f"{TWIN}/residuals").json()["samples"] == 60)
