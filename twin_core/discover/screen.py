"""Screening: how much of the residual each candidate could explain, beyond what the calibrated parameters could.

The linearised response of the sensors to every candidate is propagated at once about temperatures close to the measured ones,
whitened in a metric of what else the readings hold (see :mod:`twin_core.discover.metric`), and projected off what the calibrated
parameters can mimic.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from twin_core._typing import FloatArray
from twin_core.calibrate.containment import check_time
from twin_core.calibrate.starting import channel_levels
from twin_core.calibrate.undeclared.model import HeatFit, Nominal
from twin_core.discover.metric import Metric, beside_heat
from twin_core.effects.base import Effect, Survey
from twin_core.network.dynamics import fill_boundaries
from twin_core.network.surroundings import surround
from twin_core.network.terms import Along
from twin_core.simulate.response import heat_response
from twin_core.simulate.stages import balance_along

COLUMNS_AT_ONCE, VALUES_AT_ONCE = 256, 2e6
"""Responses held at once: so many columns, and so many numbers (16 MB, of which some copies exist meanwhile): a long record is
gone through in portions."""

UNSEEN_SHARE = 1e-4
"""A candidate whose response is this close to what the nuisance parameters can mimic is not told by the data."""


@dataclass(frozen=True)
class Probe:
    """One candidate at one setting, screened.

    Attributes
    ----------
    start
        The candidate as it came, at its null amplitude.
    effect
        At the amplitude that explains most.
    gain
        Log-likelihood that it could add, in nats, at fixed noise.
    """

    start: Effect
    effect: Effect
    gain: float


@dataclass(frozen=True)
class Screening:
    """All probes of one calibration, best first, and how many candidates there were."""

    probes: tuple[Probe, ...]
    n_tried: int


def survey_of(fit: HeatFit) -> Survey:
    """Return what candidates see of the training record: temperatures close to the measured ones, and inputs."""
    network, values = fit.problem.network, fit.values
    parts: list[Along] = []
    rates = []
    for nominal in fit.nominals:
        forcing, stages = nominal.segment.forcing, nominal.stages_K
        flat = forcing.boundaries_flat_K(0, forcing.n_steps)
        filled = fill_boundaries(network, values, flat)
        points = forcing.along(stages.reshape(-1, stages.shape[2]), filled, 0, forcing.n_steps)
        parts.append(surround(network, values, points).along)
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
        network.terms,
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
        given_K=np.concatenate([p.declared_K for p in parts]),
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
        forcing, stages = nominal.segment.forcing, nominal.stages_K
        balance = balance_along(network, fit.values, forcing, stages, 0, forcing.n_steps, extra_W=nominal.extra_W)
        heats = [(k, node, series[window]) for k, (heat, _) in enumerate(columns) for node, series in heat]
        block = heat_response(balance, forcing, heats, len(columns), network.sensor_node)
        at = np.maximum(2 * forcing.sample_step - 1, 0)
        for column, (_, readings) in enumerate(columns):
            for sensor, series in readings:
                block[:, sensor, column] += series[window][at]
        blocks.append(block)
    return blocks


def screen(fit: HeatFit, survey: Survey, candidates: Iterable[Effect]) -> Screening:
    """Screen candidate effects against the innovations of a fit.

    Parameters
    ----------
    fit
        The model so far, fitted in the presence of undeclared heat.
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
    """Screen candidate effects at several sizes of the undeclared heat, as shares of the fitted one: see :func:`screen`.

    The responses are the same for all; only their metric changes.
    """
    return screen_in([partial(beside_heat, fit, share) for share in shares], fit, survey, candidates)


def screen_in(
    metrics: Sequence[Callable[[], Metric]], fit: HeatFit, survey: Survey, candidates: Iterable[Effect]
) -> list[Screening]:
    """Screen candidate effects in several metrics, about the temperatures of one fit: see :func:`screen`."""
    n_tried, probes, under_way = 0, [list[Probe]() for _ in metrics], list[Future[list[Probe]]]()
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # metrics side by side, while the next responses are calculated
        built = [pool.submit(metric) for metric in metrics]
        grounds = [metric.result() for metric in built]
        for effects, edges, blocks in _portions(fit, survey, candidates):
            n_tried += len(effects)
            for found, done in zip(probes, under_way, strict=False):
                found += done.result()
            under_way = [pool.submit(_probes, effects, edges, metric, blocks) for metric in grounds]
        for found, done in zip(probes, under_way, strict=False):
            found += done.result()
    return [Screening(tuple(sorted(found, key=lambda p: -p.gain)), n_tried) for found in probes]


