"""Readings that are no temperatures: noticed and left out; Huber's loss for those that are too small to be noticed."""

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers import central_difference
from tests.twin_core.calibrate.test_calibrate import STEP_S, TRUTH, declared, scores, telemetry
from twin_core.calibrate import calibrate
from twin_core.calibrate.outliers import gross_outliers, without_outliers
from twin_core.calibrate.second_order import prepare
from twin_core.errors import ModelError
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record


def spoilt(record: Record, at: np.ndarray | list[int], values: np.ndarray | float) -> Record:
    """Return a record with other readings of node a at some samples."""
    column = record.values["T_a"].copy()
    column[at] = values
    return Record(record.time_s, {**record.values, "T_a": column})


@pytest.mark.parametrize(
    ("at", "value", "count"),
    [([150], 0.0, 1), ([40, 41, 42], 500.0, 3), (list(range(200, 230)), 0.0, 30), ([0], 90.0, 1)],
)
def test_a_dropout_changes_nothing_and_is_said(at: list[int], value: float, count: int) -> None:
    """The result is that of the record without those readings."""
    record = telemetry()
    with_garbage = calibrate(load_spec(declared()), [spoilt(record, at, value)])
    left_out = calibrate(load_spec(declared()), [spoilt(record, at, np.nan)])
    for name in TRUTH:
        assert with_garbage.values[name] == pytest.approx(left_out.values[name], rel=1e-9)
    (said,) = with_garbage.summary["notices"]
    assert f"{count} reading(s) of 'T_a'" in said and f"first at {at[0] * STEP_S:g}" in said
    assert left_out.summary["notices"] == []


def test_healthy_readings_are_kept() -> None:
    """Noise, switched heaters, a thermostat's saw, a quantised rest, a step that stays, a gap with a jump."""
    rng = np.random.default_rng(0)
    saw = 290.0 + 8.0 * np.abs((np.arange(400) / 7.0) % 2.0 - 1.0)
    rest = np.round(rng.normal(290.0, 0.03, 400), 1)
    step = np.where(np.arange(400) < 200, 280.0, 320.0) + rng.normal(0.0, 0.05, 400)
    gap = np.where((np.arange(400) > 100) & (np.arange(400) < 150), np.nan, step)
    for column in (saw, rest, step, gap, rng.normal(290.0, 0.1, 400), telemetry(400).values["T_a"]):
        assert not gross_outliers(column, 0.1).any()


@pytest.mark.parametrize("lasting", [2, 3, 4, 60])
def test_a_record_that_begins_or_ends_in_a_fast_transient_is_kept(lasting: int) -> None:
    """A closed form: 320 K, then an exponential decay of which a few readings are seen; and the same backwards in time."""
    since = np.maximum(np.arange(60 + lasting) - 59.0, 0.0)
    column = 290.0 + 30.0 * np.exp(-since / 10.0) + np.random.default_rng(0).normal(0.0, 0.01, since.size)
    for healthy in (column, column[::-1]):
        assert not gross_outliers(healthy, 0.01).any()


def test_excluded_readings_are_not_talked_about() -> None:
    data = declared() | {"exclude": [{"start": 9000.0, "stop": 13500.0, "reason": "sensor test"}]}
    record = spoilt(telemetry(), [110, 120], 0.0)
    (screened,) = without_outliers(load_spec(data), [record])
    assert screened is record


def test_hubers_loss_bears_many_small_outliers() -> None:
    """A tenth of the readings of one sensor are too high by 2 K: too little to be gross, enough to bias a mean."""
    rng = np.random.default_rng(3)
    record = telemetry(600)
    at = rng.choice(600, 60, replace=False)
    bad = spoilt(record, at, record.values["T_a"][at] + 2.0)
    squared, huber = (calibrate(load_spec(declared()), [bad], loss=loss) for loss in ("squared", "huber"))
    std = dict(zip(huber.free_names, np.sqrt(np.diag(huber.covariance)), strict=True))
    assert max(abs(np.log(squared.values[name] / truth)) / std[name] for name, truth in TRUTH.items()) > 5.0
    assert max(abs(z) for z in scores(huber, TRUTH).values()) < 2.0
    for name, truth in TRUTH.items():
        assert huber.values[name] == pytest.approx(truth, rel=2e-3), name


def test_the_gradient_of_hubers_loss_is_that_of_its_cost() -> None:
    record = spoilt(telemetry(80), [30, 31, 32, 33, 34, 35], 300.0)
    problem, _ = prepare(load_spec(declared()), [record], loss="huber")
    x = problem.start()
    _, gradient = problem.normal_equations(x, problem.solve(x))
    assert problem.solve(x).cost < 0.5 * replace(problem, huber=np.inf).solve(x).cost
    for k in range(x.size):

        def cost(value: float, k: int = k) -> np.ndarray:
            moved = x.copy()
            moved[k] = value
            return np.array(problem.solve(moved).cost)

        assert gradient[k] == pytest.approx(float(central_difference(cost, x[k], 1e-4)), rel=2e-4, abs=1e-4)


def test_an_unknown_loss_is_named() -> None:
    with pytest.raises(ModelError, match="unknown loss 'cubic' \\(known: squared, huber\\)"):
        calibrate(load_spec(declared()), [telemetry(50)], loss="cubic")
    with pytest.raises(ModelError, match="squared loss only"):
        calibrate(load_spec(declared()), [telemetry(50)], loss="huber", method="neural-ode")
