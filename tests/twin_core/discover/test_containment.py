"""A numerical failure ends one candidate, is listed with its reason, and never the search; a deadline ends it with an answer."""

import importlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.linalg import LinAlgError

from benchmarks.network_cases import network_case
from twin_core.calibrate.optimise import Optimum
from twin_core.calibrate.problem import Fit
from twin_core.calibrate.second_order import fit_network, from_heat_fit
from twin_core.closed_loop import close_loop
from twin_core.discover.judge import Search
from twin_core.discover.search import REVISION_SHARE, search
from twin_core.discover.trial import Trial, try_effects
from twin_core.effects import REGISTRY
from twin_core.errors import TelemetryError
from twin_core.report.phrasing import headline

SOLVERS = (
    "numpy.linalg.svd",
    *(pytest.param(f"numpy.linalg.{name}", marks=pytest.mark.long) for name in ("solve", "pinv", "eigh")),
    "twin_core.calibrate.optimise.cho_factor",
    "twin_core.calibrate.optimise.cho_solve",
    "twin_core.gp.noise_model._climb",
    "twin_core.simulate.rollout.march",
    "twin_core.calibrate.problem.sensitivities",
    "twin_core.calibrate.undeclared.model.one_step",
    "twin_core.calibrate.undeclared.model.sensitivities",
)
"""Every solver and factorisation that a search calls."""


@pytest.fixture(scope="module")
def base() -> Trial:
    """Return a small spacecraft whose leak nobody declared, calibrated."""
    case = network_case("leak_to_boundary", 1, n_orbits=3, dt_s=300.0)
    fit, calibration = fit_network(case.spec, [case.record])
    return Trial((), fit, calibration.max_step_s, (calibration.optimum,))


@pytest.fixture
def few_kinds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the search one effect for each way it takes: by heat, by a state of its own, by an input, and without a name."""
    kinds = ("leak_to_boundary", "hidden_mass", "input_gain", "learned_heat_flow")
    monkeypatch.setattr(REGISTRY, "_kinds", {name: REGISTRY[name] for name in kinds})


def failing(solver: Callable[..., Any], after: int, every: int) -> Callable[..., Any]:
    """Return a solver that fails at a call, and from then on at every so many."""
    calls = 0

    def work(*arguments: Any, **options: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls >= after and (calls - after) % every == 0:
            raise LinAlgError("injected")
        return solver(*arguments, **options)

    return work


def test_a_candidate_without_a_trajectory_ends_as_a_numerical_failure(
    base: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of several records the first may have no open-loop solution, and the others were never rolled out."""
    nothing = Optimum(base.fit.unknowns(), Fit(np.inf, (), ()), np.eye(1), "no_solution", 0)
    monkeypatch.setattr("twin_core.calibrate.second_order.minimise", lambda *given: nothing)
    with pytest.raises(ArithmeticError, match="no open-loop solution"):
        from_heat_fit(base.fit, base.max_step_s, near=[nothing], starts=[base.fit.unknowns()])


@pytest.mark.usefixtures("few_kinds", "one_core")
@pytest.mark.parametrize("path", SOLVERS)
def test_a_solver_that_fails_ends_one_candidate(base: Trial, monkeypatch: pytest.MonkeyPatch, path: str) -> None:
    module, name = path.rsplit(".", 1)
    real = getattr(importlib.import_module(module), name)
    calls: list[int] = []

    def counted(*arguments: Any, **options: Any) -> Any:
        calls.append(len(calls))
        return real(*arguments, **options)

    monkeypatch.setattr(path, failing(counted, 1, 40))
    found = search(base, false_alarm_rate=0.01)
    assert calls, "the solver has not been called: the list is out of date"
    assert found.trial.fit is not None  # whatever failed, there is an answer
    for failure in found.failures:
        what, _, reason = failure.partition(": ")
        assert what and reason


