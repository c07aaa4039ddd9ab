"""Blocks predicted from the others: refits where one block alone tells a parameter, the linear move where it is the same."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from twin_core._typing import BoolArray, FloatArray
from twin_core.calibrate.optimise import Optimum, minimise
from twin_core.calibrate.problem import Fit
from twin_core.calibrate.second_order import Calibration, fit_network
from twin_core.discover import left_out
from twin_core.discover.left_out import N_BLOCKS, OPENING_SHARE, blocked_errors, forward_error
from twin_core.network.spec_io import load_spec
from twin_core.parameters.transforms import Log
from twin_core.parameters.vector import ParameterSet
from twin_core.telemetry import Record

STEP_S, N, ROOM_K, NOISE_K = 60.0, 320, 290.0, 0.05
TIME_S = STEP_S * np.arange(N)
SPEC = {
    "twin": "block",
    "boundaries": {"room": {"value_K": ROOM_K}},
    "channels": {
        "T": {"kind": "temperature", "unit": "K", "noise_std": NOISE_K},
        "P": {"kind": "power", "unit": "W"},
    },
    "nodes": [{"id": "block", "sensor": "T", "capacity_J_per_K": {"guess": 400.0}}],
    "conductors": [{"between": ["block", "room"], "conductance_W_per_K": {"guess": 1.0}}],
    "loads": [{"channel": "P", "node": "block", "gain": {"value": 1.0}}],
}


def held_but_once() -> FloatArray:
    """Return a power that is held but for one pulse: its block alone tells the capacity."""
    return np.where((TIME_S >= 0.40 * TIME_S[-1]) & (TIME_S < 0.45 * TIME_S[-1]), 30.0, 10.0)


def swinging() -> FloatArray:
    """Return a power that swings in every block."""
    return 10.0 + 8.0 * np.sin(2.0 * np.pi * TIME_S / 600.0)


def calibrated(power_W: FloatArray, misfit_K: FloatArray | float = 0.0) -> Calibration:
    """Return a block that rests with its power at first, calibrated to readings with a misfit."""
    capacity, conductance = 60.0, 0.8
    fade, path = np.exp(-conductance * STEP_S / capacity), [ROOM_K + power_W[0] / conductance]
    for power in power_W[:-1]:
        rest_K = ROOM_K + power / conductance
        path.append(rest_K + fade * (path[-1] - rest_K))
    measured = np.array(path) + misfit_K + NOISE_K * np.random.default_rng(3).standard_normal(N)
    _, calibration = fit_network(load_spec(SPEC), [Record(TIME_S, {"T": measured, "P": power_W}, None, "block")])
    return calibration


def refitted(calibration: Calibration) -> FloatArray:
    """Return the error on each block after a refit to a record without it."""
    problem, optimum = calibration.problem, calibration.optimum
    (segment,), errors = problem.segments, []
    edges = np.linspace(0, segment.measured_K.shape[0], N_BLOCKS + 1).astype(int)
    rows = np.arange(segment.measured_K.shape[0])
    for first, last in pairwise(edges.tolist()):
        out = (rows >= first) & (rows < last) & (rows >= OPENING_SHARE * rows.size)
        kept = replace(segment, measured_K=np.where(out[:, None], np.nan, segment.measured_K))
        fit = minimise(replace(problem, segments=(kept,)), optimum.unknowns).fit
        errors.append(float((((segment.measured_K - fit.predicted_K[0]) / problem.noise_K)[out] ** 2).sum()))
    return np.array(errors)


@pytest.mark.parametrize(
    ("power_W", "n_refits"), [(held_but_once, 1), (swinging, 0)], ids=["told by one block", "told by all"]
)
def test_what_one_block_alone_tells_is_refitted(
    monkeypatch: pytest.MonkeyPatch, power_W: Callable[[], FloatArray], n_refits: int
) -> None:
    calibration, calls = calibrated(power_W()), []

    def counted(calibration: Calibration, noise_K: FloatArray, out: BoolArray) -> Optimum:
        calls.append(out)
        return refit(calibration, noise_K, out)

    refit = left_out._refitted
    monkeypatch.setattr(left_out, "_refitted", counted)
    found, expected = blocked_errors(calibration)[0], refitted(calibration)
    assert len(calls) == 2 * n_refits  # beside either noise
    assert np.abs(found - expected).max() <= 0.03 * expected.sum()


def test_a_bound_that_is_far_away_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    calibration = calibrated(held_but_once())
    parameters = calibration.problem.network.parameters
    bounded = ParameterSet(tuple(replace(p, transform=Log(upper=1e9)) for p in parameters.parameters))
    unbounded = ParameterSet(tuple(replace(p, transform=Log()) for p in parameters.parameters))
    monkeypatch.setattr(left_out, "MISJUDGED", np.inf)
    errors = []
    for some in (bounded, unbounded):
        problem = calibration.problem.with_network(calibration.problem.network.with_parameters(some))
        errors.append(blocked_errors(replace(calibration, problem=problem)))
    np.testing.assert_array_equal(*errors)


def test_a_refit_that_fails_leaves_the_linear_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    calibration = calibrated(held_but_once())
    nowhere = replace(calibration.optimum, fit=Fit(np.inf, (), ()), status="no_solution")
    monkeypatch.setattr(left_out, "_refitted", lambda calibration, noise_K, out: nowhere)
    failed = blocked_errors(calibration)
    monkeypatch.setattr(left_out, "MISJUDGED", np.inf)
    assert np.isfinite(failed).all()
    np.testing.assert_array_equal(failed, blocked_errors(calibration))


def wandering(seed: int, std_K: float, length_s: float) -> FloatArray:
    """Return an Ornstein-Uhlenbeck misfit."""
    rng, fade = np.random.default_rng(seed), np.exp(-STEP_S / length_s)
    steps = np.sqrt(1.0 - fade**2) * rng.standard_normal(N)
    path = [rng.standard_normal()]
    for step in steps[1:]:
        path.append(fade * path[-1] + step)
    return np.asarray(std_K * np.array(path), dtype=np.float64)


def test_a_misfit_that_lasts_carries_no_refit_away() -> None:
    """The beginning tells no capacity: under a misfit that wanders it must not be taken to, for the end has the pulse."""
    power = np.where((TIME_S >= 0.80 * TIME_S[-1]) & (TIME_S < 0.85 * TIME_S[-1]), 30.0, 10.0)
    cases = [calibrated(power, wandering(seed, 0.4, 900.0)) for seed in range(12)]
    as_if_white, own = np.transpose([forward_error(case) for case in cases])
    assert np.mean(own) < np.mean(as_if_white)
    assert np.std(np.log(own)) < np.std(np.log(as_if_white)) / 3.0


@pytest.mark.parametrize(
    ("event", "first_left_out"),
    [(-np.inf, 208), (0, 208), (160, 208), (200, 232), (256, 288), (288, 304), (310, 315), (318, 319)],
)
def test_what_follows_an_event_is_foretold_from_no_more_than_half_of_it(event: float, first_left_out: int) -> None:
    """Of 320 samples the last 35 %, or what comes a tenth of the record after the event, or the second half of what follows."""
    segments = calibrated(swinging()).problem.segments
    event_s = event if np.isinf(event) else float(segments[0].record.clock_s[int(event)])
    ((rows,),) = left_out._folds(segments, event_s)
    assert int(np.flatnonzero(rows)[0]) == first_left_out and rows[first_left_out:].all()


def test_nothing_is_left_to_foretell_of_an_event_after_the_end() -> None:
    calibration = calibrated(swinging())
    clock_s = calibration.problem.segments[0].record.clock_s
    np.testing.assert_array_equal(forward_error(calibration, float(clock_s[-1]) + 1.0), 0.0)
