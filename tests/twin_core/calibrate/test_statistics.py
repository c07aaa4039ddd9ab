"""Figures of merit against NumPy and hand calculation."""

import numpy as np
import pytest

from twin_core.calibrate.statistics import pearson, residual_whiteness, rmse, score, whiteness


def test_rmse_skips_what_is_missing() -> None:
    assert rmse(np.array([3.0, np.nan, -4.0])) == pytest.approx(np.sqrt(12.5))
    assert rmse(np.array([np.nan])) is None


def test_pearson_is_numpys() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=50), rng.normal(size=50)
    x[7] = y[9] = np.nan
    both = np.isfinite(x) & np.isfinite(y)
    assert pearson(x, y) == pytest.approx(np.corrcoef(x[both], y[both])[0, 1])
    assert pearson(x, 3.0 * x + 1.0) == pytest.approx(1.0)
    assert pearson(x, -x) == pytest.approx(-1.0)


@pytest.mark.parametrize(("x", "y"), [([1, 1, 1], [1, 2, 3]), ([1, 2], [1, 2]), ([np.nan] * 4, [1, 2, 3, 4])])
def test_no_correlation_where_nothing_moves(x: list[float], y: list[float]) -> None:
    assert pearson(np.array(x, dtype=float), np.array(y, dtype=float)) is None


def test_whiteness_is_the_lag_one_autocorrelation() -> None:
    rng = np.random.default_rng(1)
    series = np.zeros(20000)
    for k in range(1, series.size):
        series[k] = 0.7 * series[k - 1] + rng.normal()
    assert whiteness(series) == pytest.approx(0.7, abs=0.03)
    assert whiteness(rng.normal(size=20000)) == pytest.approx(0.0, abs=0.03)
    assert whiteness(np.tile([1.0, -1.0], 50)) == pytest.approx(-1.0)
    assert whiteness(np.full(50, 2.0)) is None
    assert whiteness(np.arange(5.0)) is None


def test_whiteness_of_several_series_is_their_mean() -> None:
    pair = np.stack([np.tile([1.0, -1.0], 20), np.full(40, np.nan)], axis=1)
    assert residual_whiteness([pair]) == pytest.approx(-1.0)
    assert residual_whiteness([np.full((40, 1), np.nan)]) is None


def test_a_score_by_hand() -> None:
    measured = [np.array([[1.0, 10.0], [2.0, np.nan]]), np.array([[3.0, 30.0]])]
    predicted = [np.array([[1.5, 10.0], [2.5, 20.0]]), np.array([[3.5, 30.0]])]
    found = score(("A", "B"), measured, predicted)
    assert found["rmse_K"] == pytest.approx(np.sqrt(3 * 0.25 / 5))
    assert found["per_sensor"]["A"] == {
        "rmse_K": pytest.approx(0.5),
        "pcc": pytest.approx(1.0),
        "bias_K": pytest.approx(-0.5),  # measured - modelled
        "std_K": pytest.approx(0.0),
        "max_abs_K": pytest.approx(0.5),
        "q01_K": pytest.approx(-0.5),
        "q50_K": pytest.approx(-0.5),
        "q99_K": pytest.approx(-0.5),
        "q99_abs_K": pytest.approx(0.5),
    }
    assert found["per_sensor"]["B"]["bias_K"] == 0.0
    assert found["per_sensor"]["B"]["pcc"] is None  # two samples draw any line


def test_a_silent_sensor_has_no_score() -> None:
    found = score(("A", "B"), [np.array([[1.0, np.nan]] * 4)], [np.zeros((4, 2))])
    assert list(found["per_sensor"]) == ["A"]
    empty = score(("A",), [np.full((3, 1), np.nan)], [np.zeros((3, 1))])
    assert empty == {"rmse_K": None, "pcc": None, "per_sensor": {}}
