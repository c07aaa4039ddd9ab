"""Registering, listing, inspecting and deleting twins."""

import asyncio

import pytest

from service.store.errors import TwinGone
from service.twins.registry import Entry
from tests.service.conftest import SPEC, STORE
from tests.service.harness import AppClient


def test_life_of_a_twin(client: AppClient, spec: dict) -> None:
    assert client.get("/v1/twins").json() == {"twins": []}
    first = client.post("/v1/twins", json=spec)
    assert first.status_code == 201
    assert first.headers["location"] == "/v1/twins/benchsat"
    reordered = dict(reversed(spec.items()))
    assert client.post("/v1/twins", json=reordered).status_code == 200
    assert client.post("/v1/twins", json={**spec, "loads": []}).status_code == 409
    assert [twin["id"] for twin in client.get("/v1/twins").json()["twins"]] == ["benchsat"]
    detail = client.get("/v1/twins/benchsat").json()
    assert detail["specification"]["nodes"][0]["id"] == "px"
    assert (detail["samples"], detail["last_time"], detail["active_model"]) == (0, None, None)
    assert client.delete("/v1/twins/benchsat").status_code == 204
    assert client.delete("/v1/twins/benchsat").status_code == 404
    assert client.get("/v1/twins/benchsat").status_code == 404
    assert client.post("/v1/twins", json={**spec, "loads": []}).status_code == 201


def test_everything_that_is_wrong_with_a_specification_is_told_at_once(client: AppClient, spec: dict) -> None:
    spec["loads"] = [{"channel": "Q_none", "node": "px"}, {"channel": "Q_none", "node": "nowhere"}]
    answer = client.post("/v1/twins", json=spec)
    assert answer.status_code == 422
    told = answer.json()
    assert [e["field"] for e in told["errors"]] == ["loads[0].channel", "loads[1].node", "loads[1].channel"]
    assert told["detail"].startswith("loads[0].channel: unknown channel 'Q_none'")
    assert client.get("/v1/twins").json() == {"twins": []}


def test_deleting_takes_the_archive_along(registered: AppClient, spec: dict) -> None:
    registered.post("/v1/twins/benchsat/telemetry", json={"time": [1.0], "values": {"T_px": [290.0]}})
    registered.delete("/v1/twins/benchsat")
    registered.post("/v1/twins", json=spec)
    assert registered.get("/v1/twins/benchsat/telemetry").json()["samples"] == 0


def test_twins_survive_a_restart(make_client, spec: dict) -> None:
    first = make_client()
    first.post("/v1/twins", json=spec)
    first.post("/v1/twins/benchsat/telemetry", json={"time": [1.0], "values": {"T_px": [290.0]}})
    first.close()
    second = make_client()
    assert second.get("/v1/twins/benchsat").json()["samples"] == 1
    assert second.post("/v1/twins", json=spec).status_code == 200


def test_registering_while_the_same_twin_is_deleted_leaves_no_half_of_it(
    client: AppClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    route = "/v1/twins/benchsat"
    jobs = client.app.state.service.jobs
    cancel = jobs.cancel_twin
    has_begun = asyncio.Event()

    async def slowly(twin: Entry) -> None:
        has_begun.set()
        await asyncio.sleep(0.1)
        await cancel(twin)

    monkeypatch.setattr(jobs, "cancel_twin", slowly)

    async def rush() -> list[int]:
        deletions = [asyncio.create_task(client.http.delete(route)) for _ in range(2)]
        await has_begun.wait()
        answers = await asyncio.gather(*deletions, client.http.post("/v1/twins", json=SPEC))
        return [answer.status_code for answer in answers]

    client.post("/v1/twins", json=SPEC)
    assert client.portal.call(rush) == [204, 404, 201]
    assert client.post(f"{route}/telemetry", json={"time": [1], "values": {"T_px": [290]}}).status_code == 200
    assert client.get(f"{route}/residuals").status_code == 200
    assert client.delete(route).status_code == 204


def test_jobs_of_a_twin_that_was_deleted_meanwhile_are_refused(client: AppClient) -> None:
    client.post("/v1/twins", json=SPEC)
    service = client.app.state.service
    entry = service.registry.get("benchsat")
    client.delete("/v1/twins/benchsat")
    with pytest.raises(TwinGone):
        client.portal.call(service.jobs.start, entry, "calibration", {})


@pytest.mark.skipif(STORE == "postgres", reason="another process may follow the samples: what it wrote down is told")
def test_without_assimilation_there_is_an_archive_but_no_state(make_client) -> None:
    client: AppClient = make_client(assimilate=False)
    client.post("/v1/twins", json=SPEC)
    route = "/v1/twins/benchsat"
    assert client.post(f"{route}/telemetry", json={"time": [1], "values": {"T_px": [290]}}).json()["accepted"] == 1
    for path in ("forecast?horizon_s=60", "residuals", "network"):
        answer = client.get(f"{route}/{path}")
        assert (answer.status_code, "TWIN_ASSIMILATE" in answer.json()["detail"]) == (409, True)
    assert client.get(f"{route}/anomalies").json() == {"anomalies": []}
