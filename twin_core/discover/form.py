"""The form of a finding: a name stands for a law, so nothing that repeats with temperature may be left where it acts,
and the declared quantities must be left where they may be."""

from collections.abc import Collection, Sequence

import numpy as np

from twin_core.discover.confirm import Trial, mean_excess, try_effects, weigh
from twin_core.discover.shortlist import UNDECLARED_SHARES, schwarz_gain, screened
from twin_core.effects.base import Effect, touched_nodes

N_REFITS, N_RIVALS = 6, 2


def leaves_a_repeatable_heat(trial: Trial, effects: Sequence[Effect], needed: float, most: float) -> float | None:
    """Return what a free form of temperature removes on top of named effects, at the nodes where they act, if it is supported.

    A law that merely resembles what is missing leaves the difference behind: not noise, not a wandering heat, but one
    that comes back with the temperature. Then the heat is repeatable and the name is not.

    Parameters
    ----------
    trial
        With the effects, fitted.
    effects
        Those of the trial that are to be named.
    needed
        Log Bayes factor from which a free form is worth a refit.
    most
        Log Bayes factor up to which what is left does not count.

    Returns
    -------
    float, or None
        Variance of open-loop residuals, in units of the sensors' noise, mean over sensors.
    """
    worth, top = _likeliest_on_top(trial, _where(trial, effects), needed)
    return mean_excess(trial) - mean_excess(top) if worth > most else None


def outdone_by_a_free_form(
    simple: Trial, trial: Trial, effects: Sequence[Effect], needed: float, most: float
) -> float | None:
    """Return what a free form of temperature removes more than named effects in whose place it is, if it is far likelier.

    Where the heat visits one flank of a curve, another law with a kink or two comes near all of it: what is left then is
    small beside the heat, but the free form needs none of it.

    Parameters
    ----------
    simple
        Without the effects.
    trial, effects, needed, most
        As in :func:`leaves_a_repeatable_heat`, and what is returned as well.
    """
    best, _ = _free_forms(simple, _where(simple, effects), needed)
    instead = [try_effects(simple, (*simple.effects, effect), n_passes=6, quick=True) for effect in best[:N_RIVALS]]
    likelier = [rival for rival in _likeliest(simple, instead) if weigh(rival, trial, 1).log_bayes_factor < -most]
    return max((mean_excess(trial) - mean_excess(rival) for rival in likelier), default=None)


def more_is_left_elsewhere(trial: Trial, effects: Sequence[Effect], needed: float) -> bool:
    """Return whether a free form of temperature on top of named effects is likelier away from where they act than there.

    What repeats with temperature then is no remainder of theirs: something else is missing, or the network is coarse.

    Parameters
    ----------
    trial, effects, needed
        As in :func:`leaves_a_repeatable_heat`.
    """
    own = _where(trial, effects)
    away, _ = _likeliest_on_top(trial, set(trial.fit.network.layout.nodes) - own, needed)
    return away > needed and away > _likeliest_on_top(trial, own, needed)[0]


def _likeliest_on_top(trial: Trial, nodes: Collection[str], needed: float) -> tuple[float, Trial]:
    """Return the log Bayes factor of the likeliest free form at some nodes on top of a trial, and the trial with it.

    Minus infinity and the trial as it is where none is worth a refit.
    """
    best, n_tried = _free_forms(trial, nodes, needed)
    tops = [try_effects(trial, (*trial.effects, effect), n_passes=6, quick=True) for effect in best[:N_REFITS]]
    for top in _likeliest(trial, tops):
        return weigh(trial, top, n_tried).log_bayes_factor, top
    return -np.inf, trial


def _likeliest(simple: Trial, options: Sequence[Trial]) -> Sequence[Trial]:
    """Return the likeliest option beside wandering heat, alone: weighing one in full takes open-loop trajectories."""
    return sorted(options, key=lambda trial: -weigh(simple, trial, 1, quick=True).log_bayes_factor)[:1]


def _where(trial: Trial, effects: Sequence[Effect]) -> set[str]:
    """Return the nodes at which effects act."""
    return {node for effect in effects for node in touched_nodes(effect, trial.fit.network.layout)}


def _free_forms(trial: Trial, nodes: Collection[str], needed: float) -> tuple[list[Effect], int]:
    """Return the free forms on top of a trial at some nodes, the best first, and how many places."""
    n_tried, best = 1, dict[object, tuple[float, Effect]]()
    for screening in screened(trial, trial.fit, UNDECLARED_SHARES, fallback=True, nodes=nodes):
        n_tried = max(n_tried, len({probe.effect.place for probe in screening.probes}))
        for probe in screening.probes:
            worth, form = schwarz_gain(probe, trial.n_samples), (probe.effect.place, len(probe.effect.amplitudes))
            if probe.gain > needed and worth > best.get(form, (-np.inf, probe.effect))[0]:
                best[form] = worth, probe.effect
    return [effect for _, effect in sorted(best.values(), key=lambda item: -item[0])], n_tried
