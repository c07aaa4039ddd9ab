"""Which fit is kept of those about ever newly smoothed temperatures: all that they do is drawn, but for the choice."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from tests.helpers import record_of
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.calibrate.undeclared import fit as rounds
from twin_core.calibrate.undeclared.model import HeatFit, UndeclaredHeat
from twin_core.calibrate.undeclared.size import SizeSearch
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec

TIME_S = 60.0 * np.arange(20)


def a_problem() -> Problem:
    spec = {
        "twin": "node",
        "boundaries": {"room": {"value_K": 293.15}},
        "channels": {"T": {"kind": "temperature", "unit": "K"}},
        "nodes": [{"id": "n", "sensor": "T", "capacity_J_per_K": {"value": 100.0}}],
        "conductors": [{"between": ["n", "room"], "conductance_W_per_K": {"value": 1.0}}],
    }
    record = record_of(TIME_S, T=293.0 + np.sin(TIME_S / 300.0))
    return build_problem(build_network(load_spec(spec)), [record], np.array([0.1]), 1e9)


@pytest.mark.parametrize(
    ("told", "about_itself", "kept", "n_rounds"),
    [
        ([100.0], [100.01], 0, 1),  # settled at once
        ([100.0, 105.0], [98.0, 105.0], 1, 2),  # settled in the second round
        ([100.0, 140.0, 150.0], [98.0, 90.0, 80.0], 0, 3),  # likely about other temperatures alone
        ([100.0, 101.0, 90.0], [98.0, 99.0, 300.0], 1, 3),  # likely about its own alone: the fit swings
        ([100.0, 110.0], [98.0, -np.inf], 0, 2),  # ran away: the round before it stays
        ([100.0, 110.0], [98.0, np.nan], 0, 2),
        ([100.0, 90.0], [98.0, 90.0], 0, 2),  # settled, but where it is less likely than before
    ],
)
def test_the_fit_is_kept_that_is_likeliest_about_both(
    told: list[float], about_itself: list[float], kept: int, n_rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = a_problem()
    begun, valued = count(), count()

    def settled(fit: HeatFit, *_: object) -> HeatFit:
        k = next(begun)
        return replace(fit, undeclared=UndeclaredHeat(np.array([float(k)]), 600.0), log_likelihood=told[k])

    monkeypatch.setattr(rounds, "_settle", settled)
    monkeypatch.setattr(rounds, "_smoothing_pass", lambda *_: ())
    monkeypatch.setattr(rounds, "log_likelihood", lambda *_: about_itself[next(valued)])
    free = problem.network.parameters.free
    start = HeatFit(problem, free, UndeclaredHeat(np.array([1.0]), 600.0), (), -np.inf)
    fit = rounds._about_itself(start, SizeSearch(0.7), 12, np.inf)
    assert fit.undeclared.std_W[0] == kept
    assert fit.log_likelihood == about_itself[kept]
    assert next(begun) == n_rounds
