"""Metrics of screening against least squares with dense covariances, in which gradients of any size are part of the noise."""

import numpy as np
import pytest

from tests.twin_core.calibrate import body_with_gradients
from twin_core._typing import FloatArray
from twin_core.calibrate.gradients import BIOT, WithGradients, with_gradients
from twin_core.calibrate.second_order import fit_network
from twin_core.discover.metric import beside_gradients
from twin_core.discover.screen import responses, screen_in, survey_of
from twin_core.discover.trial import about_trajectory
from twin_core.effects import REGISTRY
from twin_core.network.spec_io import load_spec

HEAT_W = 6.0


@pytest.fixture(scope="module")
def found() -> WithGradients:
    """Two bodies with gradients, an undeclared heat at the first one."""
    record = body_with_gradients.record(1.0, heat_W=HEAT_W)
    _, calibration = fit_network(load_spec(body_with_gradients.spec()), [record])
    gradients = with_gradients(calibration.problem, calibration.optimum)
    assert gradients is not None
    return gradients


def covariances_of(found: WithGradients, is_white: bool) -> list[FloatArray]:
    """Return the dense covariance of each sensor's readings, gradients of any size in it."""
    covariances = []
    for noise, white_K, flows in zip(found.whitener.models, found.problem.noise_K, found.flows_K, strict=True):
        apart_s = np.abs(found.whitener.time_s[:, None] - found.whitener.time_s)
        coloured = noise.sigma_ou**2 * np.exp(-apart_s / noise.length_s) + noise.sigma_white**2 * np.eye(len(flows))
        own = white_K**2 * np.eye(len(flows)) if is_white else coloured
        covariances.append(own + BIOT**2 * flows @ flows.T)
    return covariances


def least_squares(found: WithGradients, covariances: list[FloatArray], columns: FloatArray) -> tuple[float, FloatArray]:
    """Solve for the unknowns, with their priors, and the amounts of k more columns, (n_rows, n_sensors, k).

    Returns
    -------
    float, (k,)
        Half the least squared residual, and the amounts.
    """
    mean, std = found.problem.prior()
    (block,) = found.problem.jacobian_blocks(found.optimum.unknowns, found.optimum.fit)
    left_K = np.concatenate(found.residuals)
    rows, right = [], []
    for sensor, covariance in enumerate(covariances):
        root = np.linalg.inv(np.linalg.cholesky(covariance))
        with_their_gradients = left_K[:, sensor] + found.flows_K[sensor] @ found.biot[sensor]
        rows.append(root @ np.hstack([block[:, sensor], columns[:, sensor]]))
        right.append(root @ with_their_gradients)
    rows.append(np.hstack([np.diag(1.0 / std), np.zeros((std.size, columns.shape[2]))]))
    right.append((mean - found.optimum.unknowns) / std)
    design, data = np.vstack(rows), np.concatenate(right)
    scale = np.linalg.norm(design, axis=0)
    amount, *_ = np.linalg.lstsq(design / scale, data, rcond=None)
    left = data - design / scale @ amount
    return 0.5 * float(left @ left), (amount / scale)[block.shape[2] :]


@pytest.mark.parametrize("is_white", [False, True])
def test_the_gain_beside_gradients_is_that_of_dense_least_squares(found: WithGradients, is_white: bool) -> None:
    covariances = covariances_of(found, is_white)
    about = about_trajectory(found.problem, found.optimum)
    survey = survey_of(about)
    candidates = [
        REGISTRY["constant_heat_load"]({"node": "n0"}, {"Q_W": 0.0}),
        REGISTRY["constant_heat_load"]({"node": "n1"}, {"Q_W": 0.0}),
        REGISTRY["input_gain"]({"channel": "Q"}, {"g": 1.0}),
        *REGISTRY["sensor_drift"].starts({"sensor": "T1"}, survey),
    ]
    (screening,) = screen_in([lambda: beside_gradients(found, is_white=is_white)], about, survey, candidates)
    assert len(screening.probes) >= 3  # an amplitude that cannot be is no probe
    before, _ = least_squares(found, covariances, np.zeros((400, 2, 0)))
    for probe in screening.probes:
        columns = list(zip(probe.start.unit_heats(survey), probe.start.unit_readings(survey), strict=True))
        (block,) = responses(about, survey, columns)
        gained = before - least_squares(found, covariances, block)[0]
        assert probe.gain == pytest.approx(gained, rel=1e-6, abs=1e-6)


def test_what_is_missing_leads_beside_gradients(found: WithGradients) -> None:
    """It is as large as least squares make it: the other unknowns are where they made up for it."""
    about = about_trajectory(found.problem, found.optimum)
    survey = survey_of(about)
    candidates = [REGISTRY["constant_heat_load"]({"node": node}, {"Q_W": 0.0}) for node in ("n1", "n0")]
    for is_white in (False, True):
        metric = beside_gradients(found, is_white=is_white)
        np.testing.assert_allclose(metric.basis.T @ metric.basis, np.eye(metric.basis.shape[1]), atol=1e-9)
        np.testing.assert_allclose(metric.basis.T @ metric.residual, 0.0, atol=1e-8)
        (screening,) = screen_in([lambda metric=metric: metric], about, survey, candidates)
        start = screening.probes[0].effect
        assert start.where == {"node": "n0"}
        columns = list(zip(start.unit_heats(survey), start.unit_readings(survey), strict=True))
        _, amount = least_squares(found, covariances_of(found, is_white), responses(about, survey, columns)[0])
        assert start.values["Q_W"] == pytest.approx(amount[0], rel=1e-6)
        assert start.values["Q_W"] == pytest.approx(HEAT_W, rel=0.25)
