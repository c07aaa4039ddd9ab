"""Capacities that change with temperature: warming at constant heat in closed form, and a cycle against SciPy."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import cumulative_simpson, solve_ivp
from scipy.special import ndtr

from tests.helpers import (
    at_named,
    central_difference,
    conductive_spec,
    every_term_network,
    points,
    record_of,
    survey_of,
)
from twin_core.effects import REGISTRY, Effect
from twin_core.effects.capacity_temperature import LinearCapacity
from twin_core.network.model import Network, build_network
from twin_core.network.spec_io import load_spec
from twin_core.network.storage import store, to_enthalpy_K, to_temperatures_K
from twin_core.network.terms import Capacity
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout

C, POWER_W = 2.0e3, 10.0
NODE = {"node": "n0"}
MELTING = REGISTRY["latent_heat"](NODE, {"L_J": 3.0e4, "T_m_K": 300.0, "w_K": 1.5})
STIFFENING = REGISTRY["capacity_temperature"](NODE, {"kappa_per_K": 0.02}, {"T_ref_K": 295.0})


def network_with(effect: Effect) -> Network:
    power = {"kind": "power", "unit": "W"}
    spec = conductive_spec(1, [], channels={"Q": power}, loads=[{"channel": "Q", "node": "n0"}])
    return at_named(build_network(load_spec(spec), [effect]), {"C:n0": C})


def warmed(
    effect: Effect, heat_W: np.ndarray, time_s: np.ndarray, start_K: float, max_step_s: float = 5.0
) -> np.ndarray:
    network = network_with(effect)
    forcing = build_forcing(network, record_of(time_s, Q=heat_W), max_step_s)
    path = rollout(network, network.parameters.values, np.array([start_K]), forcing)
    assert path.converged
    return path.at_samples(forcing.sample_step)[:, 0]


@pytest.mark.parametrize("width_K", [1.5, 0.05, 1e-3])
@pytest.mark.parametrize("step_s", [5.0, 60.0, 720.0])
def test_melting_takes_up_its_latent_heat(width_K: float, step_s: float) -> None:
    """Energy: C (T - T_0) + L = Q t once all is melted, however long the steps and however narrow the peak."""
    time_s = step_s * np.arange(7200.0 / step_s + 1.0)
    melting = MELTING.with_values({"w_K": width_K})
    found = warmed(melting, np.full(time_s.size, POWER_W), time_s, 290.0, step_s)
    assert found[-1] > 310.0
    np.testing.assert_allclose(C * (found[-1] - 290.0) + 3.0e4, POWER_W * time_s[-1], rtol=1e-9)
    back = warmed(melting, np.full(time_s.size, -POWER_W), time_s, float(found[-1]), step_s)
    np.testing.assert_allclose(back[-1], 290.0, rtol=1e-9)


@pytest.mark.parametrize("width_K", [2.0, 0.1])
def test_melting_between_two_nodes_with_long_steps_is_that_of_scipy(width_K: float) -> None:
    """A node that freezes and melts through a stiff coupling, sampled once a minute; SciPy integrates the enthalpies."""
    spec = conductive_spec(
        2,
        [(0, 1)],
        channels={"Q": {"kind": "power", "unit": "W"}},
        loads=[{"channel": "Q", "node": "n0"}],
    )
    effect = REGISTRY["latent_heat"]({"node": "n1"}, {"L_J": 9.0e3, "T_m_K": 300.0, "w_K": width_K})
    network = at_named(build_network(load_spec(spec), [effect]), {"C:n0": 900.0, "C:n1": 600.0, "G:n0|n1": 8.0})
    time_s = 60.0 * np.arange(300)
    heat = np.where(np.arange(300) % 60 < 30, 25.0, -25.0)
    forcing = build_forcing(network, record_of(time_s, Q=heat), 60.0)
    path = rollout(network, network.parameters.values, np.array([298.0, 298.0]), forcing)
    assert path.converged
    found = path.at_samples(forcing.sample_step)

    grid_K = np.linspace(200.0, 400.0, 400_001)
    grid_J = 600.0 * grid_K + 9.0e3 * ndtr((grid_K - 300.0) / width_K)

    def flow(t: float, h: np.ndarray) -> list[float]:
        exchanged = 8.0 * (h[0] / 900.0 - np.interp(h[1], grid_J, grid_K))
        return [heat[min(int(t / 60.0), 299)] - exchanged, exchanged]

    start = [900.0 * 298.0, float(np.interp(298.0, grid_K, grid_J))]
    stiff = {"method": "Radau", "max_step": 20.0, "rtol": 1e-8, "atol": 1e-3}
    truth = solve_ivp(flow, (0.0, time_s[-1]), start, t_eval=time_s, **stiff).y
    np.testing.assert_allclose(found[:, 0], truth[0] / 900.0, atol=0.25)
    np.testing.assert_allclose(found[:, 1], np.interp(truth[1], grid_J, grid_K), atol=0.25)
    held = 900.0 * found[:, 0] + 600.0 * found[:, 1] + 9.0e3 * ndtr((found[:, 1] - 300.0) / width_K)
    put_in = np.concatenate([[0.0], np.cumsum(60.0 * heat[:-1])])
    np.testing.assert_allclose(held - held[0], put_in, atol=1e-3)


@pytest.mark.parametrize(
    "effect, values",
    [(MELTING, (3.0e4, 300.0, 1.5)), *((STIFFENING, (kappa, C)) for kappa in (-0.3, -1e-3, 0.0, 0.02, 0.3))],
)
def test_what_a_capacity_stores_is_its_integral(effect: Effect, values: tuple[float, ...]) -> None:
    """By quadrature, across where the line bends; and the derivatives of both by central differences."""
    term = network_with(effect).capacities[0]
    fine_K = np.linspace(270.0, 320.0, 500_001)
    temperature = fine_K[::1000]
    part = term.evaluate(temperature, np.array(values))
    integral = cumulative_simpson(term.evaluate(fine_K, np.array(values)).extra_J_per_K, x=fine_K, initial=0.0)[::1000]
    scale = np.abs(integral).max() + 1.0
    np.testing.assert_allclose(part.stored_J - part.stored_J[0], integral, atol=1e-7 * scale)
    for entry in part.d_stored:

        def stored(x: float, item: int = entry.item) -> np.ndarray:
            return term.evaluate(temperature, np.array([*values[:item], x, *values[item + 1 :]])).stored_J

        at = values[entry.item]
        expected = central_difference(stored, at, 1e-4 * max(abs(at), 0.01))
        np.testing.assert_allclose(entry.series, expected, atol=1e-5 * (np.abs(expected).max() + 1e-9))


@pytest.mark.parametrize("width_K", [3.0, 0.2, 1e-3])
def test_a_temperature_is_found_from_its_enthalpy(width_K: float) -> None:
    network = network_with(MELTING.with_values({"w_K": width_K}))
    values = network.parameters.values
    temperature = np.linspace(250.0, 350.0, 1001)[:, None]
    enthalpy = to_enthalpy_K(network, values, temperature)
    assert (np.diff(enthalpy[:, 0]) > 0.0).all()
    for near in (temperature, np.full_like(temperature, 250.0), np.full_like(temperature, 300.0)):
        found = to_temperatures_K(network, values, enthalpy, near, (0.5, 5e3))
        np.testing.assert_allclose(found, temperature, atol=1e-9)


def test_a_temperature_is_found_as_well_as_rounding_allows_and_no_better(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where hardly anything is stored u is told to fewer digits of T: no bisection between two neighbouring numbers."""
    network = network_with(STIFFENING.with_values({"kappa_per_K": -0.7}))
    values = network.parameters.values
    temperature = np.linspace(293.0, 400.0, 301)[:, None]
    enthalpy = to_enthalpy_K(network, values, temperature)
    n_looks, evaluate = 0, LinearCapacity.evaluate

    def counted(*arguments: Any) -> Capacity:
        nonlocal n_looks
        n_looks += 1
        return evaluate(*arguments)

    monkeypatch.setattr(LinearCapacity, "evaluate", counted)
    found = to_temperatures_K(network, values, enthalpy, np.full_like(temperature, 294.0), (0.5, 5e3))
    assert 2 < n_looks < 40
    slopes = store(network, values, temperature).slope
    assert (np.abs(found - temperature) < 1e-11 + 1e-12 * slopes).all()


