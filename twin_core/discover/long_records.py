"""Long records: the search looks at every k-th sample, and the models before and after are calibrated on all of them.

What a candidate costs grows with the samples. What tells effects apart hardly does: neighbouring samples share their misfit.
"""

import numpy as np

from twin_core.calibrate.approach import coarse_problem
from twin_core.calibrate.optimise import ADVICE, minimise
from twin_core.calibrate.undeclared.fit import fit_with_undeclared_heat
from twin_core.discover.trial import Trial, about_trajectory, carried_over, extended, fitted_effects

LONGEST = 4000
"""Samples that a search looks at; of a record of twice as many or more every k-th."""


def searched(base: Trial) -> tuple[Trial, int]:
    """Return the declared model on what a search looks at of its record, and of how many samples it looks at one.

    Parameters
    ----------
    base
        The declared model on the whole training record; returned as it is where that is short.
    """
    whole, unknowns = base.fit.problem, base.calibration().optimum.unknowns
    problem = coarse_problem(whole, base.max_step_s, LONGEST)
    if problem is whole:
        return base, 1
    stride = round(whole.n_samples / problem.n_samples)
    fit = fit_with_undeclared_heat(problem, base.fit.free, early_prior_std=(np.inf,) * 3)
    return Trial((), fit, stride * base.max_step_s, (minimise(problem, unknowns),)), stride


def on_all_samples(base: Trial, found: Trial) -> Trial:
    """Return a trial that was found on a thinned record, calibrated on the whole one, started from where it stands.

    Raises
    ------
    ArithmeticError
        If the balance has no solution there.
    """
    if found.fit.problem.n_samples == base.fit.problem.n_samples:
        return found
    effects = found.present_effects
    problem = extended(base.fit.problem, effects)
    values = {p.name: p.value for effect in effects for p in effect.parameters()}
    calibration = found.calibration()
    optimum = minimise(problem, carried_over(calibration.problem, calibration.optimum.unknowns, problem, values))
    if optimum.status == "no_solution":
        raise ArithmeticError(ADVICE["no_solution"])
    fit = about_trajectory(problem, optimum)
    return Trial(fitted_effects(effects, fit.network.parameters.as_dict()), fit, base.max_step_s, (optimum,))
