"""The real science behind the real server: telemetry in, a calibrated model, residuals, forecasts, restart."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.client import TwinClient
from tests.service.server import Server

pytestmark = [pytest.mark.e2e, pytest.mark.slow]

STEP_S = 60.0
N_TRAIN, N_TIMES = 500, 700
NOISE_K = 0.05
SPEC: dict[str, Any] = {
    "twin": "pair",
    "boundaries": {"space": {"value_K": 2.7}},
    "channels": {
        "T_a": {"kind": "temperature", "unit": "K", "noise_std": NOISE_K},
        "T_b": {"kind": "temperature", "unit": "degC", "noise_std": NOISE_K},
        "Q": {"kind": "power", "unit": "W"},
    },
    "nodes": [
        {"id": "a", "sensor": "T_a", "capacity_J_per_K": {"guess": 1.0e4}},
        {"id": "b", "sensor": "T_b", "capacity_J_per_K": {"guess": 1.0e4}},
    ],
    "conductors": [{"between": ["a", "b"], "conductance_W_per_K": {"guess": 1.0}}],
    "radiators": [{"node": "a", "emissivity": 0.8, "area_m2": 0.4, "sink": "space"}],
    "loads": [{"channel": "Q", "node": "a"}],
}


def simulate() -> dict[str, np.ndarray]:
    """Integrate the declared balance in small steps: C_a = 6 kJ/K, C_b = 9 kJ/K, G = 2.5 W/K, a 95-minute orbit."""
    time_s = np.arange(N_TIMES) * STEP_S
    power_W = 140.0 + 60.0 * (np.sin(2 * np.pi * time_s / 5700.0) > 0)
    temperatures = np.array([292.0, 292.0])
    found = np.empty((N_TIMES, 2))
    for k in range(N_TIMES):
        found[k] = temperatures
        for _ in range(30):
            flow = 2.5 * (temperatures[1] - temperatures[0])
            radiated = 5.670374419e-8 * 0.32 * (temperatures[0] ** 4 - 2.7**4)
            rates = np.array([(power_W[k] + flow - radiated) / 6.0e3, -flow / 9.0e3])
            temperatures = temperatures + rates * STEP_S / 30
    noise = np.random.default_rng(0).normal(0.0, NOISE_K, found.shape)
    return {"T_a": found[:, 0] + noise[:, 0], "T_b": found[:, 1] - 273.15 + noise[:, 1], "Q": power_W}


TRUTH = simulate()
EPOCH_S = 1_772_323_200.0


def send(client: TwinClient, rows: slice | list[int], twin: str = "pair", after_s: float = 0.0) -> None:
    index = np.arange(N_TIMES)[rows]
    values = {name: column[index].tolist() for name, column in TRUTH.items()}
    client.ingest(twin, (EPOCH_S + after_s + index * STEP_S).tolist(), values)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server whose twin was calibrated on the first part of the record."""
    with Server(tmp_path_factory.mktemp("pair")) as running:
        client = running.client()
        client.register(SPEC)
        send(client, slice(0, N_TRAIN))
        job = client.wait("pair", client.calibrate("pair"))
        assert job.state == "succeeded", job.message
        yield running


def test_parameters_come_out(server: Server) -> None:
    (model,) = server.client().models("pair")
    assert model.active and model.source == "calibration"
    assert model.validation["rmse_K"] < 2.0 * NOISE_K
    found = {p["name"]: p["mean"] for p in model.model_dump()["parameters"]}
    assert found["C:a"] == pytest.approx(6.0e3, rel=0.05)
    assert found["C:b"] == pytest.approx(9.0e3, rel=0.05)
    assert found["G:a|b"] == pytest.approx(2.5, rel=0.05)


def test_residuals_of_a_right_model_are_noise(server: Server) -> None:
    residuals = server.client().all_residuals("pair")
    assert len(residuals.time) >= N_TRAIN
    for name in ("T_a", "T_b"):
        column = np.array(residuals.residual_K[name][20:], dtype=float)
        assert np.sqrt(np.mean(column**2)) < 2.0 * NOISE_K
    assert 0.5 < np.mean(np.array(residuals.nis[20:], dtype=float)) < 4.0  # two sensors


def test_forecast_with_a_plan_covers_what_came(server: Server) -> None:
    client = server.client()
    ahead = np.arange(N_TRAIN, N_TIMES)
    plan = {"time": (EPOCH_S + ahead * STEP_S).tolist(), "values": {"Q": TRUTH["Q"][ahead].tolist()}}
    horizon_s = ahead.size * STEP_S
    made = client.forecast("pair", horizon_s, step_s=STEP_S, plan=plan)
    assert made.values["T_a"].keys() == {"mean", "q05", "q50", "q95"}
    for name in ("T_a", "T_b"):
        band = {key: np.array(column) for key, column in made.values[name].items()}
        read = TRUTH[name][ahead]
        assert np.sqrt(np.mean((band["mean"] - read) ** 2)) < 5.0 * NOISE_K
        covered = np.mean((read >= band["q05"]) & (read <= band["q95"]))
        assert covered > 0.7
    assert made.inputs == {"Q": "plan"}


