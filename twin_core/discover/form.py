"""The form of a finding: a name stands for a law, so nothing that repeats with temperature may be left where it acts,
and the declared quantities must be left where they may be."""

from collections.abc import Sequence

import numpy as np

from twin_core.discover.confirm import Trial, try_effects, weigh
from twin_core.discover.shortlist import LATENT_SHARES, schwarz_gain, screened
from twin_core.effects.base import Effect, touched_nodes
from twin_core.parameters.transforms import Log

N_REFITS, N_RIVALS = 6, 2
OUTDONE_NATS = 15.0
"""A free form contains the smooth laws, so beside a true one it is about as likely: only one far likelier tells of another."""

FAR_STD = 3.0
"""A declared guess counts as left behind beyond so many standard deviations of its prior: a factor of twenty."""


def leaves_declaration(simple: Trial, rich: Trial) -> bool:
    """Return whether effects hold only where a declared guess is far off, which the simpler model left in its place.

    A node whose capacity and couplings grow twenty-fold can take any heat: the effects then describe another spacecraft.
    """
    before = _prior_distances(simple)
    return any(z > FAR_STD and z > before.get(name, 0.0) for name, z in _prior_distances(rich).items())


def _prior_distances(trial: Trial) -> dict[str, float]:
    """Return how far the fitted values lie from what was declared, in standard deviations of the prior."""
    free, parameters = trial.calibration.optimum.unknowns, trial.fit.problem.network.parameters
    declared = [parameters.parameters[i] for i in parameters.free_index]
    return {
        p.name: abs(float(value) - p.free) / p.prior_std
        for p, value in zip(declared, free[: len(declared)], strict=True)
        if p.prior_std and not p.guessed and p.transform == Log()
    }


def leaves_a_repeatable_heat(trial: Trial, effects: Sequence[Effect], needed: float) -> bool:
    """Return whether a free form of temperature is supported on top of named effects, at the nodes where they act.

    A law that merely resembles what is missing leaves the difference behind: not noise, not a wandering heat, but one
    that comes back with the temperature. Then the heat is repeatable and the name is not.

    Parameters
    ----------
    trial
        With the effects, fitted.
    effects
        Those of the trial that are to be named.
    needed
        Log Bayes factor from which the free form counts as supported.
    """
    best, n_tried = _free_forms(trial, effects, needed)
    tops = (try_effects(trial, (*trial.effects, effect), n_passes=10) for effect in best[:N_REFITS])
    return any(weigh(trial, top, n_tried).log_bayes_factor > needed for top in tops)


def outdone_by_a_free_form(simple: Trial, trial: Trial, effects: Sequence[Effect], needed: float) -> bool:
    """Return whether a free form of temperature in the place of named effects is far likelier than they are.

    Where the heat visits one flank of a curve, another law with a kink or two comes near all of it: what is left then is
    small beside the heat, but the free form needs none of it.

    Parameters
    ----------
    simple
        Without the effects.
    trial, effects, needed
        As in :func:`leaves_a_repeatable_heat`.
    """
    best, _ = _free_forms(simple, effects, needed)
    instead = (try_effects(simple, (*simple.effects, effect), n_passes=10) for effect in best[:N_RIVALS])
    return any(weigh(rival, trial, 1).log_bayes_factor < -OUTDONE_NATS for rival in instead)


def _free_forms(trial: Trial, effects: Sequence[Effect], needed: float) -> tuple[list[Effect], int]:
    """Return the free forms on top of a trial at the nodes where effects act, the best first, and how many places."""
    layout = trial.fit.network.layout
    nodes = {node for effect in effects for node in touched_nodes(effect, layout)}
    n_tried, best = 1, dict[object, tuple[float, Effect]]()
    for screening in screened(trial, trial.fit, LATENT_SHARES, fallback=True):
        probes = [probe for probe in screening.probes if probe.effect.where["node"] in nodes]
        n_tried = max(n_tried, len({probe.effect.place for probe in probes}))
        for probe in probes:
            worth, form = schwarz_gain(probe, trial.n_samples), (probe.effect.place, len(probe.effect.amplitudes))
            if probe.gain > needed and worth > best.get(form, (-np.inf, probe.effect))[0]:
                best[form] = worth, probe.effect
    return [effect for _, effect in sorted(best.values(), key=lambda item: -item[0])], n_tried
