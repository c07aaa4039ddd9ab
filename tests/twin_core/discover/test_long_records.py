"""Long records: what the search looks at, and that both models are calibrated on everything."""

import numpy as np
import pytest

from benchmarks.network_cases import network_case
from twin_core.calibrate.second_order import fit_network
from twin_core.closed_loop import close_loop
from twin_core.discover import long_records
from twin_core.discover.long_records import on_all_samples, searched
from twin_core.discover.trial import Trial


def test_a_long_record_is_searched_on_some_samples_and_calibrated_on_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(long_records, "LONGEST", 50)
    case = network_case("missing_conductor", 1, n_orbits=5, dt_s=180.0)
    report = close_loop(case.spec, [case.record]).report
    kept = int((case.record.time_s <= case.record.time_s[0] + 0.7 * np.ptp(case.record.time_s) + 1e-9).sum())
    assert report["search"]["every"] == kept // 50 >= 2
    assert any("calibrated on all of them" in notice for notice in report["notices"])
    assert [finding["effect"] for finding in report["findings"]] == ["missing_conductor"]
    assert report["after"]["rmse_K"] < 0.6 * report["before"]["rmse_K"]


def test_a_short_record_is_searched_as_it_is() -> None:
    case = network_case(None, 1, n_orbits=2, dt_s=300.0)
    fit, calibration = fit_network(case.spec, [case.record])
    base = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
    assert searched(base) == (base, 1)
    assert on_all_samples(base, base) is base
