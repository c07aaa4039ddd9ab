"""The clients: retries, errors, both flavours against the real application."""

import asyncio
from collections.abc import Callable

import httpx
import pytest

from service import calls
from service.client import ApiError, AsyncTwinClient, Retry, TwinClient, Unreachable
from tests.service.conftest import SPEC
from tests.service.harness import AppClient

REPORT = {"accepted": 1, "duplicates": 0, "rejected": [], "last_time": None}
Answer = httpx.Response | Exception


def scripted(answers: list[Answer], seen: list[str]) -> Callable[[httpx.Request], httpx.Response]:
    """Answer requests one after another, noting them."""
    script = iter(answers)

    def handle(request: httpx.Request) -> httpx.Response:
        seen.append(f"{request.method} {request.url.path}")
        answer = next(script)
        if isinstance(answer, Exception):
            raise answer
        return answer

    return handle


def make_client(answers: list[Answer], seen: list[str], pauses: list[float], attempts: int = 4) -> TwinClient:
    transport = httpx.MockTransport(scripted(answers, seen))
    return TwinClient("http://t", "k", transport=transport, retry=Retry(attempts), sleep_s=pauses.append)


def test_repeatable_calls_are_tried_again_with_growing_pauses() -> None:
    seen: list[str] = []
    pauses: list[float] = []
    answers: list[Answer] = [httpx.ConnectError("no"), httpx.ReadTimeout("late"), httpx.Response(503)]
    with make_client([*answers, httpx.Response(200, json=REPORT)], seen, pauses) as client:
        assert client.ingest("t", [1.0], {"T": [1.0]}).accepted == 1
    assert len(seen) == 4
    assert all(0.1 * 2**i <= pause <= 0.2 * 2**i for i, pause in enumerate(pauses))


def test_a_call_that_may_have_worked_is_not_repeated() -> None:
    seen: list[str] = []
    with make_client([httpx.ReadTimeout("late")], seen, []) as client, pytest.raises(Unreachable):
        client.calibrate("t")
    assert seen == ["POST /v1/twins/t/calibrations"]


def test_all_residuals_are_asked_for_until_they_are_complete() -> None:
    seen: list[str] = []
    answers = [
        {"time": [], "residual_K": {}, "nis": [], "model_version": [], "complete": done} for done in (False, True)
    ]
    with make_client([httpx.Response(200, json=answer) for answer in answers], seen, []) as client:
        assert client.all_residuals("t").complete
    assert len(seen) == 2


def test_refusals_are_not_repeated_and_name_the_field() -> None:
    problem = {"detail": "time[0]: bad", "errors": [{"field": "time[0]", "detail": "bad"}]}
    seen: list[str] = []
    with make_client([httpx.Response(422, json=problem)], seen, []) as client, pytest.raises(ApiError) as caught:
        client.ingest("t", [1.0], {})
    assert (caught.value.status, caught.value.detail) == (422, "time[0]: bad")
    assert caught.value.errors[0]["field"] == "time[0]"
    assert len(seen) == 1


def test_what_is_not_known_yet_is_asked_for_again() -> None:
    seen: list[str] = []
    not_yet = httpx.Response(409, json={"detail": "still being assimilated"}, headers={"Retry-After": "1"})
    with make_client([not_yet, httpx.Response(200, json={"twins": []})], seen, []) as client:
        assert client.twins() == []
    assert len(seen) == 2


def test_giving_up() -> None:
    with (
        make_client([httpx.ConnectError("refused")] * 4, [], []) as client,
        pytest.raises(Unreachable, match="refused"),
    ):
        client.twins()
    with make_client([httpx.Response(503, text="busy")] * 4, [], []) as client, pytest.raises(ApiError, match="503"):
        client.twins()


def test_asynchronous_client_against_the_application(client: AppClient) -> None:
    async def use() -> list[float | None]:
        transport = httpx.ASGITransport(client.app)
        async with AsyncTwinClient("http://127.0.0.1", transport=transport) as twin_client:
            assert (await twin_client.register(SPEC)).id == "benchsat"
            assert (await twin_client.ingest("benchsat", [1.0, 2.0], {"T_px": [5.0, None]})).accepted == 2
            with pytest.raises(ApiError, match="409: no model is active"):
                await twin_client.forecast("benchsat", 60.0)
            with pytest.raises(ApiError, match="404"):
                await twin_client.send(calls.twin("nosuch"))
            return (await twin_client.send(calls.archive("benchsat", {"channels": "T_px"}))).values["T_px"]

    assert client.portal.call(use) == [5.0, None]


def test_asynchronous_retries() -> None:
    async def use() -> int:
        transport = httpx.MockTransport(scripted([httpx.ConnectError("no"), httpx.Response(200, json=REPORT)], []))
        async with AsyncTwinClient("http://t", transport=transport, retry=Retry(2, 0.001)) as twin_client:
            return (await twin_client.ingest("t", [1.0], {})).accepted

    assert asyncio.run(use()) == 1
