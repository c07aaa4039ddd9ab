"""What parameters are wrong by where the network is coarser than the body: against bodies with gradients in closed form."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from tests.twin_core.calibrate.body_with_gradients import CAPACITY_J_PER_K, G_W_PER_K, LEAK_W_PER_K, record, spec
from twin_core._typing import FloatArray
from twin_core.calibrate.containment import TimeIsUpError
from twin_core.calibrate.discrepancy import Discrepancy, discrepancy, stated
from twin_core.calibrate.gradients import BIOT
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.second_order import fit_network
from twin_core.calibrate.summary import to_model
from twin_core.closed_loop import close_loop
from twin_core.discover.trial import Trial
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

TRUE = np.array([*CAPACITY_J_PER_K, G_W_PER_K, LEAK_W_PER_K])


def fitted(telemetry: Record, data: dict | None = None) -> Trial:
    fit, calibration = fit_network(load_spec(data or spec()), [telemetry])
    return Trial((), fit, calibration.max_step_s, (calibration.optimum,))


def stds(model: CalibratedModel) -> FloatArray:
    rows = {row["name"]: row["std"] for row in model.summary["parameters"]}
    return np.array([rows[name] for name in model.free_names])


def off_by_deviations(model: CalibratedModel) -> FloatArray:
    """In ln of the parameters, which is how they are fitted."""
    values = np.array([model.values[name] for name in model.free_names])
    return np.asarray(np.log(values / TRUE) / (stds(model) / values))


def found_in(trial: Trial) -> Discrepancy:
    found = trial.discrepancy()
    assert found is not None
    return found


def test_it_is_part_of_the_stated_deviations_alone() -> None:
    trial = fitted(record(1.0))
    plain = to_model(trial.calibration(), ())
    wide = stated(plain, found_in(trial))
    assert stds(wide) ** 2 == pytest.approx(stds(plain) ** 2 + found_in(trial).added(stds(plain) ** 2), rel=1e-9)
    assert (wide.covariance == plain.covariance).all()
    assert wide.values == plain.values
    identified = {row["name"]: row["identified"] for row in wide.summary["parameters"]}
    values = np.array([wide.values[name] for name in wide.free_names])
    assert [identified[name] for name in wide.free_names] == (stds(wide) < values / 3.0).tolist()


def test_it_is_how_far_parameters_move_beside_gradients() -> None:
    """Where the readings leave no doubt that there are gradients; in the units of parameters that are fitted by their ln."""
    trial = fitted(record(1.0))
    gradients, calibration = trial.beside_any_gradients(), trial.calibration()
    assert gradients is not None
    values = calibration.problem.values(calibration.optimum.unknowns)[calibration.network.parameters.free_index]
    shift = values * (gradients.optimum.unknowns - calibration.optimum.unknowns)[: TRUE.size]
    found = found_in(trial)
    assert found.weight == pytest.approx(1.0, abs=0.02)
    assert found.shift == pytest.approx(shift, rel=1e-9)
    assert found.variance == pytest.approx(values**2 * np.diag(gradients.covariance())[: TRUE.size], rel=1e-9)


def test_models_that_are_as_likely_count_alike_as_far_as_gradients_explain_the_misfit() -> None:
    trial = fitted(record(1.0))
    gradients = trial.beside_any_gradients()
    assert gradients is not None
    level = replace(gradients, log_posterior=trial.calibration().log_posterior)
    assert discrepancy(trial.calibration(), level, 1.0).weight == 0.5
    assert discrepancy(trial.calibration(), level, 0.2).weight == 0.1
    with pytest.raises(ArithmeticError, match="no likelihood"):
        discrepancy(trial.calibration(), replace(gradients, log_posterior=float("nan")), 1.0)


def test_what_only_a_prior_tells_is_not_counted_twice() -> None:
    """A parameter that no reading tells has its prior's variance in both models."""
    found = Discrepancy(1.0, np.array([0.0, 3.0, 0.0]), np.array([4.0, 4.0, 9.0]))
    assert found.added(np.array([4.0, 4.0, 4.0])).tolist() == [0.0, 9.0, 5.0]


def test_a_shift_away_from_a_bound_is_told_in_full() -> None:
    """On a bound the coordinate of the search has no slope: what moves there is not told by it."""
    data = spec()
    data["nodes"][0]["capacity_J_per_K"] = {"guess": 4200.0, "bounds": [3600.0, 4400.0]}
    trial = fitted(record(1.0), data)
    plain = to_model(trial.calibration(), ())
    found = found_in(trial)
    at = plain.free_names.index("C:n0")
    moved = found.shift[at]
    assert plain.values["C:n0"] == pytest.approx(4400.0, rel=1e-3)
    assert moved < -50.0
    assert stds(stated(plain, found))[at] >= abs(moved)


def test_where_there_are_no_gradients_bands_stay() -> None:
    """Trajectories leave no more than chance. Where a little more is left, and no gradients are likely, bands hardly move."""
    assert fitted(record(0.0)).discrepancy() is None
    trial = fitted(record(0.02))
    found = trial.discrepancy()
    plain = stds(to_model(trial.calibration(), ()))
    assert found is None or (found.added(plain**2) < plain**2).all()


@pytest.mark.long
@pytest.mark.statistical
def test_bands_hold_the_truth_of_bodies_with_gradients() -> None:
    """Thirty bodies with sensors off their mean by Biot numbers of the size that is assumed, four parameters each."""
    rng, plain, wide = np.random.default_rng(20), [], []
    for seed in range(30):
        trial = fitted(record(1.0, off=rng.normal(0.0, BIOT, 4), seed=seed))
        model = to_model(trial.calibration(), ())
        plain.append(off_by_deviations(model))
        wide.append(off_by_deviations(stated(model, found_in(trial))))
    held_plain, held_wide = (float(np.mean(np.abs(z) < 1.645)) for z in (plain, wide))
    assert held_plain < 0.5
    assert held_wide >= 0.9
    assert np.sqrt(np.mean(np.square(wide))) > 0.7  # nor are they wider than need be


def test_a_closed_loop_states_it_of_both_models(monkeypatch: pytest.MonkeyPatch) -> None:
    told = Mock(return_value=Discrepancy(1.0, np.full(4, 1e6), np.zeros(4)))
    monkeypatch.setattr(Trial, "discrepancy", told)
    loop = close_loop(load_spec(spec()), [record(0.0)])
    assert loop.report["verdict"] == "no_effect_supported"
    assert (stds(loop.before_model) >= 1e6).all()
    assert (stds(loop.model) >= 1e6).all()
    free = [row for row in loop.report["parameters"] if row["name"] in loop.model.free_names]
    assert all(row[when]["std"] >= 1e6 for row in free for when in ("calibrated", "corrected"))


def test_a_closed_loop_goes_without_where_it_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Trial, "discrepancy", Mock(side_effect=ArithmeticError("not today")))
    loop = close_loop(load_spec(spec()), [record(0.0)])
    assert any("parameter errors caused by the coarse network: not today" in line for line in loop.report["failures"])


def test_a_closed_loop_goes_without_where_time_is_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Trial, "discrepancy", Mock(side_effect=TimeIsUpError("the deadline was reached")))
    loop = close_loop(load_spec(spec()), [record(0.0)])
    assert loop.report["verdict"] == "no_effect_supported"
    assert any("caused by the coarse network: the deadline was reached" in line for line in loop.report["failures"])
