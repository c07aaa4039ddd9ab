"""What assumed inputs missed in the past, over the same horizon, pushed through the balance once more."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit

from twin_core._typing import FloatArray, IntArray
from twin_core.forecast.assumed import APART_S, Rule
from twin_core.network.model import Network
from twin_core.network.spec import TwinSpec
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.rollout import Rollout
from twin_core.simulate.together import Variants, rollouts

MOST_ORIGINS = 1024
"""Moments of the past that are looked at; the most alike of them are used."""
MEMBERS = 48
"""The 5 and 95 % quantiles lie two or three members from the ends."""
FEWEST_MEMBERS = 12
MOST_MEMBER_STEPS = 400_000
"""Time steps of all members together; long horizons get fewer members."""
FEWEST_STRETCHES = 3
"""Two degrees of freedom: with one Student's interval is four times as wide, of a spread that nobody knows."""
GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


@dataclass(frozen=True)
class Missed:
    """How far inputs went from what would have been assumed: channel -> (n_members, n_steps, 2), in SI.

    ``known_s`` is the longest lead time of which the past tells anything. Members scatter too little by ``widening``: they
    come from no more independent stretches than horizons fit into the past.
    """

    errors: Mapping[str, FloatArray]
    n_members: int
    known_s: float
    widening: float


