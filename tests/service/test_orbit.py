"""A twin in orbit behind the real server: the client sends temperatures, the sunlight comes from the elements."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from service.client import TwinClient
from tests.service.server import Server
from tests.test_bad_input import TLE
from twin_core.network.spec_io import load_spec
from twin_core.units import parse_instant_ns

pytestmark = [pytest.mark.e2e, pytest.mark.slow]

STEP_S, NOISE_K = 60.0, 0.1
N_TRAIN, N_TIMES = 400, 600
EPOCH_NS = parse_instant_ns("2016-02-05T00:00:00Z")
SPEC: dict[str, Any] = {
    "twin": "cube",
    "boundaries": {"space": {"value_K": 2.7}},
    "channels": {
        "T": {"kind": "temperature", "unit": "degC"},
        "Q": {"kind": "power", "unit": "W"},
    },
    "nodes": [{"id": "box", "sensor": "T", "capacity_J_per_K": {"guess": 800.0}}],
    "radiators": [{"node": "box", "emissivity": 0.7, "area_m2": 0.06, "sink": "space"}],
    "loads": [
        {"channel": "Q", "node": "box"},
        {"channel": "orbit.sun_mean", "node": "box", "gain": {"guess": 0.05}},
        {"channel": "orbit.albedo_mean", "node": "box", "gain": {"guess": 0.05}},
        {"channel": "orbit.earth_mean", "node": "box", "gain": {"value": 0.042}},
    ],
    "orbit": {"tle": TLE, "attitude": "tumbling"},
}


def simulate() -> np.ndarray:
    """Integrate the balance in steps of 2 s with what falls on the box at each: C = 600 J/K, 0.036 m2 absorb."""
    block = load_spec(SPEC).orbit
    assert block is not None
    environment = block.environment()
    fine = round(STEP_S / 2.0)
    found = environment.quantities(environment.sky(EPOCH_NS, 2.0 * np.arange(N_TIMES * fine) + 1.0))
    heat_W = 0.036 * (found["sun_mean"] + found["albedo_mean"]) + 0.042 * found["earth_mean"] + 2.0
    temperature, read = 285.0, np.empty(N_TIMES)
    for k in range(N_TIMES):
        read[k] = temperature
        for q in heat_W[k * fine : (k + 1) * fine]:
            temperature += 2.0 / 600.0 * (q - 5.670374419e-8 * 0.042 * (temperature**4 - 2.7**4))
    return read - 273.15 + np.random.default_rng(5).normal(0.0, NOISE_K, N_TIMES)


TRUTH = simulate()


def send(client: TwinClient, first: int, stop: int) -> None:
    index = np.arange(first, stop)
    values = {"T": TRUTH[index].tolist(), "Q": np.full(index.size, 2.0).tolist()}
    client.ingest("cube", (EPOCH_NS / 1e9 + index * STEP_S).tolist(), values)


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TwinClient]:
    with Server(tmp_path_factory.mktemp("cube")) as running:
        client = running.client()
        client.register(SPEC)
        send(client, 0, N_TRAIN)
        job = client.wait("cube", client.calibrate("cube"))
        assert job.state == "succeeded", job.message
        yield client


def test_areas_come_out(client: TwinClient) -> None:
    (model,) = client.models("cube")
    found = {p["name"]: p for p in model.model_dump()["parameters"]}
    assert found["C:box"]["mean"] == pytest.approx(600.0, rel=0.03)
    assert found["gain:orbit.sun_mean|box"]["mean"] == pytest.approx(0.036, rel=0.03)
    assert found["gain:orbit.sun_mean|box"]["unit"] == "m2"


def test_the_live_filter_follows_through_eclipses(client: TwinClient) -> None:
    residual_K = np.array(client.all_residuals("cube").residual_K["T"][20:], dtype=float)
    assert residual_K.size > N_TRAIN - 50
    assert np.sqrt(np.mean(residual_K**2)) < 1.5 * NOISE_K


def test_a_forecast_needs_no_plan_of_the_sunlight(client: TwinClient) -> None:
    """Two orbits ahead: the swings through the eclipses are where they will be."""
    ahead = np.arange(N_TRAIN, N_TIMES)
    made = client.forecast("cube", ahead.size * STEP_S, step_s=STEP_S)
    names = ("orbit.sun_mean", "orbit.albedo_mean", "orbit.earth_mean")
    assert made.inputs == dict.fromkeys(names, "orbit") | {"Q": "hold"}
    mean = np.array(made.values["T"]["mean"])
    assert np.ptp(TRUTH[ahead]) > 10.0
    assert np.sqrt(np.mean((mean - TRUTH[ahead]) ** 2)) < 3.0 * NOISE_K


def test_the_network_of_the_moment_shows_its_loads(client: TwinClient) -> None:
    loads = {row["channel"]: row["heat_W"] for row in client._http.get("/v1/twins/cube/network").json()["loads"]}
    assert 2.0 < loads["orbit.earth_mean"] < 4.0 and loads["Q"] == 2.0


def test_what_the_orbit_gives_cannot_be_sent_or_planned(client: TwinClient) -> None:
    columns = {"time": [EPOCH_NS / 1e9 + N_TRAIN * STEP_S], "values": {"orbit.sun_mean": [3.0]}}
    for path, body in (("telemetry", columns), ("forecasts", {"horizon_s": 600.0, "plan": columns})):
        refused = client._http.post(f"/v1/twins/cube/{path}", json=body)
        assert refused.status_code == 422 and "orbit.sun_mean" in refused.text, path
