"""A numerical failure ends a start or a refinement, never the run; a deadline ends the search with the best so far."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.analytic import laplacian, linear_states
from tests.helpers import conductive_spec, record_of
from twin_core.calibrate import calibrate
from twin_core.calibrate.containment import attempted, those_that_work
from twin_core.calibrate.multistart import best_of_starts
from twin_core.calibrate.optimise import minimise
from twin_core.calibrate.problem import Problem
from twin_core.calibrate.second_order import prepare
from twin_core.errors import NoSolutionError
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

NOISE_K = 0.05


def pair() -> tuple[TwinSpec, Record]:
    """Return two nodes of 4000 and 900 J/K, 2 W/K apart, one of them heated; of capacities nobody has a guess."""
    data = conductive_spec(
        2, [(0, 1)], channels={"Q": {"kind": "power", "unit": "W"}}, loads=[{"channel": "Q", "node": "n0"}]
    )
    for row in data["nodes"]:
        del row["capacity_J_per_K"]
    time_s = 30.0 * np.arange(240)
    heat = np.repeat(np.random.default_rng(1).uniform(0.0, 60.0, 24), 10)
    capacity = np.array([4.0e3, 900.0])
    rates = -laplacian(2, [(0, 1)], [2.0]) / capacity[:, None]
    states = linear_states(rates, np.outer(heat, [1.0 / capacity[0], 0.0]), np.array([290.0, 284.0]), time_s)
    noise = np.random.default_rng(2).normal(0.0, NOISE_K, (240, 2))
    record = record_of(time_s, Q=heat, T0=states[:, 0] + noise[:, 0], T1=states[:, 1] + noise[:, 1])
    return load_spec(data), record


SOLVERS = [
    "twin_core.calibrate.optimise.cho_factor",
    "twin_core.calibrate.optimise.cho_solve",
    "twin_core.calibrate.starting.least_squares",
    "twin_core.calibrate.starting.connected_components",
    "twin_core.calibrate.restricted.solve_triangular",
    "twin_core.gp.noise_model._climb",
    "twin_core.simulate.rollout.march",
    "twin_core.calibrate.problem.sensitivities",
    "numpy.linalg.solve",
    "numpy.linalg.cholesky",
    "numpy.linalg.eigh",
]
"""Every solver and factorisation that a calibration calls."""


def failing(real: Callable[..., Any], calls: set[int] | None, error: Exception) -> tuple[Callable[..., Any], list[int]]:
    """Return a solver that fails at some of its calls, or at all of them, and the list that counts them."""
    count: list[int] = []

    def solver(*args: Any, **kwargs: Any) -> Any:
        count.append(len(count))
        if calls is None or count[-1] in calls:
            raise error
        return real(*args, **kwargs)

    return solver, count


def resolved(path: str) -> Callable[..., Any]:
    module, name = path.rsplit(".", 1)
    return getattr(__import__(module, fromlist=[name]), name)  # type: ignore[no-any-return]


ERRORS = [np.linalg.LinAlgError("did not converge"), OverflowError("out of range"), FloatingPointError("invalid value")]


@pytest.mark.parametrize("error", ERRORS, ids=lambda e: type(e).__name__)
@pytest.mark.parametrize("path", SOLVERS)
def test_one_failure_never_ends_the_run(path: str, error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    spec, record = pair()
    solver, count = failing(resolved(path), {0}, error)
    monkeypatch.setattr(path, solver)
    model = calibrate(spec, [record])
    assert count, "the solver has not been called: the list is out of date"
    assert model.summary["rmse_K"] < 1.1 * NOISE_K
    assert abs(np.log(model.values["C:n0"] / 4.0e3)) < 0.05


@pytest.mark.parametrize("path", SOLVERS)
def test_a_solver_that_always_fails_leaves_a_model_or_one_line_of_advice(
    path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec, record = pair()
    solver, _ = failing(resolved(path), None, np.linalg.LinAlgError("singular matrix"))
    monkeypatch.setattr(path, solver)
    try:
        model = calibrate(spec, [record])
    except NoSolutionError as refused:
        assert "calibration failed" in str(refused) and "check the units" in str(refused)
        return
    assert np.isfinite(list(model.values.values())).all()


def test_the_arithmetic_of_one_start_ends_that_start(monkeypatch: pytest.MonkeyPatch) -> None:
    spec, record = pair()
    problem, _ = prepare(spec, [record])
    real, begun = Problem.solve, problem.start()

    def solve(self: Problem, unknowns: Any, near: Any = None) -> Any:
        if np.array_equal(unknowns, begun):
            raise OverflowError("exp")
        return real(self, unknowns, near)

    monkeypatch.setattr(Problem, "solve", solve)
    assert minimise(problem, begun).status == "no_solution"
    search = best_of_starts(problem)
    assert search.tried > 1 and search.failures[0].startswith("start 1: ")
    assert search.best.status == "converged"


def test_errors_of_programming_are_not_contained() -> None:
    with pytest.raises(TypeError):
        attempted(lambda: len(3), "a slip", [])  # type: ignore[arg-type]


def test_a_deadline_that_has_passed_gives_the_best_so_far() -> None:
    spec, record = pair()
    model = calibrate(spec, [record], deadline=time.monotonic() - 1.0)
    assert model.summary["status"] == "deadline"
    assert "deadline" in model.summary["advice"]
    assert np.isfinite(list(model.values.values())).all()


def test_a_deadline_that_is_far_changes_nothing() -> None:
    spec, record = pair()
    free, bound = calibrate(spec, [record]), calibrate(spec, [record], deadline=time.monotonic() + 1e6)
    assert free.values == bound.values


def test_a_start_that_fails_takes_none_with_it() -> None:
    def fails() -> float:
        raise np.linalg.LinAlgError("Singular matrix")

    def is_wrong() -> float:
        raise TypeError("not an array")

    assert those_that_work([fails, lambda: 2.0, fails]) == [2.0]
    with pytest.raises(np.linalg.LinAlgError, match="Singular"):
        those_that_work([fails, fails])
    with pytest.raises(TypeError):
        those_that_work([lambda: 1.0, is_wrong])
