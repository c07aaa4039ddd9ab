"""Rollouts against matrix exponentials, SciPy and closed forms; sensitivities against central differences."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from tests.analytic import SIGMA, laplacian, linear_states, radiative_equilibrium_K
from tests.helpers import (
    active_effect,
    at_named,
    central_difference,
    conductive_spec,
    every_term_network,
    record_of,
)
from twin_core.effects import REGISTRY
from twin_core.network.model import Network, build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import Forcing, build_forcing
from twin_core.simulate.response import sensitivities
from twin_core.simulate.rollout import Rollout, rollout
from twin_core.telemetry import Record

POWER: dict[str, Any] = {"kind": "power", "unit": "W"}
CHAIN = load_spec(
    conductive_spec(
        3,
        [(0, 1), (1, 2)],
        channels={"Q": POWER},
        loads=[{"channel": "Q", "node": "n0"}],
    )
)
CAPACITY = np.array([3.0e3, 8.0e3, 1.5e3])
CONDUCTANCE = [2.0, 0.5]
START_K = np.array([300.0, 280.0, 260.0])


def chain() -> Network:
    named = {f"C:n{i}": float(c) for i, c in enumerate(CAPACITY)}
    return at_named(build_network(CHAIN), named | {"G:n0|n1": CONDUCTANCE[0], "G:n1|n2": CONDUCTANCE[1]})


def chain_truth(time_s: np.ndarray, power_W: np.ndarray) -> np.ndarray:
    rates = -laplacian(3, [(0, 1), (1, 2)], CONDUCTANCE) / CAPACITY[:, None]
    return linear_states(rates, np.outer(power_W, [1.0 / CAPACITY[0], 0.0, 0.0]), START_K, time_s)


def states(network: Network, record: Record, start_K: np.ndarray, max_step_s: float = np.inf) -> np.ndarray:
    forcing = build_forcing(network, record, max_step_s)
    path = rollout(network, network.parameters.values, start_K, forcing)
    assert path.converged
    return path.at_samples(forcing.sample_step)


def test_a_linear_network_is_the_matrix_exponential_whatever_the_steps() -> None:
    rng = np.random.default_rng(4)
    time_s = np.cumsum(rng.uniform(50.0, 400.0, 40))
    power = rng.choice([0.0, 30.0, 80.0], time_s.size)
    record = record_of(time_s, Q=power)
    for step in (np.inf, 100.0, 25.0):
        np.testing.assert_allclose(states(chain(), record, START_K, step), chain_truth(time_s, power), atol=1e-9)


def radiating() -> Network:
    spec = load_spec(
        conductive_spec(
            2,
            [(0, 1)],
            channels={"Q": POWER},
            loads=[{"channel": "Q", "node": "n0"}],
            boundaries={"space": {"value_K": 4.0}},
            radiators=[{"node": "n1", "emissivity": 0.9, "area_m2": 0.4, "sink": "space"}],
        )
    )
    return at_named(build_network(spec), {"C:n0": 2.0e3, "C:n1": 6.0e3, "G:n0|n1": 4.0})


def radiating_truth(time_s: np.ndarray, power_W: np.ndarray, start_K: np.ndarray) -> np.ndarray:
    """Integrate interval by interval, so that the switches of the input are met exactly."""
    found = [start_K]
    for k in range(time_s.size - 1):

        def rates(t: float, x: np.ndarray, k: int = k) -> list[float]:
            exchange = 4.0 * (x[1] - x[0])
            return [
                (power_W[k] + exchange) / 2.0e3,
                (-exchange + SIGMA * 0.36 * (4.0**4 - x[1] ** 4)) / 6.0e3,
            ]

        span = (time_s[k], time_s[k + 1])
        found.append(solve_ivp(rates, span, found[-1], method="DOP853", rtol=1e-11, atol=1e-9).y[:, -1])
    return np.array(found)


def test_second_order_against_scipy_with_radiation() -> None:
    time_s = 300.0 * np.arange(25)
    power = np.where(np.arange(25) % 7 < 3, 150.0, 20.0)
    record = record_of(time_s, Q=power)
    truth = radiating_truth(time_s, power, np.array([320.0, 230.0]))
    errors = [
        float(np.abs(states(radiating(), record, truth[0], step) - truth).max()) for step in (60.0, 30.0, 15.0, 7.5)
    ]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 2.0, atol=0.1)
    assert errors[-1] < 1e-3


@pytest.mark.parametrize("offset_K", [0.0, 45.0])
def test_second_order_by_a_manufactured_solution(offset_K: float) -> None:
    """The heat that two radiating nodes need for T = T0 + a sin(w t) is given, linear between samples.

    ``offset_K`` lies between the start, about which radiation is linearised, and the mean: the order is that of the rule,
    not of a lucky linearisation.
    """
    linear = POWER | {"interpolation": "linear"}
    spec = load_spec(
        conductive_spec(
            2,
            [(0, 1)],
            channels={"Q0": linear, "Q1": linear},
            loads=[{"channel": f"Q{i}", "node": f"n{i}"} for i in (0, 1)],
            boundaries={"space": {"value_K": 4.0}},
            radiators=[{"node": f"n{i}", "emissivity": 0.9, "area_m2": 0.4, "sink": "space"} for i in (0, 1)],
        )
    )
    network = at_named(build_network(spec), {"C:n0": 2.0e3, "C:n1": 6.0e3, "G:n0|n1": 4.0})
    amplitude, w, capacity = np.array([60.0, -40.0]), 2.0 * np.pi / np.array([3000.0, 5000.0]), np.array([2.0e3, 6.0e3])
    errors = []
    for step_s in (200.0, 100.0, 50.0, 25.0):
        time_s = np.arange(0.0, 6001.0, step_s)
        exact = 280.0 + offset_K * np.sin(w / 4.0 * time_s[:, None]) + amplitude * np.sin(w * time_s[:, None])
        rate = offset_K * w / 4.0 * np.cos(w / 4.0 * time_s[:, None]) + amplitude * w * np.cos(w * time_s[:, None])
        exchange = 4.0 * (exact[:, ::-1] - exact)
        heat = capacity * rate - exchange - SIGMA * 0.36 * (4.0**4 - exact**4)
        found = states(network, record_of(time_s, Q0=heat[:, 0], Q1=heat[:, 1]), exact[0])
        errors.append(float(np.abs(found - exact).max()))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 2.0, atol=0.1)


def test_radiative_equilibrium() -> None:
    time_s = 600.0 * np.arange(200)
    found = states(radiating(), record_of(time_s, Q=90.0), np.array([250.0, 250.0]))[-1]
    radiator = radiative_equilibrium_K(90.0, 0.36, 4.0)
    # 1e-6 K: a radiator at 261 K of 6 kJ/K settles within e^-60 of its start in this time.
    np.testing.assert_allclose(found, [radiator + 90.0 / 4.0, radiator], atol=1e-6)


def test_held_inputs_are_seen_exactly() -> None:
    """A lone node is an integrator: its temperature is the summed heat, whatever the steps."""
    spec = load_spec(conductive_spec(1, [], channels={"Q": POWER}, loads=[{"channel": "Q", "node": "n0"}]))
    rng = np.random.default_rng(0)
    time_s = np.cumsum(rng.uniform(1.0, 900.0, 50))
    power = rng.uniform(-20.0, 50.0, 50)
    expected = 290.0 + np.concatenate([[0.0], np.cumsum(power[:-1] * np.diff(time_s))]) / 5.0e3
    for step in (np.inf, 40.0):
        found = states(build_network(spec), record_of(time_s, Q=power), np.array([290.0]), step)[:, 0]
        np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("capacity_J_per_K", [1e-1, 1e-4])
def test_a_stiff_node_follows_without_ringing(capacity_J_per_K: float) -> None:
    """A node with a time constant far below the step goes to its neighbour within one or two steps."""
    network = at_named(chain(), {"C:n2": capacity_J_per_K, "G:n1|n2": 10.0})
    found = states(network, record_of(60.0 * np.arange(30), Q=0.0), np.array([280.0, 280.0, 350.0]))
    distance = found[:, 2] - found[:, 1]
    # R(z) = (1 + (1 - 2 gamma) z) / (1 - gamma z)^2 tends to 4.83 / |z|, here with |z| = 600 / C: twice in two steps.
    assert np.abs(distance[2:]).max() < 70.0 * (5.0 * capacity_J_per_K / 600.0) ** 2 + 1e-6
    assert found.max() <= 350.0


def test_missing_temperatures_do_not_touch_a_rollout() -> None:
    time_s = 60.0 * np.arange(50)
    rng = np.random.default_rng(1)
    power = rng.uniform(0, 40, 50)
    bare = states(chain(), record_of(time_s, Q=power), START_K)
    gappy = record_of(time_s, Q=power, T0=np.where(rng.random(50) < 0.5, np.nan, 290.0))
    np.testing.assert_array_equal(states(chain(), gappy, START_K), bare)


def test_a_gap_in_the_samples_holds_the_input() -> None:
    time_s = np.array([0.0, 60.0, 120.0, 7200.0, 7260.0])
    power = np.array([0.0, 10.0, 50.0, 0.0, 0.0])
    found = states(chain(), record_of(time_s, Q=power), START_K, 20.0)
    np.testing.assert_allclose(found, chain_truth(time_s, power), atol=2e-3)


def test_a_rollout_can_be_cut_anywhere() -> None:
    """Long records are solved in stretches: a rollout continued from its own middle is the same rollout."""
    time_s = 30.0 * np.arange(3000)
    power = 40.0 + 40.0 * np.sin(time_s / 900.0)
    whole = states(radiating(), record_of(time_s, Q=power), np.array([280.0, 270.0]))
    rest = states(radiating(), record_of(time_s[1500:], Q=power[1500:]), whole[1500])
    np.testing.assert_allclose(rest, whole[1500:], atol=2e-7)  # twice the tolerance of Newton's iterations


def test_a_nearby_trajectory_changes_nothing_but_the_effort() -> None:
    network, record = radiating(), record_of(60.0 * np.arange(300), Q=50.0)
    forcing = build_forcing(network, record, np.inf)
    plain = rollout(network, network.parameters.values, np.array([280.0, 270.0]), forcing)
    far = rollout(network, network.parameters.values, np.array([285.0, 240.0]), forcing)
    again = rollout(network, network.parameters.values, np.array([280.0, 270.0]), forcing, near=far.stages_K)
    np.testing.assert_allclose(again.stages_K, plain.stages_K, atol=2e-7)


@pytest.mark.parametrize("power_W", [-5.0e4, 1.0e7])
def test_an_impossible_balance_is_a_status_not_an_exception(power_W: float) -> None:
    network = radiating()
    power = np.where(np.arange(40) < 20, 10.0, power_W)
    forcing = build_forcing(network, record_of(60.0 * np.arange(40), Q=power), np.inf)
    path = rollout(network, network.parameters.values, np.array([280.0, 270.0]), forcing)
    assert not path.converged
    assert np.isnan(path.stages_K[-1]).all()


@pytest.mark.parametrize("value", [np.inf, np.nan, 1e308])
def test_numbers_beyond_floats_are_a_status_not_an_exception(value: float) -> None:
    network = radiating()
    forcing = build_forcing(network, record_of(60.0 * np.arange(40), Q=10.0), np.inf)
    for name in ("C:n0", "G:n0|n1", "R:n1|space"):
        values = network.parameters.values
        values[network.parameters.index[name]] = 1.0 / value if name == "C:n0" else value
        with np.errstate(all="ignore"):
            assert not rollout(network, values, np.array([280.0, 270.0]), forcing).converged
    assert not rollout(network, network.parameters.values, np.array([280.0, np.nan]), forcing).converged


def test_no_steps_leave_the_start() -> None:
    network = chain()
    forcing = build_forcing(network, record_of(np.array([5.0]), Q=1.0), np.inf)
    path = rollout(network, network.parameters.values, START_K, forcing)
    np.testing.assert_array_equal(path.at_samples(forcing.sample_step), START_K[None])


@settings(max_examples=15, deadline=None)
@given(n_nodes=st.integers(1, 6), seed=st.integers(0, 2**32 - 1))
def test_conduction_keeps_heat_and_loses_unevenness(n_nodes: int, seed: int) -> None:
    """Paper A, eqs. 5 to 11, along a whole trajectory: H stays, E never grows, however long the steps."""
    rng = np.random.default_rng(seed)
    network = build_network(
        load_spec(conductive_spec(n_nodes, [(int(rng.integers(0, i)), i) for i in range(1, n_nodes)]))
    )
    parameters = network.parameters
    network = network.with_parameters(parameters.at_free(parameters.free + rng.normal(0, 1.5, parameters.free.size)))
    capacity = network.parameters.values[network.capacity_index]
    time_s = np.cumsum(rng.uniform(1.0, 3000.0, 40))
    found = states(network, record_of(time_s), rng.uniform(200.0, 400.0, n_nodes))
    content = found @ capacity
    np.testing.assert_allclose(content, content[0], rtol=1e-9)
    mean = content[0] / capacity.sum()
    unevenness = 0.5 * (found - mean) ** 2 @ capacity
    assert (np.diff(unevenness) <= 1e-9 * unevenness[0] + 1e-6).all()


@settings(max_examples=8, deadline=None)
@given(n_nodes=st.integers(1, 6), seed=st.integers(0, 2**32 - 1))
def test_bounded_heat_keeps_every_rollout_bounded(n_nodes: int, seed: int) -> None:
    """No node gets hotter than the hottest start or than what radiates the largest heat away, nor colder than space.

    At the hottest node conduction takes heat out, so it rises only where its load exceeds sigma R T^4 (paper A, eqs. 9-11).
    """
    rng = np.random.default_rng(seed)
    edges = [(i, j) for i in range(n_nodes) for j in range(i + 1, n_nodes) if rng.random() < 0.6]
    area_m2, power_W = rng.uniform(0.1, 1.0), rng.uniform(0.0, 300.0, 40)
    fields = {
        "channels": {"Q": {"kind": "power", "unit": "W"}},
        "boundaries": {"space": {"value_K": 3.0}},
        "radiators": [
            {"node": f"n{i}", "emissivity": 1.0, "area_m2": area_m2, "sink": "space"} for i in range(n_nodes)
        ],
        "loads": [{"channel": "Q", "node": f"n{i}", "weight": 1.0 / n_nodes} for i in range(n_nodes)],
    }
    network = build_network(load_spec(conductive_spec(n_nodes, edges, **fields)))
    values = network.parameters.values
    values[network.parameters.free_index] *= np.exp(rng.normal(0.0, 1.0, network.parameters.free_index.size))
    start = rng.uniform(150.0, 350.0, n_nodes)
    record = record_of(600.0 * np.arange(40), Q=power_W)
    path = rollout(network, values, start, build_forcing(network, record, 20.0))
    hottest = max(start.max(), (power_W.max() / n_nodes / (5.670374419e-8 * area_m2)) ** 0.25)
    assert path.converged
    assert path.stages_K[:, 1].max() < 1.02 * hottest
    assert path.stages_K[:, 1].min() > 3.0


def test_a_single_node_without_heat_stays() -> None:
    network = build_network(load_spec(conductive_spec(1, [])))
    np.testing.assert_array_equal(states(network, record_of(60.0 * np.arange(5)), np.array([293.0])), 293.0)


def orbit(n_times: int) -> Record:
    time_s = 120.0 * np.arange(n_times)
    rng = np.random.default_rng(2)
    return Record(
        time_s,
        {
            "T_room": 290.0 + 3.0 * np.sin(time_s / 800.0),
            "Q_a": rng.choice([5.0, 40.0], n_times),
            "Q_sun": 60.0 * np.maximum(np.sin(time_s / 900.0), 0.0),
            "H": rng.uniform(0.0, 100.0, n_times),
            "pitch": 90.0 + 40.0 * np.sin(time_s / 2000.0),
            "mode": np.repeat(rng.integers(0, 3, n_times // 5 + 1), 5)[:n_times].astype(float),
        },
        epoch_ns=1_700_000_000_000_000_000,
    )


def all_sensitivities(network: Network, forcing: Forcing, path: Rollout) -> np.ndarray:
    n_free, n_nodes = network.parameters.free_index.size, len(network.nodes)
    columns = np.hstack([np.zeros((n_nodes, n_free)), np.eye(n_nodes)])
    observed = np.arange(n_nodes)
    parts = list(sensitivities(network, network.parameters.values, forcing, path, columns, observed))
    covered = np.concatenate([np.arange(forcing.sample_step.size)[where] for where, _ in parts])
    np.testing.assert_array_equal(covered, np.arange(forcing.sample_step.size))
    return np.concatenate([block for _, block in parts])


@pytest.mark.parametrize("name", [None, *REGISTRY])
def test_sensitivities_are_the_central_difference(name: str | None) -> None:
    """By every free parameter, unknown sink included, and by every initial temperature."""
    network = every_term_network([] if name is None else [active_effect(REGISTRY[name], 0.4)])
    record = orbit(25)
    if network.dated is not None:  # the effect knows instants of a record that begins at zero
        network, record = replace(network, dated=True), replace(record, epoch_ns=0)
    n_nodes, free = len(network.nodes), network.parameters.free
    start = np.linspace(275.0, 295.0, n_nodes)
    forcing = build_forcing(network, record, 90.0)

    def end(unknowns: np.ndarray) -> np.ndarray:
        path = rollout(network, network.parameters.to_values(unknowns[: free.size]), unknowns[free.size :], forcing)
        assert path.converged
        return path.at_samples(forcing.sample_step)

    path = rollout(network, network.parameters.values, start, forcing)
    found = all_sensitivities(network, forcing, path)
    unknowns = np.concatenate([free, start])
    for column in range(unknowns.size):

        def moved(x: float, column: int = column) -> np.ndarray:
            at = unknowns.copy()
            at[column] = x
            return end(at)

        step = 1e-3 * max(1.0, 0.1 * abs(float(unknowns[column])))
        expected = central_difference(moved, float(unknowns[column]), step)
        scale = max(float(np.abs(expected).max()), 1e-3)
        # Couplings come to rest within 1e-10 K. Newton stops at 1e-7 K, usually far below: a difference over 1e-3 resolves
        # 1e-5 of the largest response.
        share = 1e-6 if name is None else 2e-5
        np.testing.assert_allclose(found[:, :, column], expected, atol=share * scale, err_msg=f"column {column}")


def test_sensitivities_go_on_across_stretches() -> None:
    """Beyond 9216 steps the derivatives are handed over from one stretch to the next."""
    network = chain()
    record = record_of(2400.0 * np.arange(8), Q=np.where(np.arange(8) % 3 < 1, 60.0, 0.0))
    fine = build_forcing(network, record, 1.5)
    assert fine.n_steps > 9216
    path = rollout(network, network.parameters.values, START_K, fine)
    found = all_sensitivities(network, fine, path)
    free = network.parameters.free
    for column in range(free.size):

        def end(x: float, column: int = column) -> np.ndarray:
            at = free.copy()
            at[column] = x
            named = dict(zip(network.parameters.index, network.parameters.to_values(at), strict=True))
            rates = -laplacian(3, [(0, 1), (1, 2)], [named["G:n0|n1"], named["G:n1|n2"]])
            capacity = np.array([named[f"C:n{i}"] for i in range(3)])
            drive = np.outer(record.values["Q"], [1.0 / capacity[0], 0.0, 0.0])
            return linear_states(rates / capacity[:, None], drive, START_K, record.time_s)

        expected = central_difference(end, float(free[column]), 1e-3)
        np.testing.assert_allclose(found[:, :, column], expected, atol=1e-5 * float(np.abs(expected).max()))
