"""Time schemes and assembly against manufactured solutions, energy balance and closed forms."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from skfem import Basis, ElementQuad1, FacetBasis, LinearForm, MeshQuad

from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4
from twin_core.fem import stepping
from twin_core.fem.assembly import Assembler, assemble
from twin_core.fem.field import Field
from twin_core.fem.scenario import Scenario, load_scenario
from twin_core.fem.stepping import SCHEMES, Drive

CONDUCTIVITY, CAPACITY, EMISSIVITY = 40.0, 2.0e5, 0.8
MEAN_K, SWING_K, PERIOD_S = 300.0, 30.0, 4000.0


def unit_square(size_m: float, **changes: object) -> Scenario:
    """Return a square metre of one material that radiates to 3 K on all sides."""
    body = {
        "scenario": "square",
        "mesh_size_m": size_m,
        "initial_K": MEAN_K,
        "time": {"duration_s": 600, "step_s": 10, "sample_s": 10},
        "materials": {
            "plain": {
                "conductivity_W_per_m_K": CONDUCTIVITY,
                "density_kg_per_m3": 200.0,
                "specific_heat_J_per_kg_K": CAPACITY / 200.0,
            }
        },
        "regions": [{"id": "plate", "x_m": [0, 1], "y_m": [0, 1], "material": "plain"}],
        "boundaries": {"space": {"value_K": 3.0}},
        "radiators": [{"surface": "plate.all", "emissivity": EMISSIVITY, "sink": "space"}],
        "sensors": [{"channel": "T", "region": "plate"}],
    }
    return load_scenario(body | changes)


def shape(x: np.ndarray) -> np.ndarray:
    """The manufactured field's shape: no normal slope on any side of the unit square."""
    return np.cos(np.pi * x[0]) * np.cos(np.pi * x[1])


def manufactured(size_m: float) -> tuple[Field, np.ndarray]:
    """Return a field whose inputs produce T = MEAN + s(t) shape, and the shape at its nodes.

    The heat that must come in is c s'(t) shape + 2 pi^2 k s(t) shape in the bulk, and sigma eps (T^4 - T_s^4) on the
    boundary; the fourth power is expanded in powers of the shape, each of them one input.
    """
    scenario = unit_square(size_m)
    field, mesh = assemble(scenario), Assembler(scenario).split.mesh
    bulk, rim = Basis(mesh, ElementQuad1(), intorder=8), FacetBasis(mesh, ElementQuad1(), intorder=12)
    columns = [LinearForm(lambda v, w: shape(w.x) * v).assemble(bulk)]
    columns += [LinearForm(lambda v, w, n=n: shape(w.x) ** n * v).assemble(rim) for n in range(5)]
    return replace(field, inputs=np.stack(columns, axis=1)), shape(mesh.p)


def manufactured_inputs(time_s: float) -> np.ndarray:
    """Return the values of the six inputs, (6, 1)."""
    angle = 2.0 * np.pi / PERIOD_S
    swing, rate = SWING_K * np.sin(angle * time_s), SWING_K * angle * np.cos(angle * time_s)
    bulk = CAPACITY * rate + 2.0 * np.pi**2 * CONDUCTIVITY * swing
    powers = [1, 4, 6, 4, 1]
    rim = [STEFAN_BOLTZMANN_W_PER_M2_K4 * EMISSIVITY * c * MEAN_K ** (4 - n) * swing**n for n, c in enumerate(powers)]
    rim[0] -= STEFAN_BOLTZMANN_W_PER_M2_K4 * EMISSIVITY * 3.0**4
    return np.array([bulk, *rim])[:, None]


def manufactured_gap_K(scheme: str, size_m: float, step_s: float, stop_s: float = 2000.0) -> float:
    """Return the largest nodal distance from the manufactured solution at three quarters of its swing."""
    field, nodal_shape = manufactured(size_m)
    runner = SCHEMES[scheme](field, step_s, field.start_K)
    temperature_K = field.start_K[:, None]
    for n in range(round(stop_s * 0.75 / step_s)):
        at = [manufactured_inputs((n + fraction) * step_s) for fraction in runner.stage_fractions]
        drive = Drive(np.stack(at), np.full((len(at), 1, 1), 3.0))
        temperature_K = runner.step(n * step_s, temperature_K, drive)
    exact = MEAN_K + SWING_K * np.sin(2.0 * np.pi / PERIOD_S * 0.75 * stop_s) * nodal_shape
    return float(np.abs(temperature_K[:, 0] - exact).max())


def test_second_order_in_space() -> None:
    """Bilinear elements: halving the cells quarters the distance; the step is too small to matter."""
    coarse, fine = (manufactured_gap_K("sdirk2", size, 5.0) for size in (1 / 6, 1 / 12))
    assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.15)


@pytest.mark.parametrize(("scheme", "order"), [("sdirk2", 2.0), ("imex", 1.0)])
def test_measured_order_in_time(scheme: str, order: float) -> None:
    """On one mesh, differences between three step sizes shrink by 2^order; the space part cancels in them."""
    field_gap = [run_to_K(scheme, step) for step in (300.0, 150.0, 75.0)]
    first, second = (np.abs(a - b).max() for a, b in itertools.pairwise(field_gap))
    assert np.log2(first / second) == pytest.approx(order, abs=0.25)


def run_to_K(scheme: str, step_s: float, stop_s: float = 3000.0) -> np.ndarray:
    """Return the manufactured run's temperatures at ``stop_s``."""
    field, _ = manufactured(1 / 4)
    runner = SCHEMES[scheme](field, step_s, field.start_K)
    temperature_K = field.start_K[:, None]
    for n in range(round(stop_s / step_s)):
        at = [manufactured_inputs((n + fraction) * step_s) for fraction in runner.stage_fractions]
        temperature_K = runner.step(n * step_s, temperature_K, Drive(np.stack(at), np.full((len(at), 1, 1), 3.0)))
    return temperature_K[:, 0]


