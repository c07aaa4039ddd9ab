"""Telemetry with outliers, and hold-outs with nothing to score."""

import numpy as np
import pytest

from benchmarks.network_cases import network_case
from twin_core.closed_loop import close_loop
from twin_core.errors import TelemetryError
from twin_core.telemetry import Record


def test_outliers_end_in_an_honest_verdict() -> None:
    """Two absurd readings once made a step of the fit overflow; they may spoil the fit, but never end the program."""
    case = network_case("leak_to_boundary", 11, n_orbits=4, dt_s=180.0)
    values = {name: column.copy() for name, column in case.record.values.items()}
    values["T0"][20], values["T0"][40] = 400.0, 100.0
    report = close_loop(case.spec, [Record(case.record.time_s, values)]).report
    assert report["verdict"] in ("effect_added", "unexplained")
    assert np.isfinite(report["before"]["rmse_K"])


def test_a_hold_out_without_readings_is_refused() -> None:
    case = network_case(None, 11, n_orbits=4, dt_s=180.0)
    late = case.record.time_s > 0.65 * case.record.time_s[-1]
    values = {n: np.where(late, np.nan, c) if n in case.spec.sensors else c for n, c in case.record.values.items()}
    with pytest.raises(TelemetryError, match="no usable sample of T0"):
        close_loop(case.spec, [Record(case.record.time_s, values)])


def test_a_hold_out_that_was_masked_says_why() -> None:
    case = network_case(None, 11, n_orbits=4, dt_s=180.0)
    last = int(np.searchsorted(case.record.time_s, 0.65 * case.record.time_s[-1]))
    late = np.arange(case.record.time_s.size) > last
    values = {n: np.where(late, c[last], c) if n in case.spec.sensors else c for n, c in case.record.values.items()}
    with pytest.raises(TelemetryError, match="readings there were masked: T0 as frozen"):
        close_loop(case.spec, [Record(case.record.time_s, values)])
