"""Exact discretisation of linear stochastic differential equations, by series and doubling.

    dx/dt = F x + c(t) + white noise of density D
    x[k+1] = A x[k] + hold c[k] + ramp (c[k]⁻ - c[k]) + w,   w ~ N(0, Q)

with c linear from c[k] at the start of a step to c[k]⁻ at its end. Over a fraction of the step, where the series
converge at once, A = exp(F h), Q = ∫ exp(F s) D exp(F s)ᵀ ds, hold = h φ₁(F h), ramp = h φ₂(F h); then they are doubled:

    Q <- A Q Aᵀ + Q,   φ₂ <- (A φ₂ + φ₁ + φ₂) / 4,   φ₁ <- (A φ₁ + φ₁) / 2,   A <- A A

This is Van Loan's integral without its growing exponential, so a stiff network and a long step cost no digits, and
without the inverse of F, so a singular network is like any other. Van Loan, *Computing integrals involving the matrix
exponential* (1978).
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numba import njit

from twin_core._typing import FloatArray, IntArray
from twin_core.errors import ModelError
from twin_core.gp.kernels import Values
from twin_core.gp.linalg import multiply, transpose

Scheme = Literal["exact", "first-order"]
N_TERMS = 16
"""Terms of the series; at a norm of a quarter the seventeenth is below rounding."""
SAME_STEP = 1e-9
"""Relative difference below which two steps count as one."""


@dataclass(frozen=True)
class Discrete:
    """Discrete matrices, each (n_distinct, n, n); see the module's first lines."""

    transition: Values
    process_cov: Values
    hold: Values
    ramp: Values


@njit(cache=True)
def _series(scaled, noise, a, q, phi_1, phi_2):  # type: ignore[no-untyped-def]
    """Sum the series at a small norm; ``scaled`` = F h, ``noise`` = D h. Real or complex."""
    n = scaled.shape[0]
    power, term, work, turned = np.zeros_like(a), noise.copy(), np.zeros_like(a), np.zeros_like(a)
    for i in range(n):
        power[i, i] = 1.0
    a[:] = power
    phi_1[:] = power
    phi_2[:] = 0.5 * power
    q[:] = noise
    for k in range(1, N_TERMS + 1):
        multiply(scaled, power, work)
        power[:] = work / k
        a += power
        phi_1 += power / (k + 1)
        phi_2 += power / ((k + 1) * (k + 2))
        multiply(scaled, term, work)
        transpose(work, turned)
        term[:] = (work + turned) / (k + 1)
        q += term


@njit(cache=True)
def _double(a, q, phi_1, phi_2, work, turned, grown):  # type: ignore[no-untyped-def]
    """Double the step once."""
    multiply(a, q, work)
    transpose(a, turned)
    multiply(work, turned, grown)
    q += grown
    multiply(a, phi_2, work)
    phi_2[:] = 0.25 * (work + phi_1 + phi_2)
    multiply(a, phi_1, work)
    phi_1[:] = 0.5 * (work + phi_1)
    multiply(a, a, work)
    a[:] = work


@njit(cache=True)
def _discretise(feedback, diffusion, step_s, a, q, hold, ramp):  # type: ignore[no-untyped-def]
    """Fill the matrices of every distinct step."""
    n = feedback.shape[1]
    work, turned, grown = np.zeros_like(feedback[0]), np.zeros_like(feedback[0]), np.zeros_like(feedback[0])
    for d in range(step_s.size):
        f, noise = feedback[d % feedback.shape[0]], diffusion[d % diffusion.shape[0]]
        largest = 0.0
        for i in range(n):
            row = 0.0
            for j in range(n):
                row += abs(f[i, j])
            largest = max(largest, row)
        doublings = 0
        part = step_s[d]
        while largest * part > 0.25:
            part *= 0.5
            doublings += 1
        _series(f * part, noise * part, a[d], q[d], hold[d], ramp[d])
        for _ in range(doublings):
            _double(a[d], q[d], hold[d], ramp[d], work, turned, grown)
        hold[d] *= step_s[d]
        ramp[d] *= step_s[d]


def discretise(feedback: Values, diffusion: Values, step_s: FloatArray, *, scheme: Scheme = "exact") -> Discrete:
    """Discretise over distinct steps.

    Parameters
    ----------
    feedback : (n, n) or (n_distinct, n, n)
        F in 1/s; may be complex (complex step).
    diffusion : (n, n) or (n_distinct, n, n)
        D.
    step_s : (n_distinct,)
        Positive.
    scheme
        ``exact``, or ``first-order``: A exact, Q with exp(F s) ≈ I + F s, hold = h I, as in Kouw et al. (CCTA 2024),
        eqs. 12-15.

    Raises
    ------
    ModelError
        A step is not positive and finite, or a matrix holds a number that is not finite.
    """
    steps = np.atleast_1d(np.asarray(step_s, dtype=np.float64))
    if not (np.isfinite(steps).all() and (steps > 0).all()):
        raise ModelError("steps must be positive and finite: times must increase strictly")
    if scheme not in get_args(Scheme):
        raise ModelError(f"scheme: must be one of {', '.join(get_args(Scheme))}, it is {scheme!r}")
    shapes = (np.shape(feedback)[-2:], np.shape(diffusion)[-2:])
    if len(shapes[0]) != 2 or shapes[0][0] != shapes[0][1] or shapes[0] != shapes[1]:
        raise ModelError(f"feedback and diffusion must be square and of one size; they are {shapes[0]} and {shapes[1]}")
    kind = np.result_type(feedback, diffusion, np.float64)
    f, d = (np.ascontiguousarray(m[None] if m.ndim == 2 else m, dtype=kind) for m in (feedback, diffusion))
    if not (np.isfinite(f).all() and np.isfinite(d).all()):
        raise ModelError(
            "the dynamics or their noise hold a number that is not finite: a parameter is too large or small"
        )
    out = Discrete(*(np.zeros((steps.size, *f.shape[1:]), dtype=kind) for _ in range(4)))
    _discretise(f, d, steps, out.transition, out.process_cov, out.hold, out.ramp)
    return out if scheme == "exact" else _first_order(f, d, steps, out.transition)


def _first_order(f: Values, d: Values, steps: FloatArray, transition: Values) -> Discrete:
    """Return the approximations of the paper: the integral of (I + F s) D (I + F s)ᵀ, and an Euler input."""
    h = steps[:, None, None]
    drift = f @ d
    turned = np.swapaxes(f, 1, 2)
    q = h * d + h**2 / 2.0 * (drift + d @ turned) + h**3 / 3.0 * (drift @ turned)
    hold = h * np.eye(f.shape[1])
    return Discrete(transition, np.broadcast_to(q, transition.shape).copy(), hold + 0.0 * transition, 0.5 * hold)


def distinct_steps(time_s: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the distinct steps of a time axis and which of them each step is.

    Parameters
    ----------
    time_s : (n_times,)
        Strictly increasing.

    Returns
    -------
    (n_distinct,), (n_times - 1,)

    Raises
    ------
    ModelError
        Time does not increase.
    """
    steps = np.diff(np.asarray(time_s, dtype=np.float64))
    if not (np.isfinite(steps).all() and (steps > 0).all()):
        raise ModelError("time must be finite and strictly increasing")
    if steps.size == 0:
        return np.ones(1), np.zeros(0, dtype=np.int64)
    ordered = np.sort(steps)
    starts = np.concatenate([[True], np.diff(ordered) > SAME_STEP * ordered[1:]])
    distinct = ordered[starts]
    index = np.searchsorted(distinct, steps, side="right") - 1
    return distinct, index.astype(np.int64)
