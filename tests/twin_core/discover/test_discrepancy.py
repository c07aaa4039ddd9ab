"""Bands of parameters where the network is coarser than the body: against bodies with gradients in closed form."""

import numpy as np
import pytest

from tests.twin_core.calibrate.body_with_gradients import CAPACITY_J_PER_K, G_W_PER_K, LEAK_W_PER_K, record, spec
from twin_core._typing import FloatArray
from twin_core.calibrate.gradients import BIOT
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.second_order import fit_network
from twin_core.calibrate.summary import to_model
from twin_core.discover.trial import Trial
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

TRUE_LN = np.log([*CAPACITY_J_PER_K, G_W_PER_K, LEAK_W_PER_K])


def fitted(telemetry: Record) -> Trial:
    fit, calibration = fit_network(load_spec(spec()), [telemetry])
    return Trial((), fit, calibration.max_step_s, (calibration.optimum,))


def stated_deviations(model: CalibratedModel) -> FloatArray:
    """Return the stated standard deviations of the free parameters in the solver's coordinate, (n_free,)."""
    parameters = model.network().parameters
    stds = {row["name"]: row["std"] for row in model.summary["parameters"]}
    return np.array([stds[name] for name in parameters.free_names]) / parameters.slopes(parameters.free)


def off_by_deviations(model: CalibratedModel) -> FloatArray:
    return np.asarray((model.network().parameters.free - TRUE_LN) / stated_deviations(model))


def test_it_is_part_of_the_stated_deviations_alone() -> None:
    """What is foretold counts the misfit instead."""
    trial = fitted(record(1.0))
    calibration, discrepancy = trial.calibration(), trial.discrepancy()
    plain, wide = to_model(calibration, ()), to_model(calibration, (), discrepancy=discrepancy)
    variance = np.diag(plain.covariance + discrepancy)
    assert stated_deviations(wide) == pytest.approx(np.sqrt(variance), rel=1e-9)
    assert wide.covariance == pytest.approx(plain.covariance, rel=1e-9)
    assert wide.values == plain.values


def test_it_holds_how_far_parameters_move_beside_gradients() -> None:
    """Where the readings leave no doubt that there are gradients."""
    trial = fitted(record(1.0))
    gradients = trial.beside_any_gradients()
    assert gradients is not None
    shift = (gradients.optimum.unknowns - trial.calibration().optimum.unknowns)[: TRUE_LN.size]
    within = np.diag(gradients.covariance())[: TRUE_LN.size]
    assert np.diag(trial.discrepancy()) == pytest.approx(shift**2 + within, rel=1e-9)


def test_where_there_are_no_gradients_bands_stay() -> None:
    trial = fitted(record(0.0))
    variance = np.diag(to_model(trial.calibration(), ()).covariance)
    assert (np.diag(trial.discrepancy()) < 0.01 * variance).all()


def test_bands_hold_the_truth_of_bodies_with_gradients() -> None:
    """Thirty bodies with sensors off their mean by Biot numbers of the size that is assumed, four parameters each."""
    rng, plain, wide = np.random.default_rng(20), [], []
    for seed in range(30):
        trial = fitted(record(1.0, off=rng.normal(0.0, BIOT, 4), seed=seed))
        calibration = trial.calibration()
        plain.append(off_by_deviations(to_model(calibration, ())))
        wide.append(off_by_deviations(to_model(calibration, (), discrepancy=trial.discrepancy())))
    held_plain, held_wide = (float(np.mean(np.abs(z) < 1.645)) for z in (plain, wide))
    assert held_wide >= 0.9
    assert held_plain < 0.5
