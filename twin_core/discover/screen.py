"""Screening: how much of the residual each candidate could explain, beyond what the calibrated parameters could.

The linearised response of the sensors to every candidate is propagated at once about the smoothed measured temperatures,
whitened in the metric of sensor noise and latent heat, and projected off what the calibrated parameters can mimic.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.calibrate.latent_heat import HeatFit, Nominal, parameter_columns, whiten
from twin_core.calibrate.starting import channel_levels
from twin_core.effects.base import Effect, Survey
from twin_core.network.dynamics import fill_boundaries
from twin_core.network.terms import Along
from twin_core.simulate.kernels import GAMMA, march_sensitivities
from twin_core.simulate.rollout import balance_along

COLUMNS_AT_ONCE = 256
UNSEEN_SHARE = 1e-4
"""A candidate whose response is this close to what the nuisance parameters can mimic is not told by the data."""


@dataclass(frozen=True)
class Probe:
    """One candidate at one setting, screened.

    Attributes
    ----------
    effect
        At the amplitude that explains most.
    gain
        Log-likelihood that it could add, in nats, at fixed noise.
    response : (n_rows, n_amplitudes)
        Whitened response projected off the nuisance parameters.
    """

    effect: Effect
    gain: float
    response: FloatArray


@dataclass(frozen=True)
class Screening:
    """All probes of one calibration, best first, and the projected residual that they were held against."""

    probes: tuple[Probe, ...]
    residual: FloatArray
    n_tried: int


def survey_of(fit: HeatFit) -> Survey:
    """Return what candidates see of the training record: temperatures close to the measured ones, and inputs."""
    network, values = fit.problem.network, fit.values
    parts: list[Along] = []
    rates = []
    for nominal in fit.nominals:
        forcing, stages = nominal.segment.forcing, nominal.steps.stages_K
        flat = forcing.boundaries_flat_K(0, forcing.n_steps)
        filled = fill_boundaries(network, values, flat)
        parts.append(forcing.along(stages.reshape(-1, stages.shape[2]), filled, 0, forcing.n_steps))
        balance = balance_along(network, values, forcing, stages, 0, forcing.n_steps, extra_W=nominal.extra_W)
        rates.append(balance.rate_K_per_s)
    edges = np.cumsum([0] + [part.time_s.size for part in parts])
    records = [n.segment.record for n in fit.nominals]
    levels = {name: channel_levels(records, name) for name, channel in network.spec.channels.items() if channel.levels}
    return Survey(
        network.layout,
        _joined(parts),
        np.concatenate(rates),
        values[network.capacity_index],
        levels,
        tuple(int(e) for e in edges),
        fit.network.parameters.as_dict(),
        np.concatenate([r.clock_s[n.segment.valid.any(axis=1)] for r, n in zip(records, fit.nominals, strict=True)]),
        records[0].epoch_ns is not None,
        np.concatenate([_residual_at_points(nominal) for nominal in fit.nominals]),
    )


def _residual_at_points(nominal: Nominal) -> FloatArray:
    """Return measured minus modelled at the stage points of a segment, (n_points, n_sensors); zero if nothing was read."""
    segment, columns = nominal.segment, []
    for valid, residual in zip(segment.valid.T, nominal.residual_K.T, strict=True):
        time_s, seen = segment.record.time_s[valid], residual[valid]
        points_s = segment.forcing.stage_time_s.ravel()
        columns.append(np.interp(points_s, time_s, seen) if seen.size else np.zeros(points_s.size))
    return np.stack(columns, axis=1)


def _joined(parts: Sequence[Along]) -> Along:
    """Return the points of several segments one after the other; a channel must be in all of them."""
    common = [name for name in parts[0].inputs if all(name in part.inputs for part in parts)]
    return Along(
        np.concatenate([p.time_s for p in parts]),
        np.concatenate([p.temperatures_K for p in parts]),
        np.concatenate([p.boundaries_K for p in parts]),
        {name: np.concatenate([p.inputs[name] for p in parts]) for name in common},
        np.concatenate([p.sun_factor for p in parts]),
    )


Column = tuple[list[tuple[int, FloatArray]], list[tuple[int, FloatArray]]]
"""Unit heats as (node, (n_points,) in W) and unit changes of readings as (sensor, (n_points,) in K)."""


def responses(fit: HeatFit, survey: Survey, columns: Sequence[Column]) -> list[FloatArray]:
    """Return the sensors' linear response to unit heats and to unit changes of readings.

    Parameters
    ----------
    fit
        The model about whose temperatures is linearised.
    survey
        Its points.
    columns
        One per amplitude.

    Returns
    -------
    list of (n_samples, n_sensors, n_columns)
        In K per unit, per segment.
    """
    network, blocks = fit.problem.network, []
    for nominal, window in zip(fit.nominals, survey.segments(), strict=True):
        forcing, stages = nominal.segment.forcing, nominal.steps.stages_K
        balance = balance_along(network, fit.values, forcing, stages, 0, forcing.n_steps, extra_W=nominal.extra_W)
        n = stages.shape[2]
        jacobian = balance.jacobian_per_s.reshape(-1, 2, n, n)
        parts = []
        for first in range(0, len(columns), COLUMNS_AT_ONCE):
            some = columns[first : first + COLUMNS_AT_ONCE]
            rows = [
                (column, node, series[window] / balance.capacity_J_per_K[:, node])
                for column, (heat, _) in enumerate(some)
                for node, series in heat
            ]
            block, _ = march_sensitivities(
                forcing.step_s,
                jacobian,
                np.array([r[0] for r in rows], dtype=np.int64),
                np.array([r[1] for r in rows], dtype=np.int64),
                np.array([r[2] for r in rows]).reshape(len(rows), forcing.n_steps, 2),
                np.zeros((n, len(some))),
                forcing.sample_step,
                network.sensor_node,
                GAMMA,
            )
            at = np.maximum(2 * forcing.sample_step - 1, 0)
            for column, (_, readings) in enumerate(some):
                for sensor, series in readings:
                    block[:, sensor, column] += series[window][at]
            parts.append(block)
        blocks.append(np.concatenate(parts, axis=2))
    return blocks


def _whitened(fit: HeatFit, blocks: Sequence[FloatArray]) -> FloatArray:
    """Return columns of all segments, whitened and flattened to (n_rows, n_columns)."""
    parts = [
        whiten(fit.problem, fit.latent, nominal, block)[0].reshape(block.shape[0] * block.shape[1], block.shape[2])
        for nominal, block in zip(fit.nominals, blocks, strict=True)
    ]
    return np.concatenate(parts)


def nuisance_basis(fit: HeatFit) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal basis of what the parameters can mimic, and the residual projected off it.

    Returns
    -------
    (n_rows + n_free, n_basis), (n_rows + n_free,)
        Whitened; the last n_free rows are the priors.
    """
    return _nuisance(fit, [parameter_columns(fit.problem, fit.values, n) for n in fit.nominals])


