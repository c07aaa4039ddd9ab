"""The split balance against the whole one; A against its modes."""

import numpy as np
import pytest

from tests.helpers import active_effect, every_term_network
from twin_core.effects import REGISTRY
from twin_core.network.storage import to_enthalpy_K
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.splitting import FAR_K, Split, anchors, modes_of, symmetric
from twin_core.simulate.stages import balance_along
from twin_core.telemetry import Record


def record() -> Record:
    rng = np.random.default_rng(6)
    values = {
        "T_room": 290.0 + rng.normal(0, 2, 30),
        "Q_a": rng.uniform(0, 50, 30),
        "Q_sun": rng.uniform(0, 90, 30),
        "H": rng.uniform(0, 100, 30),
        "pitch": rng.uniform(40, 140, 30),
        "mode": rng.integers(0, 3, 30).astype(float),
    }
    return Record(np.cumsum(rng.uniform(30.0, 200.0, 30)), values, epoch_ns=0)


@pytest.mark.parametrize("name", [None, "radiative_exchange", "missing_conductor", "sensor_lag", "input_gain"])
def test_the_parts_add_up_to_the_balance(name: str | None) -> None:
    """A T + given + r(T) is the rate at any temperatures, whatever A was linearised about."""
    network = every_term_network([] if name is None else [active_effect(REGISTRY[name], 0.4)])
    values, forcing = network.parameters.values, build_forcing(network, record(), 60.0)
    about_K = np.full(len(network.nodes), 283.15)
    at_K = np.random.default_rng(0).uniform(200.0, 400.0, (forcing.n_steps, 2, about_K.size))
    split = Split.at(network, values, forcing, 0, forcing.n_steps, about_K)
    assert not split.others
    left, rate = split.remainder(None, at_K, 0, forcing.n_steps)
    rate = rate + at_K @ (split.modes.outward * split.modes.rate_per_s @ split.modes.inward).T
    for row, column, factor in zip(left.row, left.column, left.linear, strict=True):
        rate[:, :, row] += factor * at_K[:, :, column]
    for row, column, factor in zip(left.fourth_row, left.fourth_column, left.fourth, strict=True):
        rate[:, :, row] += factor * at_K[:, :, column] ** 4
    whole = balance_along(network, values, forcing, at_K, 0, forcing.n_steps)
    np.testing.assert_allclose(rate.reshape(whole.heat_W.shape), whole.heat_W / whole.own_J_per_K, atol=1e-9)


@pytest.mark.parametrize("name", ["nonlinear_convection", "latent_heat", "conductance_temperature"])
def test_other_terms_are_linearised_where_the_trajectory_is(name: str) -> None:
    network = every_term_network([active_effect(REGISTRY[name], 0.4)])
    values, forcing = network.parameters.values, build_forcing(network, record(), 60.0)
    about_K = np.full(len(network.nodes), 283.15)
    at_K = np.random.default_rng(0).uniform(270.0, 300.0, (forcing.n_steps, 2, about_K.size))
    split = Split.at(network, values, forcing, 0, forcing.n_steps, about_K)
    u = to_enthalpy_K(network, values, at_K)
    left, rate = split.remainder(split.beside(at_K, 0, forcing.n_steps), u, 0, forcing.n_steps)
    rate = rate + u @ (split.modes.outward * split.modes.rate_per_s @ split.modes.inward).T
    for row, column, factor in zip(left.row, left.column, left.linear, strict=True):
        rate[:, :, row] += factor * u[:, :, column]
    for row, column, factor in zip(left.fourth_row, left.fourth_column, left.fourth, strict=True):
        rate[:, :, row] += factor * u[:, :, column] ** 4
    for e, (row, column) in enumerate(zip(left.moving_row, left.moving_column, strict=True)):
        rate[:, :, row] += left.moving[:, :, e] * u[:, :, column]
    whole = balance_along(network, values, forcing, at_K, 0, forcing.n_steps)
    np.testing.assert_allclose(rate.reshape(whole.heat_W.shape), whole.heat_W / whole.own_J_per_K, atol=1e-9)


def test_the_symmetric_part_is_the_weaker_direction() -> None:
    coupling = np.array([[-5.0, 2.0, 0.0], [3.0, -4.0, 0.0], [1.0, 0.0, -1.0]])
    np.testing.assert_array_equal(symmetric(coupling), [[-5.0, 2.0, 0.0], [2.0, -4.0, 0.0], [0.0, 0.0, -1.0]])
    np.testing.assert_array_equal(symmetric(2.0 * coupling, coupling), 2.0 * symmetric(coupling))


def test_modes_are_those_of_a() -> None:
    rng = np.random.default_rng(1)
    pairs = np.triu(rng.uniform(0.0, 5.0, (6, 6)), 1)
    slope = pairs + pairs.T - np.diag((pairs + pairs.T).sum(axis=0))
    capacity = 10.0 ** rng.uniform(-4.0, 6.0, 6)
    modes = modes_of(slope, capacity)
    np.testing.assert_allclose(modes.outward @ modes.inward, np.eye(6), atol=1e-9)
    scaled = np.sqrt(capacity)[:, None] * (modes.outward * modes.rate_per_s @ modes.inward) / np.sqrt(capacity)
    np.testing.assert_allclose(scaled, slope / np.sqrt(np.outer(capacity, capacity)), atol=1e-9 * np.abs(scaled).max())


def test_a_is_renewed_where_temperatures_have_moved() -> None:
    begins = np.concatenate(
        [np.full((1024, 1), 291.0), np.full((8192, 1), 300.0), np.full((500, 1), 291.0 + 2.0 * FAR_K)]
    )
    found = [(first, last, float(about[0])) for first, last, about in anchors(begins)]
    assert found == [(0, 1024, 293.15), (1024, 9216, 293.15), (9216, 9716, 333.15)]