def projected_responses(fit: HeatFit, survey: Survey, effects: Sequence[Effect]) -> tuple[list[FloatArray], FloatArray]:
    """Return the whitened responses to a few effects, projected off the nuisance parameters, and the residual likewise.

    Returns
    -------
    list of (n_rows, n_amplitudes), (n_rows,)
    """
    metric = beside_heat(fit)
    basis, residual = metric.basis, metric.residual
    found: list[FloatArray] = []
    for _, edges, blocks in _portions(fit, survey, effects):
        whitened = metric.whiten(blocks)
        whitened = np.vstack([whitened, np.zeros((basis.shape[0] - whitened.shape[0], whitened.shape[1]))])
        projected = whitened - basis @ (basis.T @ whitened)
        found += [projected[:, a:b] for a, b in pairwise(edges)]
    return found, residual


def _portions(
    fit: HeatFit, survey: Survey, effects: Iterable[Effect]
) -> Iterator[tuple[list[Effect], list[int], list[FloatArray]]]:
    """Yield effects, where the columns of each begin and end, and the responses, as many as fit into memory at once."""
    limit = min(COLUMNS_AT_ONCE, VALUES_AT_ONCE / sum(n.segment.measured_K.size for n in fit.nominals))
    some: list[Effect] = []
    columns: list[Column] = []
    edges = [0]
    for effect in effects:
        check_time()
        own = list(zip(effect.unit_heats(survey), effect.unit_readings(survey), strict=True))
        if some and len(columns) + len(own) > limit:
            yield some, edges, responses(fit, survey, columns)
            some, columns, edges = [], [], [0]
        some.append(effect)
        columns += own
        edges.append(len(columns))
    if some:
        yield some, edges, responses(fit, survey, columns)


def _probes(
    effects: Sequence[Effect], edges: Sequence[int], metric: Metric, blocks: Sequence[FloatArray]
) -> list[Probe]:
    """Return the probes of candidates that the data tell and whose best amplitudes are physical.

    ``edges`` are where the columns of each begin and end in the responses ``blocks``. The basis of the metric is orthonormal,
    off it the residual is projected: P'P = W'W - (B'W)'(B'W) and P'r = W'r of the projected responses P, which need not be
    formed. Candidates with equally many amplitudes go through the algebra at once; those whose responses are no numbers are
    left out.
    """
    whitened, basis, residual = metric.whiten(blocks), metric.basis, metric.residual
    n_rows = whitened.shape[0]
    along, inside = residual[:n_rows] @ whitened, basis[:n_rows].T @ whitened
    columns = np.ascontiguousarray(whitened.T)
    sane = np.isfinite(along)
    n_amplitudes = np.diff(edges)
    found: list[Probe] = []
    for k in np.unique(n_amplitudes).tolist():
        at = np.asarray(edges)[:-1, None] + np.arange(k)
        which = np.flatnonzero(n_amplitudes == k)
        which = which[sane[at[which]].all(axis=1)]
        at = at[which]
        own, mimicked = columns[at], inside.T[at]
        squares = own @ own.transpose(0, 2, 1)
        products = squares - mimicked @ mimicked.transpose(0, 2, 1)
        scale = np.sqrt(np.maximum(np.diagonal(squares, axis1=1, axis2=2), 1e-300))
        told, directions = np.linalg.eigh(products / scale[:, None, :] / scale[:, :, None])
        seen = (told > UNSEEN_SHARE) & (scale > 1e-150).any(axis=1, keepdims=True)
        root = np.sqrt(np.where(seen, told, 1.0))
        gained = np.where(seen, np.einsum("eij,ei->ej", directions, along[at] / scale) / root, 0.0)
        amounts = np.einsum("eij,ej->ei", directions, gained / root) / scale
        for e, candidate in enumerate(which.tolist()):
            start, largest = effects[candidate], float(np.max(np.abs(amounts[e])))
            share = min(1.0, start.linear_up_to / max(largest, 1e-300))
            moved = start.with_amplitudes(share * amounts[e]) if seen[e].any() else None
            if moved is not None:
                found.append(Probe(start, moved, share * (1.0 - 0.5 * share) * float(gained[e] @ gained[e])))
    return found


def joint_gain(first: FloatArray, second: FloatArray, residual: FloatArray) -> float:
    """Return the log-likelihood that two effects could add together, in nats, from their projected responses."""
    both = np.hstack([first, second])
    left, singular, _ = np.linalg.svd(both / np.maximum(np.linalg.norm(both, axis=0), 1e-300), full_matrices=False)
    along = left[:, singular > np.sqrt(UNSEEN_SHARE)].T @ residual
    return 0.5 * float(along @ along)