def test_everything_may_fail(base: Trial, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("twin_core.discover.search.try_effects", failing(lambda *a, **k: None, 1, 1))
    monkeypatch.setattr("twin_core.discover.trajectories.try_on_trajectories", failing(lambda *a, **k: None, 1, 1))
    found = search(base, false_alarm_rate=0.01)
    assert found.findings == [] and found.trial is base
    assert found.failures and all(failure.endswith("injected") for failure in found.failures)


@pytest.mark.usefixtures("few_kinds")
@pytest.mark.parametrize("path", ["twin_core.discover.search.resettled", "twin_core.discover.trial.Trial.misfit_share"])
def test_what_settles_or_scales_a_finding_fails_alone(base: Trial, monkeypatch: pytest.MonkeyPatch, path: str) -> None:
    """Neither is a candidate's own fit: what was found before it stands, and the failure is listed."""
    monkeypatch.setattr(path, failing(lambda *a, **k: None, 1, 1))
    found = search(base, false_alarm_rate=0.01)
    assert [effect.name for finding in found.findings for effect in finding.effects] == ["leak_to_boundary"]
    assert all(failure.endswith("injected") for failure in found.failures)
    assert found.failures or path.endswith("misfit_share")  # nobody asks what a trajectory leaves once heat has told


def test_a_deadline_ends_the_search_with_the_best_so_far(base: Trial) -> None:
    found = search(base, false_alarm_rate=0.01, deadline=time.monotonic())
    assert found.trial is base and found.left_out


def test_a_deadline_is_told_in_the_report() -> None:
    case = network_case("leak_to_boundary", 1, n_orbits=3, dt_s=300.0)
    report = close_loop(case.spec, [case.record], deadline_s=1e-3).report
    assert report["findings"] == []
    assert any("the deadline ended the search" in notice for notice in report["notices"])
    assert report["search"] == {"complete": False, "left_out": report["search"]["left_out"], "every": 1}
    assert "deadline ended the search" in headline(report) and "suffices" not in headline(report)
    assert report["missing_heat"] == []
    (said,) = (notice for notice in report["notices"] if "missing heat" in notice)
    assert said.startswith("the report does not contain the missing heat at ")
    assert said.endswith(": the deadline was reached before it was computed; allow more time")


@pytest.mark.usefixtures("one_core")
def test_what_began_before_the_deadline_does_not_go_on_after_it(base: Trial, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock jumps past the deadline in the midst of a candidate's refit: that candidate is the last."""
    clock, refits = [0.0], []
    monkeypatch.setattr("twin_core.calibrate.containment.time.monotonic", lambda: clock[0])

    def overtaken(*arguments: Any, **options: Any) -> Any:
        refits.append(arguments)
        clock[0] = 100.0
        return try_effects(*arguments, **options)

    monkeypatch.setattr("twin_core.discover.search.try_effects", overtaken)
    found = search(base, false_alarm_rate=0.01, deadline=50.0)
    assert found.trial is base and found.findings == [] and found.rejected == []
    assert len(refits) == 1
    assert len(found.left_out) > len(refits)


def test_a_calibration_ends_at_the_deadline_with_what_it_has() -> None:
    case = network_case("leak_to_boundary", 1, n_orbits=3, dt_s=300.0)
    fit, calibration = fit_network(case.spec, [case.record], deadline=time.monotonic())
    assert np.isfinite(fit.log_likelihood) and np.isfinite(calibration.optimum.fit.cost)
    assert calibration.optimum.status == "deadline"


@pytest.mark.parametrize("deadline_s", [0.0, -1.0, np.nan])
def test_an_impossible_deadline_is_refused(deadline_s: float) -> None:
    case = network_case(None, 1, n_orbits=3, dt_s=300.0)
    with pytest.raises(TelemetryError, match="deadline_s: must be a positive number of seconds"):
        close_loop(case.spec, [case.record], deadline_s=deadline_s)


def test_what_was_found_is_looked_over_when_the_time_for_looking_is_up(
    base: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second effect comes with the last second of looking: whether it is needed is asked all the same."""
    clock, extended, asked = [0.0], [], []
    monkeypatch.setattr("twin_core.calibrate.containment.time.monotonic", lambda: clock[0])

    def extend(state: Search, needed: float, *, fallback: bool) -> bool:
        extended.append(state.deadline)
        clock[0] += 40.0
        return state.attempt(lambda: True, "looking") is True

    def withdraw(state: Search, needed: float) -> None:
        asked.append(state.attempt(lambda: "looked over", "the model without it"))

    monkeypatch.setattr("twin_core.discover.search._extend", extend)
    monkeypatch.setattr("twin_core.discover.search.withdraw", withdraw)
    monkeypatch.setattr("twin_core.discover.search.extend_beside_gradients", lambda state, needed: False)
    found = search(base, false_alarm_rate=0.01, deadline=100.0)
    assert extended[0] == extended[1] == pytest.approx(100.0 * (1.0 - REVISION_SHARE))
    assert found.left_out[0] == "looking" and asked[0] == "looked over"
    assert found.deadline == 100.0
