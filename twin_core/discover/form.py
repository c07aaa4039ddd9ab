"""The form of a finding: a name stands for a law, so nothing that repeats with temperature may be left where it acts."""

from collections.abc import Sequence

from twin_core.discover.confirm import Trial, try_effects, weigh
from twin_core.discover.shortlist import LATENT_SHARES, best_of_each_place, screened, shortlist
from twin_core.effects.base import Effect, touched_nodes

N_REFITS = 3


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
    layout = trial.fit.network.layout
    nodes = {node for effect in effects for node in touched_nodes(effect, layout)}
    rankings = [
        best_of_each_place([p for p in screening.probes if p.effect.where["node"] in nodes], trial.n_samples)
        for screening in screened(trial, trial.fit, LATENT_SHARES, fallback=True)
    ]
    n_tried = max(map(len, rankings))
    free = shortlist(rankings, needed, N_REFITS)
    tops = (try_effects(trial, (*trial.effects, effect), n_passes=10) for effect in free)
    return any(weigh(trial, top, n_tried).log_bayes_factor > needed for top in tops)
