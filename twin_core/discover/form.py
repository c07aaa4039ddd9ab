"""The form of a finding: a name stands for a law, so nothing that repeats with temperature may be left where it acts,
and the declared quantities must be left where they may be."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from twin_core.calibrate.containment import attempted
from twin_core.discover.evidence import weigh
from twin_core.discover.shortlist import UNDECLARED_SHARES, schwarz_gain, screened
from twin_core.discover.trial import Trial, explained, try_effects
from twin_core.effects.base import Effect, touched_nodes
from twin_core.side_by_side import both, side_by_side

N_REFITS, N_RIVALS = 6, 2


@dataclass(frozen=True)
class Repeatable:
    """The likeliest free form of temperature on top of a trial.

    Attributes
    ----------
    log_bayes_factor
        For it; minus infinity where none is worth a refit.
    removed
        By how much it lowers the variance of open-loop residuals, in units of the sensors' noise, mean over sensors.
    """

    log_bayes_factor: float = -np.inf
    removed: float = 0.0


def repeatable_heat(trial: Trial, nodes: Collection[str], needed: float) -> Repeatable:
    """Return what a free form of temperature removes on top of a trial, at some nodes.

    A law that merely resembles what is missing leaves the difference behind where it acts: not noise, not a wandering heat,
    but one that comes back with the temperature. Then the heat is repeatable and the name is not. If more of it is left
    elsewhere, it is no remainder of the name: something else is missing, or the network is coarse.

    Parameters
    ----------
    trial
        With the effects that are to be named, fitted.
    nodes
        Where the free form may act.
    needed
        Log Bayes factor from which a free form is worth a refit.
    """
    forms, n_tried = _free_forms(trial, nodes, needed)
    return _repeatable(trial, _refitted([(trial, form) for form in forms[:N_REFITS]]), n_tried)


def against_free_forms(
    simple: Trial, trial: Trial, nodes: Collection[str], effects: Sequence[Effect], needed: float, most: float
) -> tuple[Repeatable, float | None]:
    """Return what a free form of temperature removes beside named effects, and what one in their place removes more.

    The latter only where it is far likelier: where the heat visits one flank of a curve, another law with a kink or two comes
    near all of it: what is left then is small beside the heat, but the free form needs none of it.

    Parameters
    ----------
    simple
        Without the effects.
    trial, effects
        With the effects, fitted, and those that are to be named.
    nodes
        Where a free form beside them may act.
    needed
        Log Bayes factor from which a free form is worth a refit.
    most
        Log Bayes factor up to which what is left does not count.

    Returns
    -------
    Repeatable
    float, or None
        Variance of open-loop residuals, in units of the sensors' noise, mean over sensors.
    """
    (beside, n_tried), (instead, _) = both(
        partial(_free_forms, trial, nodes, needed), partial(_free_forms, simple, acts_at(simple, effects), needed)
    )
    beside, instead = beside[:N_REFITS], instead[:N_RIVALS]
    fits = _refitted([*((trial, form) for form in beside), *((simple, form) for form in instead)])
    left, rivals = fits[: len(beside)], fits[len(beside) :]
    return both(partial(_repeatable, trial, left, n_tried), partial(_removed_more, simple, trial, rivals, most))


def _repeatable(trial: Trial, options: Sequence[Trial | None], n_tried: int) -> Repeatable:
    """Return what the likeliest of some trials with a free form on top removes."""
    for top in _likeliest(trial, options):
        return Repeatable(weigh(trial, top, n_tried).log_bayes_factor, explained(trial, top))
    return Repeatable()


def _removed_more(simple: Trial, trial: Trial, rivals: Sequence[Trial | None], most: float) -> float | None:
    """Return what the likeliest rival of a trial removes more than it, if it is far likelier."""
    likelier = [r for r in _likeliest(simple, rivals) if weigh(r, trial, 1).log_bayes_factor < -most]
    return max((trial.unexplained() - rival.unexplained() for rival in likelier), default=None)


def more_is_left_elsewhere(
    trial: Trial, effects: Sequence[Effect], needed: float, here: Repeatable | None = None
) -> bool:
    """Return whether a free form of temperature on top of named effects is likelier away from where they act than there.

    Parameters
    ----------
    trial, effects
        With the effects, fitted, and those that are to be named.
    needed
        Log Bayes factor from which a free form is worth a refit.
    here
        The likeliest one where they act; None where it is not known yet.
    """
    own = acts_at(trial, effects)
    away = repeatable_heat(trial, set(trial.fit.network.layout.nodes) - own, needed).log_bayes_factor
    return away > needed and away > (here or repeatable_heat(trial, own, needed)).log_bayes_factor


def _refitted(options: Sequence[tuple[Trial, Effect]]) -> list[Trial | None]:
    """Return trials with an effect on top of each, side by side; None for one whose arithmetic fails."""

    def refitted(trial: Trial, effect: Effect) -> Trial | None:
        return attempted(partial(try_effects, trial, (*trial.effects, effect), n_passes=6), effect.label, [])

    return side_by_side([partial(refitted, *option) for option in options])


def _likeliest(simple: Trial, options: Sequence[Trial | None]) -> Sequence[Trial]:
    """Return the likeliest option beside wandering heat, alone: weighing one in full takes open-loop trajectories."""
    fitted = [option for option in options if option is not None]
    return sorted(fitted, key=lambda trial: -weigh(simple, trial, 1, quick=True).log_bayes_factor)[:1]


def acts_at(trial: Trial, effects: Sequence[Effect]) -> set[str]:
    """Return the nodes at which effects act."""
    return {node for effect in effects for node in touched_nodes(effect, trial.fit.network.layout)}


def _free_forms(trial: Trial, nodes: Collection[str], needed: float) -> tuple[list[Effect], int]:
    """Return the free forms on top of a trial at some nodes, the best first, and how many places."""
    n_tried, best = 1, dict[object, tuple[float, Effect]]()
    if not nodes:
        return [], n_tried
    for screening in screened(trial, trial.fit, UNDECLARED_SHARES, fallback=True, nodes=nodes):
        n_tried = max(n_tried, len({probe.effect.place for probe in screening.probes}))
        for probe in screening.probes:
            worth, form = schwarz_gain(probe, trial.n_samples), (probe.effect.place, len(probe.effect.amplitudes))
            if probe.gain > needed and worth > best.get(form, (-np.inf, probe.effect))[0]:
                best[form] = worth, probe.effect
    return [effect for _, effect in sorted(best.values(), key=lambda item: -item[0])], n_tried