@pytest.mark.parametrize(("inputs", "told"), [("auto", "repeat"), ("repeat", "repeat"), ("hold", "hold")])
def test_forecast_without_a_plan_covers_what_came(server: Server, inputs: str, told: str) -> None:
    """The power swings by 60 W with the orbit: held at its last value it alone would be off by many kelvin."""
    client = server.client()
    ahead = np.arange(N_TRAIN, N_TIMES)
    made = client.forecast("pair", ahead.size * STEP_S, step_s=STEP_S, inputs=inputs)
    parameters = {"horizon_s": ahead.size * STEP_S, "step_s": STEP_S, "inputs": inputs}
    read = client._http.get("/v1/twins/pair/forecast", params=parameters).json()
    assert made.values == read["values"]
    assert made.inputs == read["inputs"] == {"Q": told}
    assert [word for word in (made.notices or [""]) if "no plan was given: Q" in word]
    assert made.whole is not None and made.whole.probability == 0.9
    for name in ("T_a", "T_b"):
        band = {key: np.array(column) for key, column in made.values[name].items()}
        whole = made.whole.values[name]
        covered = np.mean((TRUTH[name][ahead] >= band["q05"]) & (TRUTH[name][ahead] <= band["q95"]))
        assert covered > 0.7
        assert (np.array(whole["low"]) <= band["q05"]).all() and (np.array(whole["high"]) >= band["q95"]).all()
        if told == "repeat":
            assert np.sqrt(np.mean((band["mean"] - TRUTH[name][ahead]) ** 2)) < 8.0 * NOISE_K


def test_network_balances(server: Server) -> None:
    response = server.client()._http.get("/v1/twins/pair/network").json()
    flow = {tuple(link["ends"]): link["heat_W"] for link in response["links"]}
    load = response["loads"][0]["heat_W"]
    net = {node["id"]: node["heat_W"] for node in response["nodes"]}
    assert net["a"] == pytest.approx(load - flow["a", "b"] - flow["a", "space"])
    assert net["b"] == pytest.approx(flow["a", "b"])


def test_late_samples_end_in_the_same_state_as_samples_in_order(server: Server, tmp_path: Path) -> None:
    client = server.client()
    document = client.model("pair", 1).model
    ends = {}
    for twin, order in (("ordered", [[600], [601], [602], [603]]), ("late", [[600], [603], [601], [602]])):
        client.register({**SPEC, "twin": twin})
        send(client, slice(400, 600), twin)
        copy = {**document, "spec": {**document["spec"], "twin": twin}}
        response = client._http.post(f"/v1/twins/{twin}/models", json=copy)
        assert response.status_code == 201, response.text
        client.activate(twin, 1)
        for rows in order:
            send(client, rows, twin)
            client.all_residuals(twin)
        found = client.all_residuals(twin)
        assert len(found.time) == 204
        ends[twin] = np.array([found.residual_K["T_a"][-3:], found.residual_K["T_b"][-3:]])
    np.testing.assert_allclose(ends["late"], ends["ordered"], atol=1e-6)


def test_records_far_apart_end_the_same_in_any_order(server: Server) -> None:
    client = server.client()
    document = client.model("pair", 1).model
    found = {}
    first, second = [(slice(300, 360), 0.0), (slice(360, 400), 0.0)], [(slice(400, 450), 1e7), (slice(450, 500), 1e7)]
    for twin, order in (("onward", first + second), ("backward", second + first)):
        client.register({**SPEC, "twin": twin})
        copy = {**document, "spec": {**document["spec"], "twin": twin}}
        client._http.post(f"/v1/twins/{twin}/models", json=copy).raise_for_status()
        client.activate(twin, 1)
        for rows, after_s in order:
            send(client, rows, twin, after_s)
            found[twin] = client.all_residuals(twin)
    onward, backward = found["onward"], found["backward"]
    assert onward.time == backward.time and len(onward.time) == 200
    for sensor in ("T_a", "T_b"):
        np.testing.assert_allclose(
            np.array(backward.residual_K[sensor]), np.array(onward.residual_K[sensor]), atol=1e-6
        )
    told = [[(a.sensor, a.start, a.stop) for a in client.anomalies(twin)] for twin in ("onward", "backward")]
    assert told[0] == told[1]


def test_restart_goes_on_from_the_checkpoint(server: Server) -> None:
    before = server.client().all_residuals("pair")
    server.stop()
    server.start()
    client = server.client()
    send(client, [N_TRAIN])
    after = client.all_residuals("pair")
    assert after.residual_K["T_a"][: len(before.time)] == before.residual_K["T_a"]
    assert len(after.time) == len(before.time) + 1
    assert abs(after.residual_K["T_a"][-1] or 9.9) < 6.0 * NOISE_K
    assert client.model("pair", 1).active
