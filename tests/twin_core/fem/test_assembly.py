"""Geometry, mesh and matrices: totals, symmetry, contacts in closed form."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.sparse.linalg import spsolve

from twin_core.fem.assembly import Assembler, assemble
from twin_core.fem.demo import demo_scenario
from twin_core.fem.field import Field
from twin_core.fem.geometry import lay_grid
from twin_core.fem.scenario import Scenario, load_scenario

Maker = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def demo() -> tuple[Scenario, Field]:
    """The demonstration's scenario and field."""
    scenario = demo_scenario("none", 0)[0]
    return scenario, assemble(scenario)


def test_grid_lines_hold_every_edge_and_no_cell_is_too_large() -> None:
    """Awkward rectangles: all edges are lines, cells at most the size, later regions win."""
    boxes = {"a": ((0.0, 1.0), (0.0, 0.7)), "b": ((0.31, 0.62), (0.1, 0.4))}
    grid = lay_grid(boxes, 0.25)
    for (x_low, x_high), (y_low, y_high) in boxes.values():
        assert {x_low, x_high} <= set(grid.x_m) and {y_low, y_high} <= set(grid.y_m)
    assert np.diff(grid.x_m).max() <= 0.25 + 1e-12
    areas = np.outer(np.diff(grid.x_m), np.diff(grid.y_m))
    assert areas[grid.region == 1].sum() == pytest.approx(0.31 * 0.3)
    assert areas[grid.region == 0].sum() == pytest.approx(0.7 - 0.31 * 0.3)
    assert grid.touching() == {frozenset("ab")}


def test_bodies_are_split_at_joints_and_nowhere_else(demo: tuple[Scenario, Field]) -> None:
    """Every region of the demonstration is a body of its own; a plate with inclusions is one body."""
    from scipy.sparse.csgraph import connected_components

    scenario, _ = demo
    conduction = Assembler(scenario).bulk()[1]
    assert connected_components(conduction, directed=False)[0] == len(scenario.regions)


def test_capacity_and_radiating_area_are_those_of_the_drawing(demo: tuple[Scenario, Field]) -> None:
    """Volume times density times specific heat; length times depth times emissivity."""
    scenario, field = demo
    for region in scenario.regions:
        by_hand = region.area_m2 * scenario.depth_m * scenario.material(region).heat_capacity_J_per_m3_K
        assert field.capacity_J_per_K[region.id] == pytest.approx(by_hand)
    assert field.capacity_matrix.sum() == pytest.approx(sum(field.capacity_J_per_K.values()))
    uniform, space = np.full((field.n_unknowns, 1), 300.0), np.array([[0.0], [0.0]])
    emitted_W = -field.radiation.heat_W(uniform, space).sum()
    exchange_m2 = scenario.depth_m * (0.8 * 0.72 + 0.8 * 0.68 + 0.95 * 0.75)
    assert emitted_W == pytest.approx(5.670374419e-8 * exchange_m2 * 300.0**4)


def test_matrices_are_symmetric_and_conduction_keeps_heat(demo: tuple[Scenario, Field]) -> None:
    """M and K are symmetric; without couplings K has no net heat at uniform temperature; each watt is spread once."""
    scenario, field = demo
    for matrix in (field.capacity_matrix, field.conductance_matrix):
        assert abs(matrix - matrix.T).max() < 1e-9 * abs(matrix).max()
    lost_W = field.conductance_matrix @ np.ones(field.n_unknowns)
    coupled = sum(coupling.conductance_W_per_K for coupling in scenario.couplings)
    assert lost_W.sum() == pytest.approx(coupled)
    np.testing.assert_allclose(field.inputs.sum(axis=0)[:7], 1.0)
    np.testing.assert_allclose(field.ownership.sum(axis=0), 1.0)


def test_region_means_and_points_read_a_linear_field_exactly(two_plates: Maker) -> None:
    """T = 280 + 10 x + 5 y: the mean is the value at the centre, a point its own value."""
    sensors = [{"channel": "mean", "region": "b"}, {"channel": "point", "at_m": [0.26, 0.03]}]
    scenario = load_scenario(two_plates(sensors=sensors))
    x, y = Assembler(scenario).split.mesh.p
    readings = assemble(scenario).readings @ (280.0 + 10.0 * x + 5.0 * y)
    np.testing.assert_allclose(readings, [280.0 + 10.0 * 0.2 + 5.0 * 0.1, 280.0 + 10.0 * 0.26 + 5.0 * 0.03])


@pytest.mark.parametrize("link", ["joint", "strap"])
def test_two_slabs_in_series_in_closed_form(two_plates: Maker, link: str) -> None:
    """Heat through slab, contact and slab: the temperature falls by q L / k, q / h and q L / k."""
    heat_W, conductance = 30.0, 12.0
    material = {"conductivity_W_per_m_K": 40.0, "density_kg_per_m3": 1.0, "specific_heat_J_per_kg_K": 1.0}
    body = two_plates(
        materials={"ideal": material},
        radiators=[],
        couplings=[{"place": "b.right", "boundary": "room", "conductance_W_per_K": 1e6}],
        loads=[{"forcing": "Q", "place": "a.left"}],
        sensors=[{"channel": "hot", "at_m": [0.0, 0.1]}, {"channel": "cold", "at_m": [0.3, 0.1]}],
        mesh_size_m=0.02,
    )
    if link == "joint":
        body["joints"] = [{"between": ["a", "b"], "conductance_W_per_m2_K": conductance / 0.2}]
    else:
        body["joints"] = [{"between": ["a", "b"], "conductance_W_per_m2_K": 0.0}]
        body["straps"] = [{"between": ["a", "b"], "conductance_W_per_K": conductance}]
    body["regions"] = body["regions"][:2]
    field = assemble(load_scenario(body))
    right = field.inputs[:, 0] * heat_W + field.boundary_inputs[:, 1] * 300.0
    hot, cold = field.readings @ spsolve(field.conductance_matrix, right)
    slabs_K = heat_W * (0.1 + 0.2) / (40.0 * 0.2)
    # The strap joins means: heat leaves one slab and enters the other evenly, so that each mean lies a third of
    # q L / k from the end (to the second order of the 20 mm cells).
    expected_K = heat_W / conductance + (slabs_K if link == "joint" else slabs_K / 3.0)
    assert hot - cold == pytest.approx(expected_K, rel=1e-3 if link == "strap" else 1e-6)
    assert cold == pytest.approx(300.0, abs=1e-3)


def test_a_perfect_contact_is_the_limit_of_a_good_joint(two_plates: Maker) -> None:
    """A joint of 1e9 W/m2/K conducts as regions that share their nodes do."""
    material = {"conductivity_W_per_m_K": 10.0, "density_kg_per_m3": 1.0, "specific_heat_J_per_kg_K": 1.0}
    totals = []
    for joints in ([], [{"between": ["a", "b"], "conductance_W_per_m2_K": 1e9}]):
        body = two_plates(materials={"ideal": material}, joints=joints, radiators=[])
        body["regions"], body["sensors"] = body["regions"][:2], body["sensors"][:2]
        field = assemble(load_scenario(body))
        right = field.inputs[:, 0] * 7.0 + field.boundary_inputs[:, 1] * 300.0
        totals.append(field.readings @ spsolve(field.conductance_matrix, right))
    np.testing.assert_allclose(totals[0], totals[1], atol=1e-4)