def _nuisance(fit: HeatFit, blocks: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    parameters = fit.problem.network.parameters
    std = parameters.prior_std
    design = np.vstack([_whitened(fit, blocks), np.diag(1.0 / std)])
    data = _whitened(fit, [n.residual_K[:, :, None] for n in fit.nominals])[:, 0]
    rows = np.concatenate([data, (parameters.free - fit.free) / std])
    scale = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    left, singular, _ = np.linalg.svd(design / scale, full_matrices=False)
    basis = left[:, singular > 1e-10 * singular[0]] if singular.size else left
    return basis, rows - basis @ (basis.T @ rows)


def screen(fit: HeatFit, survey: Survey, candidates: Iterable[Effect]) -> Screening:
    """Screen candidate effects against the innovations of a fit.

    Parameters
    ----------
    fit
        The model so far, fitted in the presence of latent heat.
    survey
        Its points.
    candidates
        Effects at their null amplitude.

    Returns
    -------
    Screening
        Physically possible probes, best first.
    """
    return screen_sizes(fit, (1.0,), survey, candidates)[0]


def screen_sizes(
    fit: HeatFit, shares: Sequence[float], survey: Survey, candidates: Iterable[Effect]
) -> list[Screening]:
    """Screen candidate effects at several sizes of the latent heat, as shares of the fitted one: see :func:`screen`.

    The responses are the same for all; only their metric changes.
    """
    effects = list(candidates)
    columns: list[Column] = []
    owners = []
    for i, effect in enumerate(effects):
        for column in zip(effect.unit_heats(survey), effect.unit_readings(survey), strict=True):
            columns.append(column)
            owners.append(i)
    nuisance = [parameter_columns(fit.problem, fit.values, n) for n in fit.nominals]
    blocks = responses(fit, survey, columns) if columns else []
    sized = [replace(fit, latent=replace(fit.latent, std_W=share * fit.latent.std_W)) for share in shares]
    return [_screening(one, nuisance, effects, np.array(owners, dtype=np.int64), blocks) for one in sized]


def _screening(
    fit: HeatFit,
    nuisance: Sequence[FloatArray],
    effects: Sequence[Effect],
    owners: IntArray,
    blocks: Sequence[FloatArray],
) -> Screening:
    """Return the probes in the metric of a fit; ``owners`` tells which effect a column of the responses belongs to."""
    basis, residual = _nuisance(fit, nuisance)
    if not blocks:
        return Screening((), residual, 0)
    whitened = _whitened(fit, blocks)
    whitened = np.vstack([whitened, np.zeros((residual.size - whitened.shape[0], whitened.shape[1]))])
    projected = whitened - basis @ (basis.T @ whitened)
    edges = np.searchsorted(owners, np.arange(len(effects) + 1))
    probes = [
        _probe(effect, whitened[:, a:b], projected[:, a:b], residual)
        for effect, (a, b) in zip(effects, pairwise(edges.tolist()), strict=True)
    ]
    found = sorted((p for p in probes if p is not None), key=lambda p: -p.gain)
    return Screening(tuple(found), residual, len(effects))


def _probe(effect: Effect, whitened: FloatArray, projected: FloatArray, residual: FloatArray) -> Probe | None:
    """Return the probe of one candidate; None if the data cannot tell it or its best amplitude is not physical."""
    size = np.linalg.norm(whitened, axis=0)
    if not (size > 0).any():
        return None
    left, singular, right = np.linalg.svd(projected / np.maximum(size, 1e-300), full_matrices=False)
    seen = singular > np.sqrt(UNSEEN_SHARE)
    if not seen.any():
        return None
    along = left[:, seen].T @ residual
    amounts = right[seen].T @ (along / singular[seen]) / np.maximum(size, 1e-300)
    moved = effect.with_amplitudes(amounts)
    return None if moved is None else Probe(moved, 0.5 * float(along @ along), projected)


def joint_gain(first: Probe, second: Probe, residual: FloatArray) -> float:
    """Return the log-likelihood that two probes could add together, in nats."""
    both = np.hstack([first.response, second.response])
    left, singular, _ = np.linalg.svd(both / np.maximum(np.linalg.norm(both, axis=0), 1e-300), full_matrices=False)
    along = left[:, singular > np.sqrt(UNSEEN_SHARE)].T @ residual
    return 0.5 * float(along @ along)
