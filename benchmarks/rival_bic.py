"""A rival: greedy forward selection by BIC, refitted on open-loop trajectories, white noise assumed.

What a careful user would script on top of the same simulator and the same candidates. For time's sake only the six best screened
places are refitted at every step, and four effects are the most.
"""

import numpy as np

from benchmarks.rival_residual import Regressed
from twin_core.calibrate.summary import to_model
from twin_core.discover.shortlist import best_of_each_place, screened
from twin_core.discover.trial import Trial, try_on_trajectories

N_REFITS = 6
MAX_EFFECTS = 4


def bic(trial: Trial) -> float:
    """Return the Bayesian information criterion of a calibrated trial; every sensor has a white noise of its own."""
    problem, total = trial.calibration().problem, 0.0
    residual = np.concatenate(trial.calibration().residuals)
    for column in residual.T:
        seen = column[np.isfinite(column)]
        total += seen.size * np.log(np.mean(seen**2)) if seen.size else 0.0
    return float(total + problem.n_unknowns * np.log(np.isfinite(residual).sum()))


def greedy_bic(base: Trial) -> Regressed:
    """Add one effect at a time, the one with the lowest BIC, until none lowers it."""
    trial = base
    while len(trial.effects) < MAX_EFFECTS:
        probes = screened(trial, trial.fit, (1.0,), fallback=False)[0].probes
        ranked = best_of_each_place(probes, trial.n_samples)[:N_REFITS]
        refits = [try_on_trajectories(trial, [*trial.present_effects, probe.effect]) for probe in ranked]
        best = min((t for t in refits if t is not None), key=bic, default=trial)
        if bic(best) >= bic(trial):
            break
        trial = best
    named: list[dict[str, object]] = [{"effect": e.name, "where": e.where} for e in trial.present_effects]
    return Regressed(named, to_model(trial.calibration(), trial.present_effects, uncertain=False))