def test_only_where_a_capacity_changes_is_a_temperature_looked_for() -> None:
    spec = load_spec(conductive_spec(3, [(0, 1), (1, 2)]))
    changing = REGISTRY["capacity_temperature"]({"node": "n1"}, {"kappa_per_K": 0.02}, {"T_ref_K": 295.0})
    network, plain = build_network(spec, [changing]), build_network(spec)
    temperature = np.random.default_rng(4).uniform(280.0, 310.0, (5, 2, 3))
    enthalpy = to_enthalpy_K(network, network.parameters.values, temperature)
    assert np.array_equal(enthalpy[..., ::2], temperature[..., ::2]) and (enthalpy[..., 1] != temperature[..., 1]).all()
    found = to_temperatures_K(network, network.parameters.values, enthalpy, temperature + 3.0, (0.5, 5e3))
    np.testing.assert_allclose(found, temperature, atol=1e-9)
    assert to_temperatures_K(plain, plain.parameters.values, enthalpy, temperature, (0.5, 5e3)) is enthalpy


def test_beyond_a_limit_the_limit_is_returned() -> None:
    network = network_with(STIFFENING)
    values = network.parameters.values
    found = to_temperatures_K(network, values, np.array([[-1e9], [1e9]]), np.array([[290.0], [290.0]]), (100.0, 500.0))
    assert found.tolist() == [[100.0], [500.0]]


