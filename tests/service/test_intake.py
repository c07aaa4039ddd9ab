"""Requests that share a commit: each is judged as if they had come one after another."""

import asyncio

import httpx
import orjson
import pytest

from service.archive import intake
from service.http import telemetry_body
from service.store.database import Database
from tests.service.harness import AppClient

ROUTE = "/v1/twins/benchsat/telemetry"


def at_once(client: AppClient, bodies: list[dict]) -> list[dict]:
    """Send bodies at the same moment and return the answers in their order."""

    async def send() -> list[httpx.Response]:
        return await asyncio.gather(*(client.http.post(ROUTE, json=body) for body in bodies))

    answers = client.portal.call(send)
    assert {answer.status_code for answer in answers} == {200}
    return [answer.json() for answer in answers]


def test_who_comes_first_wins_whatever_shares_the_commit(registered: AppClient) -> None:
    bodies = [{"time": [k % 10, 100 + k], "values": {"T_px": [290 + k // 20, 290]}} for k in range(40)]
    reports = at_once(registered, bodies)
    assert [report["accepted"] for report in reports] == [2] * 10 + [1] * 30
    assert [report["duplicates"] for report in reports] == [0] * 10 + [1] * 10 + [0] * 20
    assert [report["rejected"] for report in reports[20:]] == [[{"index": 0, "reason": "conflict"}]] * 20
    archive = registered.get(ROUTE).json()
    assert archive["values"]["T_px"] == [290] * 50
    assert registered.get("/v1/twins/benchsat").json()["seq"] == 50


def test_many_small_requests_share_few_commits(registered: AppClient, monkeypatch) -> None:
    commits = []
    commit = Database._commit
    monkeypatch.setattr(Database, "_commit", lambda self, orders: commits.append(commit(self, orders)))
    at_once(registered, [{"time": [k], "values": {"T_px": [290]}} for k in range(200)])
    assert len(commits) < 100
    metrics = registered.get("/metrics").text
    assert 'twin_ingest_samples_total{outcome="accepted",twin="benchsat"} 200.0' in metrics


def test_a_refused_request_harms_no_other(registered: AppClient) -> None:
    async def send() -> list[httpx.Response]:
        good = [{"time": [k], "values": {"T_px": [290]}} for k in range(20)]
        bad = [{"time": [k], "values": {"T_px": ["290"]}} for k in range(20)]
        return await asyncio.gather(
            *(registered.http.post(ROUTE, json=b) for pair in zip(good, bad, strict=True) for b in pair)
        )

    statuses = [answer.status_code for answer in registered.portal.call(send)]
    assert statuses == [200, 422] * 20
    assert registered.get(ROUTE).json()["samples"] == 20


@pytest.mark.parametrize("form", ["json", "x-ndjson"])
def test_a_short_body_of_very_many_missing_values_is_refused(registered: AppClient, monkeypatch, form: str) -> None:
    monkeypatch.setattr(telemetry_body, "MOST_VALUES", 30)
    for n_times, status in ((10, 200), (11, 413)):
        columns = orjson.dumps({"time": [*range(n_times)], "values": {}})
        lines = b"\n".join(orjson.dumps({"time": k, "values": {}}) for k in range(n_times))
        body = columns if form == "json" else lines
        answer = registered.post(ROUTE, content=body, headers={"Content-Type": f"application/{form}"})
        assert answer.status_code == status, answer.text
    assert "at most 10 fit" in answer.json()["detail"]
    assert registered.get(ROUTE).json()["samples"] == 10


def test_only_so_much_shares_a_commit(registered: AppClient, monkeypatch) -> None:
    sizes = []
    append = intake.take_in
    monkeypatch.setattr(
        intake, "take_in", lambda c, t, batch, s: sizes.append(batch.values.size) or append(c, t, batch, s)
    )
    monkeypatch.setattr(intake, "MOST_VALUES", 30)
    bodies = [
        {"time": [100 * k + j for j in range(n)], "values": {"T_px": [290] * n}} for k, n in enumerate([4] * 9 + [20])
    ]
    reports = at_once(registered, bodies)
    assert [report["accepted"] for report in reports] == [4] * 9 + [20]
    assert max(sizes) == 60 and sorted(sizes)[-2] <= 30
