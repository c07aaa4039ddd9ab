"""Newton steps that neither fall below a bound nor go beyond what a linearisation can tell."""

from collections.abc import Callable

import numpy as np

from twin_core._typing import FloatArray

Solver = Callable[[FloatArray, FloatArray], FloatArray]
"""Hessian (n, n) and gradient (n,) -> step (n,)."""


def bounded_step(
    solve: Solver, hessian: FloatArray, gradient: FloatArray, lowest: FloatArray, highest: FloatArray
) -> FloatArray:
    """Return a Newton step within bounds.

    Unknowns that would leave them are put on their bound, and the others solved for again: what they do on their own is
    worth nothing where it reckons with a move that the bound forbids (projected Newton; Bertsekas, SIAM J. Control
    Optim. 20, 1982).

    Parameters
    ----------
    solve
        How a step is found without bounds.
    hessian : (n, n)
    gradient : (n,)
    lowest, highest : (n,)
        Of the step: at most and at least 0; infinite where there is no bound.
    """
    step = solve(hessian, gradient)
    held = np.zeros(step.size, dtype=np.bool_)
    while ((step < lowest) | (step > highest)).any():
        held |= (step < lowest) | (step > highest)
        free, fixed = ~held, np.clip(step, lowest, highest)[held]
        step = np.clip(step, lowest, highest)
        step[free] = solve(hessian[np.ix_(free, free)], gradient[free] + hessian[np.ix_(free, held)] @ fixed)
    return step
