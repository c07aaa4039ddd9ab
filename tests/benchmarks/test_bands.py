"""Scoring of bands: what counts, and against what."""

import numpy as np

from benchmarks.bands import bands


def test_a_coefficient_is_compared_about_the_reference_of_the_finding() -> None:
    """Two lines through the same capacities: 100 J/K at 300 K and 110 J/K at 310 K."""
    truth = {"kappa_per_K": 10.0 / 1000.0, "T_ref_K": 300.0}
    found = {"kappa_per_K": {"mean": 10.0 / 1100.0, "std": 1e-6}, "T_ref_K": {"mean": 310.0, "std": None}}
    (band,) = bands(truth, found)
    assert band.holds
    np.testing.assert_allclose(band.true, 10.0 / 1100.0)


def test_a_table_is_compared_at_its_own_knots_and_an_onset_elsewhere() -> None:
    levels = {"knots": {"mean": [0.0, 1.0], "std": None}, "values_W": {"mean": [5.0, 7.0], "std": [1.0, 1.0]}}
    truth = {"knots": [0.0, 1.0], "values_W": [5.5, 4.0], "time": 10.0}
    found = levels | {"time": {"mean": 90.0, "std": 1.0}}
    assert [band.holds for band in bands(truth, found)] == [True, False]
    assert bands(truth | {"knots": [0.0, 2.0]}, found) == []
    assert bands(truth, None) == []


def test_an_end_on_the_calendar_has_no_band() -> None:
    """As an onset it is scored apart: both are dates where the record is dated."""
    found = {"Q_W": {"mean": 5.0, "std": 0.1}, "stop": {"mean": "2026-03-01T00:00:00Z", "std": 30.0}}
    assert [band.name for band in bands({"Q_W": 5.05, "stop": 4000.0}, found)] == ["Q_W"]
