"""A takeover with the real filter: the residuals are those of a service that nothing happened to."""

import contextlib
import time
from itertools import cycle
from pathlib import Path

import httpx
import numpy as np
import psycopg
import pytest

from service.client import TwinClient
from service.schemas import Residuals
from service.store.ownership import slot_of
from tests.service.server import Server
from tests.service.test_end_to_end import EPOCH_S, N_TIMES, N_TRAIN, SPEC, STEP_S, TRUTH, send

pytestmark = [pytest.mark.fleet, pytest.mark.slow]
TWIN = "/v1/twins/pair"
KILLED_AT = 600
BATCHING_K = 1e-4
"""The iterated filter linearises the balance about the filtered trajectory of a block of samples, three times, which leaves less
than 5e-5 K to go; a takeover changes where blocks begin, so that two runs may differ by twice that. Noise is 0.05 K here."""


def owner(url: str) -> str:
    """Return who follows the first twin as HOST:PID:NAME."""
    query = "SELECT coalesce(max(owner), '') FROM slot WHERE number = %s AND until_us > clock_us()"
    with psycopg.connect(url, autocommit=True) as connection:
        return str(connection.execute(query, (slot_of(1),)).fetchone()[0])  # type: ignore[index]


def deliver(row: int, urls: list[str]) -> None:
    """Send one sample to whichever service takes it."""
    body = {"time": [EPOCH_S + STEP_S * row], "values": {name: [float(c[row])] for name, c in TRUTH.items()}}
    end_s = time.monotonic() + 60.0
    for url in cycle(urls):
        with contextlib.suppress(httpx.TransportError):
            answer = httpx.post(f"{url}{TWIN}/telemetry", json=body, trust_env=False, timeout=10.0)
            if answer.status_code == 200:
                return
            assert answer.status_code == 503, answer.text
        assert time.monotonic() < end_s
        time.sleep(0.1)


def followed(client: TwinClient) -> Residuals:
    """Return the residuals of the active model, all of them."""
    end_s = time.monotonic() + 120.0
    while True:
        found = client.all_residuals("pair")
        if len(found.time) == N_TIMES:
            return found
        assert time.monotonic() < end_s, len(found.time)
        time.sleep(0.5)


def test_residuals_after_a_takeover_are_those_of_a_service_to_which_nothing_happened(
    tmp_path: Path, postgres: str
) -> None:
    for name in ("calm", "one", "other"):
        (tmp_path / name).mkdir()
    own = {"database_url": postgres, "log_level": "warning"}
    with (
        Server(tmp_path / "calm") as calm,
        Server(tmp_path / "one", **own) as one,
        Server(tmp_path / "other", **own) as other,
    ):
        for client in (calm.client(), one.client()):
            client.register(SPEC)
            send(client, slice(0, N_TRAIN))
        job = calm.client().wait("pair", calm.client().calibrate("pair"))
        assert job.state == "succeeded", job.message
        document = calm.client().model("pair", 1).model
        for server, version in ((calm, 2), (one, 1)):  # the same model, which follows the whole archive, in both
            answer = httpx.post(f"{server.url}{TWIN}/models", json=document, trust_env=False)
            assert answer.status_code == 201, answer.text
            server.client().activate("pair", version)
        alive = [one, other]
        for row in range(N_TRAIN, N_TIMES):
            deliver(row, [calm.url])
            deliver(row, [server.url for server in alive])
            if row == KILLED_AT:
                (victim,) = (server for server in alive if f":{server.process.pid}:" in owner(postgres))
                victim.kill()
                alive.remove(victim)
        expected, found = followed(calm.client()), followed(alive[0].client())
        assert f":{alive[0].process.pid}:" in owner(postgres)
    assert found.time == expected.time
    for sensor in ("T_a", "T_b"):
        ours, theirs = (np.array(f.residual_K[sensor], dtype=float) for f in (found, expected))
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=BATCHING_K)
        assert np.abs(theirs[KILLED_AT:]).max() > 10 * BATCHING_K  # there is something to agree in
        ours, theirs = (np.array(f.std_K[sensor], dtype=float) for f in (found, expected))
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=BATCHING_K)
