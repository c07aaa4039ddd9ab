"""The heat balance: derivatives of every term and effect against central differences, and the laws of energy."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.analytic import laplacian
from tests.helpers import active_effect, central_difference, conductive_spec, every_term_network, points
from twin_core.effects import REGISTRY
from twin_core.network.dynamics import Balance, evaluate_balance, fill_boundaries
from twin_core.network.model import Network, build_network
from twin_core.network.spec_io import load_spec
from twin_core.network.terms import Along

N_POINTS = 60
OTHER_SEED = 1
"""Not the points that the effects start from: a set-point lies on one of those."""


def with_effect(name: str | None) -> Network:
    return every_term_network() if name is None else every_term_network([active_effect(REGISTRY[name])])


def balance_at(network: Network, along: Along, values: np.ndarray, *, derivatives: bool = False) -> Balance:
    filled = replace(along, boundaries_K=fill_boundaries(network, values, along.boundaries_K))
    return evaluate_balance(network, values, filled, derivatives=derivatives)


def assert_slope(found: np.ndarray, rates: Callable[[float], np.ndarray], at: float, step: float, name: str) -> None:
    """Assert that (n_points, n_nodes) slopes are the central difference, but at points with a kink within the step."""
    coarse, fine = central_difference(rates, at, step), central_difference(rates, at, step / 3.0)
    # Rates are of 1e-2 K/s: a step h resolves their slopes to 1e-16 * 1e-2 / h, taken a hundredfold.
    atol = 1e-16 / step + 1e-7 * float(np.abs(coarse).max())
    smooth = (np.abs(coarse - fine) <= 1e-6 * np.abs(fine) + atol).all(axis=1)
    assert smooth.mean() > 0.9, f"{name}: the slope is not defined at {np.flatnonzero(~smooth)}"
    np.testing.assert_allclose(found[smooth], fine[smooth], rtol=1e-6, atol=atol, err_msg=name)


each_network = pytest.mark.parametrize("name", [None, *REGISTRY])


@each_network
def test_the_jacobian_is_the_central_difference(name: str | None) -> None:
    """Of the rates summed over the two points of each step, one of them moved: a relay shares its heat out over both."""
    network = with_effect(name)
    along = points(network, N_POINTS, OTHER_SEED)
    values = network.parameters.values
    jacobian = balance_at(network, along, values).jacobian_per_s
    for node, end in product(range(len(network.nodes)), (0, 1)):

        def rates(shift_K: float, node: int = node, end: int = end) -> np.ndarray:
            moved = along.temperatures_K.copy()
            moved[end::2, node] += shift_K
            rate = balance_at(network, replace(along, temperatures_K=moved), values).rate_K_per_s
            return rate[0::2] + rate[1::2]

        assert_slope(jacobian[end::2, :, node], rates, 0.0, 1e-2, f"{network.nodes[node]} at end {end}")


@each_network
def test_parameter_entries_are_the_central_difference(name: str | None) -> None:
    network = with_effect(name)
    along = points(network, N_POINTS, OTHER_SEED)
    free = network.parameters.free
    balance = balance_at(network, along, network.parameters.values, derivatives=True)
    found = np.zeros((N_POINTS, len(network.nodes), free.size))
    for column, node, series in zip(balance.entry_free, balance.entry_node, balance.entry_series, strict=True):
        found[:, node, column] += series
    for column in range(free.size):

        def rates(x: float, column: int = column) -> np.ndarray:
            moved = free.copy()
            moved[column] = x
            balance = balance_at(network, along, network.parameters.to_values(moved))
            return balance.heat_W / balance.own_J_per_K

        step = 1e-3 * max(1.0, 1e-1 * abs(float(free[column])))
        assert_slope(found[:, :, column], rates, float(free[column]), step, network.parameters.free_names[column])


def test_an_unknown_boundary_is_filled_and_derived() -> None:
    network = every_term_network()
    along = points(network, 3)
    values = network.parameters.values
    filled = fill_boundaries(network, values, along.boundaries_K)
    np.testing.assert_array_equal(filled[:, :2], along.boundaries_K[:, :2])
    np.testing.assert_array_equal(filled[:, 2], 255.0)
    assert (
        network.parameters.free_names.index("T:sink") in balance_at(network, along, values, derivatives=True).entry_free
    )


def test_extra_heat_meets_the_capacity_like_any_other() -> None:
    network = every_term_network()
    along = points(network, 4)
    along = replace(along, boundaries_K=fill_boundaries(network, network.parameters.values, along.boundaries_K))
    extra = np.arange(12.0).reshape(4, 3)
    with_extra = evaluate_balance(network, network.parameters.values, along, extra_W=extra)
    without = evaluate_balance(network, network.parameters.values, along)
    capacity = network.parameters.values[network.capacity_index]
    np.testing.assert_allclose(with_extra.rate_K_per_s - without.rate_K_per_s, extra / capacity, rtol=1e-10)
    np.testing.assert_allclose(with_extra.heat_W, without.heat_W + extra, rtol=1e-12)


@settings(max_examples=30, deadline=None)
@given(n_nodes=st.integers(1, 6), seed=st.integers(0, 2**32 - 1))
def test_conduction_conserves_heat_and_dissipates(n_nodes: int, seed: int) -> None:
    """Paper A, eqs. 5 to 11: H = sum C T stays, E = T'CT/2 falls by the squared differences over every conductor."""
    rng = np.random.default_rng(seed)
    edges = [(int(rng.integers(0, i)), i) for i in range(1, n_nodes)]
    network = build_network(load_spec(conductive_spec(n_nodes, edges)))
    network = network.with_parameters(
        network.parameters.at_free(network.parameters.free + rng.normal(0, 2, network.parameters.free.size))
    )
    values = network.parameters.values
    temperatures = rng.uniform(150.0, 450.0, (5, n_nodes))
    along = Along(np.arange(5.0), temperatures, np.zeros((5, 0)), {}, np.ones(5))
    balance = evaluate_balance(network, values, along)
    capacity = values[network.capacity_index]
    assert np.abs((balance.rate_K_per_s * capacity).sum(axis=1)).max() <= 1e-10 * (1.0 + np.abs(balance.heat_W).max())
    conductance = [network.parameters.as_dict()[f"G:n{a}|n{b}"] for a, b in edges]
    dissipation = -np.einsum("ki,ij,kj->k", temperatures, laplacian(n_nodes, edges, conductance), temperatures)
    falls = (temperatures * capacity * balance.rate_K_per_s).sum(axis=1)
    # T'LT sums terms of 450^2 G that cancel: absolute rounding of that size.
    np.testing.assert_allclose(falls, dissipation, rtol=1e-9, atol=1e-10 * 450.0**2 * (sum(conductance) + 1.0))
    assert (dissipation <= 1e-10 * 450.0**2 * (sum(conductance) + 1.0)).all()


def test_equal_temperatures_exchange_nothing() -> None:
    network = build_network(load_spec(conductive_spec(3, [(0, 1), (1, 2)])))
    along = Along(np.zeros(1), np.full((1, 3), 290.0), np.zeros((1, 0)), {}, np.ones(1))
    np.testing.assert_array_equal(evaluate_balance(network, network.parameters.values, along).rate_K_per_s, 0.0)