def test_imex_and_default_meet_a_fine_reference() -> None:
    """Both schemes approach the same solution; the second-order one is far closer at the same step."""
    reference = run_to_K("sdirk2", 5.0)
    default, imex = (np.abs(run_to_K(scheme, 60.0) - reference).max() for scheme in ("sdirk2", "imex"))
    assert default < 0.02
    assert default < imex / 20.0 < 1.0


@pytest.mark.parametrize("scheme", ["sdirk2", "imex"])
def test_heat_balance_closes_every_step(scheme: str) -> None:
    """Stored heat equals the heat that came in, to 1e-9 of what moved."""
    field, _ = manufactured(1 / 6)
    runner = SCHEMES[scheme](field, 30.0, field.start_K)
    temperature_K = field.start_K[:, None]
    for n in range(40):
        at = [manufactured_inputs((n + fraction) * 30.0) for fraction in runner.stage_fractions]
        after = runner.step(n * 30.0, temperature_K, Drive(np.stack(at), np.full((len(at), 1, 1), 3.0)))
        stored_J = field.capacity_matrix.sum(axis=0) @ (after - temperature_K)
        moved_J = np.abs(field.capacity_matrix @ (after - temperature_K)).sum()
        assert abs(stored_J - runner.heat_in_J).max() < 1e-9 * moved_J
        temperature_K = after


@pytest.mark.parametrize("scheme", ["sdirk2", "imex"])
def test_radiative_equilibrium_in_closed_form(scheme: str) -> None:
    """A plate so conductive that it is uniform comes to rest where sigma eps A T^4 equals heat plus sink.

    The IMEX scheme as printed takes T^4 as T_old^3 T, so at rest it meets the same equation.
    """
    scenario = unit_square(0.5)
    field = assemble(scenario)
    field = replace(field, conductance_matrix=field.conductance_matrix * 1e6, inputs=field.share["plate"][:, None])
    runner = SCHEMES[scheme](field, 2000.0, field.start_K)
    temperature_K, heat_W, sink_K = field.start_K[:, None], 900.0, 150.0
    stages = len(runner.stage_fractions)
    drive = Drive(np.full((stages, 1, 1), heat_W), np.full((stages, 1, 1), sink_K))
    for n in range(400):
        temperature_K = runner.step(n * 2000.0, temperature_K, drive)
    perimeter_m2 = 4.0
    expected_K = (heat_W / (STEFAN_BOLTZMANN_W_PER_M2_K4 * EMISSIVITY * perimeter_m2) + sink_K**4) ** 0.25
    assert temperature_K == pytest.approx(np.full_like(temperature_K, expected_K), abs=1e-4)


def test_insulated_mode_decays_as_the_exponential() -> None:
    """cos(pi x) cos(pi y) decays with 2 pi^2 k / c, an exact solution of the insulated plate."""
    scenario = unit_square(1 / 16, radiators=[])
    field, mesh = assemble(scenario), MeshQuad.init_tensor(np.linspace(0, 1, 17), np.linspace(0, 1, 17))
    assert mesh.p.shape[1] == field.n_unknowns
    nodal = shape(Assembler(scenario).split.mesh.p)
    runner = SCHEMES["sdirk2"](field, 2.0, field.start_K)
    temperature_K = (MEAN_K + SWING_K * nodal)[:, None]
    drive = Drive(np.zeros((2, 0, 1)), np.full((2, 1, 1), 3.0))
    for n in range(100):
        temperature_K = runner.step(n * 2.0, temperature_K, drive)
    exact = MEAN_K + SWING_K * nodal * np.exp(-2.0 * np.pi**2 * CONDUCTIVITY / CAPACITY * 200.0)
    # The mesh makes the mode decay too fast by (pi h)^2 / 12 per direction: 0.3 % of the exponent 0.79.
    assert temperature_K[:, 0] == pytest.approx(exact, abs=0.05)


def test_a_symmetric_problem_stays_symmetric() -> None:
    """Mirror and quarter turn of the square leave the solution as it is."""
    field, _ = manufactured(1 / 6)
    runner = SCHEMES["sdirk2"](field, 60.0, field.start_K)
    temperature_K, points = field.start_K[:, None], Assembler(unit_square(1 / 6)).split.mesh.p
    drive = Drive(np.zeros((2, 6, 1)), np.full((2, 1, 1), 3.0))
    for n in range(30):
        temperature_K = runner.step(n * 60.0, temperature_K, drive)
    by_place = {tuple(np.round(p, 6)): t for p, t in zip(points.T, temperature_K[:, 0], strict=True)}
    for (x, y), value in by_place.items():
        for image in ((1 - x, y), (x, 1 - y), (y, x)):
            assert by_place[tuple(np.round(image, 6))] == pytest.approx(value, abs=1e-8)
    assert np.ptp(temperature_K) > 0.5


def test_a_step_costs_a_few_back_substitutions(monkeypatch: pytest.MonkeyPatch) -> None:
    """One factorisation for the whole run, and at most three solves per stage on average."""
    counts = {"factorise": 0, "solve": 0}

    class Counting:
        def __init__(self, matrix: object) -> None:
            counts["factorise"] += 1
            self.solver = factorise(matrix)

        def solve(self, right: np.ndarray) -> np.ndarray:
            counts["solve"] += 1
            return self.solver.solve(right)

    factorise = stepping._factorise
    monkeypatch.setattr(stepping, "_factorise", Counting)
    run_to_K("sdirk2", 60.0)
    assert counts["factorise"] == 1
    assert counts["solve"] <= 3 * 2 * 50