def missed(rules: Mapping[str, Rule], now_s: float, forcing: Forcing) -> Missed | None:
    """Return what the rules missed at moments of the past that were like the present; None where that is nothing.

    A moment is alike if the channel's value was near that of now: what a held heater did after it was off tells what it
    will do when it is off now. Of the nearest quarter the moments are taken evenly over time. Channels of one period share
    their moments, so that what happens together stays together; others are drawn each by itself, so that few episodes of
    each make many of all.

    Parameters
    ----------
    rules
        Of the channels without a plan.
    now_s
        The present, on the axis of their past.
    forcing
        Of the forecast.
    """
    varying = {name: rule for name, rule in rules.items() if rule.past.varies}
    horizon_s = float(forcing.stage_time_s[-1, 1]) - now_s
    most = int(np.clip(MOST_MEMBER_STEPS // max(forcing.n_steps, 1), FEWEST_MEMBERS, MEMBERS))
    lead = forcing.stage_time_s - now_s
    errors: dict[str, FloatArray] = {}
    known, stretches = [horizon_s], [np.inf]
    rng = np.random.default_rng(0)
    for group in _together(varying):
        first = max(float(r.past.time_s[0]) + (r.period_s or 0.0) for r in group.values())
        # at most half of the past is what is told, so that moments remain from which it is told
        known_s = min(horizon_s, 0.5 * (now_s - first))
        if known_s <= 0.0:
            continue
        # quasi-random moments: no beat with any period, and any part of them is spread evenly
        origins = first + (now_s - known_s - first) * ((0.5 + GOLDEN * np.arange(MOST_ORIGINS)) % 1.0)
        alike = _alike(group, origins, now_s)
        chosen = rng.permutation(np.resize(origins[alike[:most]], most))
        known.append(known_s)
        stretches.append((now_s - first) / known_s)
        errors |= {name: _errors(rule, chosen, lead, known_s) for name, rule in group.items()}
    errors = {name: error for name, error in errors.items() if np.any(error)}
    return Missed(errors, most, min(known), widening(min(stretches))) if errors else None


def widening(n_independent: float) -> float:
    """Return by what factor a 90 % interval has to be wider because mean and spread come from so few: Student's t."""
    n = max(n_independent, FEWEST_STRETCHES)
    return float(stdtrit(n - 1.0, 0.95) * np.sqrt(1.0 + 1.0 / n) / ndtri(0.95))


def _together(rules: Mapping[str, Rule]) -> list[dict[str, Rule]]:
    """Return the channels in groups of one own period, to 1 %; those without one each alone."""
    groups: list[tuple[float | None, dict[str, Rule]]] = []
    for name, rule in rules.items():
        own = None if rule.past.period is None else rule.past.period.period_s
        same = [g for s, g in groups if s is not None and own is not None and abs(s - own) <= 0.01 * own]
        if same:
            same[0][name] = rule
        else:
            groups.append((own, {name: rule}))
    return [group for _, group in groups]


def _alike(rules: Mapping[str, Rule], origins: FloatArray, now_s: float) -> IntArray:
    """Return the origins at which the channels were like now: the nearest quarter, ties included, in their own order."""
    distance = np.zeros(origins.size)
    for rule in rules.values():
        there, here = rule.past.at(origins), rule.past.at(np.array([now_s]))
        distance += (there - here) ** 2 / float(rule.past.column.var())
    return np.flatnonzero(distance <= np.quantile(distance, 0.25))


def _errors(rule: Rule, origins: FloatArray, lead_s: FloatArray, known_s: float) -> FloatArray:
    """Return what a channel did less what its rule says, (n_origins, n_steps, 2); of one that holds the mean over a step.

    Beyond what the past tells, a repeated channel misses at each phase what it did before, a held one what it did last.
    """
    if rule.period_s is not None and rule.period_s <= known_s:
        whole = np.ceil(np.maximum(lead_s[:, 1:] - known_s, 0.0) / rule.period_s)
        lead_s = lead_s - whole * rule.period_s
    lead_s = np.minimum(lead_s, known_s)
    at = origins[:, None, None]
    if not rule.past.held:
        return rule.past.at(at + lead_s) - rule.ahead(at, lead_s)
    missed_s = rule.past.integral(at + lead_s) - rule.integral_ahead(at, lead_s)
    length_s = np.diff(lead_s)
    late = np.flatnonzero(length_s <= APART_S)
    mean = np.diff(missed_s, axis=2) / np.where(length_s > APART_S, length_s, 1.0)
    mean[:, late] = rule.past.at(at + lead_s[late, 1:]) - rule.ahead(at, lead_s[late, 1:])
    return np.repeat(mean, 2, axis=2)


def deviations_K(
    network: Network,
    values: FloatArray,
    forcing: Forcing,
    path: Rollout,
    rules: Mapping[str, Rule],
    found: Missed,
    wanted: IntArray,
) -> FloatArray:
    """Return how the observed states of each member differ from those of the forecast, (n_members, n_wanted, n_sensors).

    Each member is a rollout of its own, so that what saturates, switches or radiates does so. A member whose inputs have
    no solution is left out.
    """
    spec, node = network.spec, network.sensor_node
    column = {boundary.channel: i for i, boundary in enumerate(spec.boundaries.values()) if boundary.channel}
    inputs = {
        name: _possible(spec, name, forcing.inputs[name] + error, rules[name])
        for name, error in found.errors.items()
        if name in forcing.inputs
    }
    boundaries_K = {
        column[name]: forcing.boundaries_K[:, :, column[name]] + error
        for name, error in found.errors.items()
        if name in column
    }
    variants = Variants(inputs, boundaries_K, found.n_members)
    after = forcing.sample_step[wanted]
    members = rollouts(network, values, forcing, path, variants, node, after)
    deviations = members[np.isfinite(members[:, -1]).all(axis=1)] - path.at_samples(after)[:, node]
    if not deviations.shape[0]:
        return deviations
    mean = deviations.mean(axis=0)
    return np.asarray(mean + found.widening * (deviations - mean))


def _possible(spec: TwinSpec, name: str, series: FloatArray, rule: Rule) -> FloatArray:
    """Return an input that is one: within what it was ever seen at, on one of its levels."""
    seen = rule.past.column
    if spec.channels[name].levels:
        levels = np.unique(seen)
        return levels[np.abs(series[..., None] - levels).argmin(axis=-1)]
    return np.clip(series, seen.min(), seen.max())
