"""Readings that are no temperatures: noticed and left out; Huber's loss for those that are too small to be noticed."""

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers import central_difference
from tests.twin_core.calibrate.test_calibrate import STEP_S, TRUTH, declared, scores, telemetry
from twin_core.calibrate import calibrate
from twin_core.calibrate.normal_equations import normal_equations
from twin_core.calibrate.second_order import prepare
from twin_core.errors import ModelError
from twin_core.network.screened import screened
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
    assert (
        f"{count} {'reading' if count == 1 else 'readings'} of 'T_a'" in said and f"first at {at[0] * STEP_S:g}" in said
    )
    assert left_out.summary["notices"] == []


def test_excluded_readings_are_not_talked_about() -> None:
    data = declared() | {"exclude": [{"start": 9000.0, "stop": 13500.0, "reason": "sensor test"}]}
    record = spoilt(telemetry(), [110, 120], 0.0)
    looked_at = screened(load_spec(data), record)
    assert looked_at.notices == () and looked_at.flaws == ()
    np.testing.assert_array_equal(looked_at.values["T_a"], record.values["T_a"])


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
    gradient = normal_equations(problem, x, problem.solve(x)).gradient
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
