"""Confirmation: errors on left-out blocks against true refits, and what evidence pays for."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import chi2

from tests.analytic import laplacian, linear_states
from tests.helpers import conductive_spec, record_of
from twin_core.calibrate.optimise import minimise
from twin_core.calibrate.second_order import fit_network
from twin_core.discover.confirm import N_BLOCKS, Trial, blocked_errors, try_effects, validate, weigh
from twin_core.effects import REGISTRY
from twin_core.network.spec import TwinSpec, load_spec
from twin_core.telemetry import Record

NOISE_K = 0.1


def spec() -> TwinSpec:
    power = {"kind": "power", "unit": "W"}
    data = conductive_spec(2, [(0, 1)], channels={"Q": power}, loads=[{"channel": "Q", "node": "n0"}])
    for sensor in ("T0", "T1"):
        data["channels"][sensor]["noise_std"] = NOISE_K
    return load_spec(data)


def record(missing_W: float) -> Record:
    rng = np.random.default_rng(0)
    time_s, heat = 60.0 * np.arange(200), np.repeat(rng.choice([0.0, 40.0, 90.0], 20), 10)
    capacity = np.array([4.0e3, 7.0e3])
    rates = -laplacian(2, [(0, 1)], [2.5]) / capacity[:, None]
    drive = np.stack([heat, np.full(200, missing_W)], axis=1) / capacity
    read = linear_states(rates, drive, np.array([290.0, 288.0]), time_s) + rng.normal(0.0, NOISE_K, (200, 2))
    return record_of(time_s, Q=heat, T0=read[:, 0], T1=read[:, 1])


def declared(missing_W: float) -> Trial:
    fit, calibration = fit_network(spec(), [record(missing_W)])
    return Trial((), fit, calibration.max_step_s, (calibration.optimum,))


def test_left_out_blocks_are_predicted_as_by_a_refit() -> None:
    """The formula for leaving a block out against a true fit without it; nearly linear, so they agree to a few percent."""
    calibration = declared(0.0).calibration
    found = blocked_errors(calibration)
    problem = calibration.problem
    (segment,) = problem.segments
    edges = np.linspace(0, segment.measured_K.shape[0], N_BLOCKS + 1).astype(int)
    expected = []
    for first, last in pairwise(edges.tolist()):
        inside = (np.arange(segment.measured_K.shape[0]) >= first) & (np.arange(segment.measured_K.shape[0]) < last)
        rest = replace(segment, measured_K=np.where(inside[:, None], np.nan, segment.measured_K))
        optimum = minimise(replace(problem, segments=(rest,)), calibration.optimum.unknowns)
        error = (segment.measured_K - optimum.fit.predicted_K[0])[inside] / problem.noise_K
        expected.append(float((error**2).sum()))
    np.testing.assert_allclose(found, expected, rtol=0.05)


@pytest.fixture(scope="module")
def trials() -> tuple[Trial, Trial]:
    """Return the declared model where 6 W are missing, and the same with a constant heat."""
    base = declared(6.0)
    start = REGISTRY["constant_heat_load"]({"node": "n1"}, {"Q_W": 1.0})
    return base, try_effects(base, [start], n_passes=12)


def test_the_right_effect_is_fitted_and_supported(trials: tuple[Trial, Trial]) -> None:
    base, right = trials
    assert right.effects[0].values["Q_W"] == pytest.approx(6.0, rel=0.1)
    evidence = weigh(base, right, 10)
    assert evidence.log_bayes_factor > 10.0
    assert evidence.p_value < 1e-4
    validation = validate(base, right)
    assert validation.ratio < 0.5
    assert validation.blocks_better > 0.7


def test_evidence_pays_for_parameters_and_candidates(trials: tuple[Trial, Trial]) -> None:
    """Schwarz: half ln n per parameter; ln m for m candidates; the p-value after Wilks and Bonferroni."""
    base, right = trials
    gain = right.fit.log_posterior - base.fit.log_posterior
    for tried in (1, 40):
        evidence = weigh(base, right, tried)
        assert evidence.log_bayes_factor == pytest.approx(gain - 0.5 * np.log(400) - np.log(tried))
        assert evidence.p_value == pytest.approx(min(1.0, tried * chi2.sf(2.0 * gain, 1)))


def test_a_superfluous_effect_is_not_supported() -> None:
    base = declared(0.0)
    useless = REGISTRY["constant_heat_load"]({"node": "n1"}, {"Q_W": 0.0})
    evidence = weigh(base, try_effects(base, [useless], n_passes=12), 1)
    assert evidence.log_bayes_factor < 0.0
    assert evidence.p_value > 1e-3
