"""Terms of the heat balance against hand calculation, and what every table must keep."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.analytic import SIGMA, laplacian
from twin_core.network.terms import (
    Along,
    BoundaryConductor,
    ChannelLoad,
    Conductors,
    SinkRadiation,
    SteeredTable,
    TableLoad,
    pair_jacobian,
    table_basis,
)
from twin_core.parameters.parameter import positive, real

ALONG = Along(
    time_s=np.array([0.0, 60.0]),
    temperatures_K=np.array([[300.0, 280.0, 290.0], [310.0, 285.0, 260.0]]),
    boundaries_K=np.array([[4.0, 295.0], [4.0, 250.0]]),
    inputs={"Q": np.array([10.0, 40.0]), "x": np.array([1.0, 2.5])},
    sun_factor=np.array([1.0, 0.9]),
)


def test_conductors_are_the_negative_laplacian() -> None:
    edges, conductance = [(0, 1), (2, 1), (0, 2)], [2.0, 0.5, 1.25]
    parameters = tuple(positive(f"G{i}", "W/K", g) for i, g in enumerate(conductance))
    heat = Conductors(tuple(edges), parameters, 3).evaluate(ALONG, np.array(conductance))
    expected = laplacian(3, edges, conductance)
    np.testing.assert_allclose(heat.d_temperature[0], -expected, rtol=1e-14)
    np.testing.assert_allclose(heat.heat_W, -ALONG.temperatures_K @ expected, rtol=1e-12)


@given(
    n_nodes=st.integers(2, 7),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_laplacian_is_symmetric_and_its_rows_add_to_zero(n_nodes: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pairs = tuple((int(rng.integers(0, i)), i) for i in range(1, n_nodes))
    conductance = np.exp(rng.uniform(-5.0, 5.0, len(pairs)))
    parameters = tuple(positive(f"G{i}", "W/K", g) for i, g in enumerate(conductance))
    along = Along(np.zeros(1), rng.uniform(200, 400, (1, n_nodes)), np.zeros((1, 0)), {}, np.ones(1))
    heat = Conductors(pairs, parameters, n_nodes).evaluate(along, conductance)
    matrix = heat.d_temperature[0]
    np.testing.assert_array_equal(matrix, matrix.T)
    assert np.abs(matrix.sum(axis=1)).max() <= 1e-12 * np.abs(matrix).max()
    assert np.linalg.eigvalsh(-matrix).min() >= -1e-12 * np.abs(matrix).max()  # positive semidefinite (paper A, 4.4)
    assert abs(heat.heat_W.sum()) <= 1e-12 * np.abs(heat.heat_W).sum()


def test_a_boundary_conductor_follows_the_difference() -> None:
    heat = BoundaryConductor(2, 1, (positive("G", "W/K", 3.0),)).evaluate(ALONG, np.array([3.0]))
    np.testing.assert_allclose(heat.heat_W[:, 0], [3.0 * 5.0, 3.0 * -10.0])
    assert heat.nodes == (2,)
    assert [(e.item, e.node) for e in heat.d_boundaries] == [(1, 2)]


def test_radiation_by_the_fourth_power() -> None:
    heat = SinkRadiation(0, 0, (positive("R", "m2", 0.5),)).evaluate(ALONG, np.array([0.5]))
    np.testing.assert_allclose(heat.heat_W[:, 0], SIGMA * 0.5 * (4.0**4 - np.array([300.0, 310.0]) ** 4), rtol=1e-14)


@pytest.mark.parametrize("temperature_K", [0.0, 1.0, 400.0])
def test_radiation_at_its_sinks_temperature_is_nothing(temperature_K: float) -> None:
    same = Along(np.zeros(1), np.full((1, 1), temperature_K), np.full((1, 1), temperature_K), {}, np.ones(1))
    assert SinkRadiation(0, 0, ()).evaluate(same, np.array([2.0])).heat_W[0, 0] == 0.0


@pytest.mark.parametrize(("solar", "expected"), [(False, [3.0, 12.0]), (True, [3.0, 10.8])])
def test_a_load_takes_its_gain_weight_and_sun(solar: bool, expected: list[float]) -> None:
    load = ChannelLoad(1, "Q", 0.6, solar, (positive("gain", "", 0.5),))
    np.testing.assert_allclose(load.evaluate(ALONG, np.array([0.5])).heat_W[:, 0], expected)


def test_a_table_interpolates_its_values() -> None:
    values = (real("f0", "W", 0.0), real("f1", "W", 0.0), real("f2", "W", 0.0))
    table = TableLoad(0, "x", (0.0, 2.0, 3.0), False, 1.0, False, values)
    heat = table.evaluate(ALONG, np.array([10.0, 20.0, 50.0])).heat_W[:, 0]
    np.testing.assert_allclose(heat, np.interp([1.0, 2.5], [0.0, 2.0, 3.0], [10.0, 20.0, 50.0]))


knot_lists = st.lists(st.integers(-40, 40), min_size=1, max_size=6, unique=True).map(sorted)


@given(knots=knot_lists, x=st.lists(st.floats(-60.0, 60.0), min_size=1, max_size=20), levels=st.booleans())
def test_a_table_basis_is_a_partition_of_unity(knots: list[int], x: list[float], levels: bool) -> None:
    basis = table_basis(np.array(x), tuple(map(float, knots)), levels)
    np.testing.assert_allclose(basis.sum(axis=1), 1.0, rtol=1e-12)
    assert basis.min() >= 0.0
    assert np.count_nonzero(basis, axis=1).max() <= (1 if levels else 2)


@given(knots=knot_lists, x=st.lists(st.floats(-60.0, 60.0), min_size=2, max_size=2), levels=st.booleans())
def test_a_table_is_the_same_without_its_derivatives(knots: list[int], x: list[float], levels: bool) -> None:
    own = tuple(map(float, knots))
    values = np.cos(np.array(own))
    along = replace(ALONG, inputs={"x": np.array(x), "mode": np.array([0.1, 0.9])})
    parameters = tuple(real(f"f{i}", "W", 0.0) for i in range(len(own)))
    for table in (
        TableLoad(0, "x", own, levels, 0.5, True, parameters),
        TableLoad(0, "x", own, levels, 0.5, True, parameters, visits=tuple(np.full(len(own), 1.0 / len(own)))),
        SteeredTable(0, "x", own, levels, 0.5, True, parameters, (), None, (1.0,) * len(own), "mode", (0.0, 1.0)),
    ):
        told = table.evaluate(along, values)
        told_alone = table.evaluate(replace(along, derivatives=False), values)
        np.testing.assert_allclose(told_alone.heat_W, told.heat_W, rtol=1e-12, atol=1e-12)
        of_entries = sum(entry.series * values[entry.item] for entry in told.d_values)
        np.testing.assert_allclose(of_entries, told.heat_W[:, 0], rtol=1e-12, atol=1e-12)


@given(knots=knot_lists)
def test_a_table_basis_is_the_identity_at_its_knots(knots: list[int]) -> None:
    at = np.array(knots, dtype=np.float64)
    for levels in (False, True):
        np.testing.assert_allclose(table_basis(at, tuple(at), levels), np.eye(at.size), atol=1e-12)


def test_a_hat_function_reproduces_a_straight_line() -> None:
    knots = (-1.0, 0.5, 4.0)
    x = np.linspace(-1.0, 4.0, 41)
    np.testing.assert_allclose(table_basis(x, knots, False) @ np.array(knots), x, atol=1e-12)


def test_what_one_end_gains_the_other_loses() -> None:
    block = pair_jacobian(np.array([-2.0, -3.0]), np.array([2.0, 5.0]))
    assert block.shape == (2, 2, 2)
    np.testing.assert_array_equal(block.sum(axis=1), np.zeros((2, 2)))
