"""The approach to an optimum: thinned records, misfit weighed as noise."""

import numpy as np
import pytest

from tests.analytic import laplacian, linear_states
from tests.helpers import conductive_spec, record_of
from tests.twin_core.calibrate.test_calibrate import STEP_S, declared, exact_K, heat_W, telemetry
from twin_core.calibrate import calibrate
from twin_core.calibrate.approach import approach, coarse_problem, misfit_K, thinned
from twin_core.calibrate.optimise import minimise
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.calibrate.second_order import prepare
from twin_core.errors import TelemetryError
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec


def too_coarse() -> Problem:
    """A ring of eight masses of which the model knows every other one: no value of its parameters fits."""
    edges = [(i, (i + 1) % 8) for i in range(8)]
    rng = np.random.default_rng(2)
    capacity, conductance = rng.uniform(2e3, 9e3, 8), rng.uniform(1.0, 12.0, 8)
    time_s, heat = 30.0 * np.arange(400), np.repeat(rng.choice([0.0, 80.0], 20), 20)
    drive = np.outer(heat, np.eye(8)[0]) / capacity
    truth = linear_states(-laplacian(8, edges, conductance) / capacity[:, None], drive, np.full(8, 290.0), time_s)
    every_pair = [(a, b) for a in range(4) for b in range(a + 1, 4)]
    power = {"channels": {"Q": {"kind": "power", "unit": "W"}}, "loads": [{"channel": "Q", "node": "n0"}]}
    spec = load_spec(conductive_spec(4, every_pair, **power))
    record = record_of(time_s, Q=heat, **{f"T{i}": truth[:, 2 * i] for i in range(4)})
    return build_problem(build_network(spec), [record], np.full(4, 1e-3))


def test_a_model_too_coarse_keeps_sensible_parameters() -> None:
    """Weighed by the sensors' noise alone conductances vanish, for next to no gain."""
    problem = too_coarse()
    guess = problem.network.parameters.values
    direct, approached = minimise(problem), approach(problem)
    assert misfit_K(problem, approached.fit) < 1.2 * misfit_K(problem, direct.fit)
    assert (problem.values(approached.unknowns) > 1e-2 * guess).all()
    assert (problem.values(direct.unknowns) < 1e-4 * guess).any()


def test_a_model_that_fits_ends_with_its_noise_alone() -> None:
    problem, _ = prepare(load_spec(declared()), [telemetry()])
    approached, direct = approach(problem), minimise(problem)
    std = 1.0 / np.sqrt(np.diag(direct.hessian))
    assert (np.abs(approached.unknowns - direct.unknowns) < 0.05 * std).all()


def test_thinning_loses_no_heat() -> None:
    """Held heat is averaged, readings are taken as they are."""
    time_s, heat = STEP_S * np.arange(1000), heat_W(1000, 1)
    read = exact_K(heat, time_s)
    record = record_of(time_s, Q=heat, T_a=read[:, 0], T_b=read[:, 1])
    thin = thinned(load_spec(declared()), record, 4)
    assert thin.values["Q"].sum() * 4 == pytest.approx(heat.sum())
    np.testing.assert_array_equal(thin.values["T_a"], read[::4, 0])
    np.testing.assert_array_equal(thin.time_s, time_s[::4])


@pytest.mark.parametrize("stride", [2, 3, 4, 7])
def test_channels_that_report_in_turn_are_all_kept(stride: int) -> None:
    """Every other row, a thinned record of two rows apart had none of the second sensor's readings."""
    time_s, heat = STEP_S * np.arange(1000), heat_W(1000, 1)
    in_turn = np.where(np.arange(1000)[:, None] % 2 == [0, 1], exact_K(heat, time_s), np.nan)
    record = record_of(time_s, Q=heat, T_a=in_turn[:, 0], T_b=in_turn[:, 1])
    thin = thinned(load_spec(declared()), record, stride)
    assert thin.time_s.size == -(-1000 // stride) and (np.diff(thin.time_s) > 0.0).all()
    at = np.searchsorted(time_s, thin.time_s)
    for name in ("T_a", "T_b"):
        np.testing.assert_array_equal(thin.values[name], record.values[name][at])
        assert np.isfinite(thin.values[name]).sum() == pytest.approx(500 / stride, rel=0.05)
    for i, start in enumerate(at[:-1]):  # held heat is averaged up to the next sample
        assert thin.values["Q"][i] == pytest.approx(heat[start : at[i + 1]].mean())


def test_long_records_are_approached_on_thin_ones() -> None:
    problem, step_s = prepare(load_spec(declared()), [telemetry(5000)])
    coarse = coarse_problem(problem, step_s)
    assert coarse.segments[0].forcing.n_steps < 1500
    assert coarse_problem(coarse, step_s) is coarse


@pytest.mark.parametrize("n_times", [5, 3, 2, 1])
def test_too_few_readings_for_the_unknowns_are_refused(n_times: int) -> None:
    """Four parameters and two initial temperatures need six samples of two sensors."""
    with pytest.raises(
        TelemetryError, match=r"readings are too few to determine 6 unknowns|fewer than three usable samples"
    ):
        calibrate(load_spec(declared()), [telemetry(n_times)])
    assert np.isfinite(calibrate(load_spec(declared()), [telemetry(6)]).values["C:a"])