def test_a_capacity_that_grows_takes_up_more() -> None:
    """Energy: C (x + kappa x^2 / 2) between two temperatures x = T - T_ref."""
    time_s = 60.0 * np.arange(121)
    found = warmed(STIFFENING, np.full(121, POWER_W), time_s, 290.0)
    x = found - 295.0
    stored = C * (x + 0.01 * x**2) - C * (-5.0 + 0.01 * 25.0)
    np.testing.assert_allclose(stored, POWER_W * time_s, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("effect", [MELTING, STIFFENING], ids=lambda e: e.name)
def test_a_cycle_is_that_of_scipy(effect: Effect) -> None:
    time_s = 60.0 * np.arange(200)
    heat = np.where(np.arange(200) % 80 < 40, POWER_W, -POWER_W)

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        extra = (
            3.0e4 * np.exp(-0.5 * ((x - 300.0) / 1.5) ** 2) / (1.5 * np.sqrt(2.0 * np.pi))
            if effect is MELTING
            else C * 0.02 * (x - 295.0)
        )
        return heat[min(int(t / 60.0), 199)] / (C + extra)

    found = warmed(effect, heat, time_s, 293.0)
    truth = solve_ivp(rate, (0.0, time_s[-1]), [293.0], t_eval=time_s, max_step=30.0, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found, truth.y[0], atol=5e-3)


@pytest.mark.parametrize("kappa", [-5.0, -0.1, 0.1, 5.0])
def test_a_capacity_stays_positive_whatever_the_temperature(kappa: float) -> None:
    network = network_with(STIFFENING.with_values({"kappa_per_K": kappa}))
    temperature = np.linspace(1.0, 4000.0, 5000)
    part = network.capacities[0].evaluate(temperature, np.array([kappa, C]))
    assert (C + part.extra_J_per_K > 0.0).all()


def test_a_change_of_phase_lies_within_what_was_visited() -> None:
    """Melting that the record has seen one flank of may take up anything: no fit may go there."""
    network = every_term_network()
    survey = survey_of(network, points(network, 400))
    visited_K = survey.temperature_K("a")
    starts = list(REGISTRY["latent_heat"].starts({"node": "a"}, survey))
    assert starts
    for effect in starts:
        centre, width = (next(q for q in effect.parameter_specs() if q.name == name) for name in ("T_m_K", "w_K"))
        for far_K in (100.0, 1000.0):
            assert visited_K.min() <= centre.transform.to_value(far_K) <= visited_K.max()
        assert width.transform.to_value(np.log(1000.0)) <= 0.25 * np.ptp(visited_K)
        assert width.transform.to_value(np.log(effect.values["w_K"])) == pytest.approx(effect.values["w_K"])


@pytest.mark.parametrize("centre_K", [257.0, 262.0, 281.0])
@pytest.mark.parametrize("width_K", [0.3, 0.8])
def test_a_change_of_phase_is_looked_for_where_the_node_stays(centre_K: float, width_K: float) -> None:
    """A node that cools, and a plateau of its enthalpy's inverse: also one at the end of a record, incomplete."""

    def rate(_: float, t: np.ndarray) -> np.ndarray:
        capacity = 1.0e4 + 2.0e5 * np.exp(-0.5 * ((t - centre_K) / width_K) ** 2) / (np.sqrt(2.0 * np.pi) * width_K)
        return 2.0 * (240.0 - t) / capacity

    time_s = np.linspace(0.0, 15_000.0, 400)
    cooled = solve_ivp(rate, (0.0, time_s[-1]), [288.0], t_eval=time_s, max_step=20.0, rtol=1e-8).y[0]
    network = every_term_network()
    survey = survey_of(network, points(network, 400))
    survey.along.temperatures_K[:, network.nodes.index("a")] = cooled
    starts = [e.values for e in REGISTRY["latent_heat"].starts({"node": "a"}, survey)]
    assert any(abs(v["T_m_K"] - centre_K) < width_K and 0.5 < v["w_K"] / width_K < 2.0 for v in starts)
