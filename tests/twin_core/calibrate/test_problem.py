"""What is fitted to what: cost, gradient and Hessian against numerical differentiation of the cost itself."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from tests.helpers import active_effect, central_difference, every_term_network
from twin_core.calibrate.containment import TimeIsUpError, limited
from twin_core.calibrate.normal_equations import normal_equations
from twin_core.calibrate.optimise import minimise
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.effects import REGISTRY
from twin_core.effects.sensor_drift import SensorDrift
from twin_core.errors import TelemetryError
from twin_core.network.screened import excluded
from twin_core.network.spec import Interval
from twin_core.telemetry import Record


def orbit(n_times: int, seed: int) -> Record:
    rng = np.random.default_rng(seed)
    time_s = np.cumsum(rng.uniform(60.0, 180.0, n_times))
    values = {
        "T_room": 290.0 + rng.normal(0, 1, n_times),
        "Q_a": rng.choice([5.0, 40.0], n_times),
        "Q_sun": rng.uniform(0, 60, n_times),
        "H": rng.uniform(0, 100, n_times),
        "pitch": rng.uniform(40, 140, n_times),
        "mode": rng.integers(0, 3, n_times).astype(float),
        "T_a": 285.0 + rng.normal(0, 2, n_times),
        "T_b": np.where(rng.random(n_times) < 0.3, np.nan, 288.0 + rng.normal(0, 2, n_times)),
    }
    return Record(time_s, values, epoch_ns=1_700_000_000_000_000_000)


def problem(*names: str) -> Problem:
    network = every_term_network([active_effect(REGISTRY[name], 0.4) for name in names])
    return build_problem(network, [orbit(20, 1), orbit(15, 2)], np.array([0.5, 0.8]), 100.0)


@pytest.mark.parametrize("names", [(), ("hidden_mass",), ("sensor_lag",), ("missing_conductor", "input_power_law")])
def test_the_gradient_is_that_of_the_cost(names: tuple[str, ...]) -> None:
    check_gradient(problem(*names))


def test_the_gradient_of_a_drift_counts_from_its_instant() -> None:
    began = {"t0_s": orbit(20, 1).epoch_s, "dated": True}
    network = every_term_network([SensorDrift({"sensor": "T_a"}, {"d_K_per_s": 1e-4}, began)])
    check_gradient(build_problem(network, [orbit(20, 1)], np.array([0.5, 0.8]), 100.0))


def check_gradient(p: Problem) -> None:
    unknowns = p.start()
    unknowns[: p.n_free] += 0.05
    gradient = normal_equations(p, unknowns, p.solve(unknowns)).gradient
    for column in range(p.n_unknowns):

        def cost(x: float, column: int = column) -> np.ndarray:
            moved = unknowns.copy()
            moved[column] = x
            return np.array(p.solve(moved).cost)

        step = 1e-3 * max(1.0, 0.1 * abs(float(unknowns[column])))
        expected = float(central_difference(cost, float(unknowns[column]), step))
        assert gradient[column] == pytest.approx(expected, rel=1e-4, abs=1e-4 * np.abs(gradient).max())


def test_the_hessian_is_symmetric_and_positive() -> None:
    p = problem("hidden_mass")
    unknowns = p.start()
    hessian = normal_equations(p, unknowns, p.solve(unknowns)).hessian
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-12)
    assert np.linalg.eigvalsh(hessian).min() > 0.0


def test_unknowns_are_parameters_then_starts() -> None:
    p = problem()
    assert p.n_unknowns == p.n_free + 2 * 3
    np.testing.assert_array_equal(p.start()[p.start_columns(1)], p.segments[1].start_prior_K)
    assert p.segments[0].start_std_K[2] > p.segments[0].start_std_K[0]  # a node that nobody reads starts anywhere


def test_a_minimum_has_no_slope_and_the_cost_has_fallen() -> None:
    p = problem()
    rng = np.random.default_rng(3)
    truth = p.start()
    truth[: p.n_free] += 0.2
    read = [clean + rng.normal(0.0, p.noise_K, clean.shape) for clean in p.solve(truth).predicted_K]
    p = replace(p, segments=tuple(replace(s, measured_K=r) for s, r in zip(p.segments, read, strict=True)))
    before = p.solve(p.start()).cost
    optimum = minimise(p)
    gradient = normal_equations(p, optimum.unknowns, optimum.fit).gradient
    scale = np.sqrt(np.diag(optimum.hessian))
    assert optimum.status == "converged"
    assert optimum.fit.cost < before
    # A Newton step from here would lower the cost by less than a thousandth of a nat.
    assert (
        float((gradient / scale) @ np.linalg.solve(optimum.hessian / np.outer(scale, scale), gradient / scale)) < 1e-3
    )


def test_no_solution_is_a_status() -> None:
    p = problem()
    broken = p.segments[0].record
    cold = Record(broken.time_s, {**broken.values, "Q_a": np.full(20, -1e8)}, broken.epoch_ns)
    optimum = minimise(build_problem(p.network, [cold], p.noise_K, 100.0))
    assert optimum.status == "no_solution"
    assert optimum.iterations == 0


def test_one_evaluation_ends_between_its_segments_when_the_time_is_up(monkeypatch: pytest.MonkeyPatch) -> None:
    p = problem()
    x = p.start()
    fit = p.solve(x)
    assert len(p.segments) == 2
    for evaluate in (lambda: p.solve(x), lambda: normal_equations(p, x, fit)):
        clock = count()
        monkeypatch.setattr("time.thread_time", lambda clock=clock: float(next(clock)))
        with pytest.raises(TimeIsUpError), limited(np.inf, 2.0):
            evaluate()
        assert next(clock) == 3  # asked when the limit was set, and once a segment
        evaluate()


def test_excluded_intervals_are_half_open() -> None:
    record = Record(np.arange(6.0), {})
    mask = excluded(record, [Interval(start=1.0, stop=3.0), Interval(start=4.5, stop=99.0)])
    np.testing.assert_array_equal(mask, [False, True, True, False, False, True])


def test_an_interval_in_dates_meets_a_dated_record_alone() -> None:
    interval = Interval(start="1970-01-01T00:00:02Z", stop="1970-01-01T00:00:04Z")
    np.testing.assert_array_equal(excluded(Record(np.arange(6.0), {}, epoch_ns=0), [interval]), [0, 0, 1, 1, 0, 0])
    assert not excluded(Record(np.arange(6.0), {}), [interval]).any()


def test_no_records_are_refused() -> None:
    with pytest.raises(TelemetryError, match="no telemetry given"):
        build_problem(every_term_network(), [], np.ones(2))


def test_files_with_and_without_dates_do_not_mix() -> None:
    dated = replace(orbit(20, 1), epoch_ns=0, name="dated.csv")
    bare = replace(orbit(20, 2), epoch_ns=None, name="bare.csv")
    with pytest.raises(TelemetryError, match=r"bare\.csv: counts seconds, other files carry dates"):
        build_problem(every_term_network(), [dated, bare], np.ones(2))
