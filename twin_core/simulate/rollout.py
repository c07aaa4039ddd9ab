"""The rollout: the heat balance integrated from one initial state.

Steps are taken by the exponential trapezoidal rule of ``kernels``, in the nodes' enthalpies: a capacity that changes within a
step takes up all of its heat. Where every term is a coupling (``splitting``) one compiled pass is the solution. The other
terms are evaluated for all points of a stretch at once and linearised, and the passes repeated until nothing changes:
Newton's method for a whole stretch. One that does not converge is cut, down to one step; behind a sharp capacity the leading
steps that do are kept.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.network.model import Network
from twin_core.network.storage import to_enthalpy_K, to_temperatures_K
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.kernels import NOT_NEAR, march
from twin_core.simulate.splitting import Split, anchor_K, limits, stretches

TOLERANCE_K = 1e-7
N_NEWTON = 25
LIMIT_K = (0.5, 5.0e3)
"""Temperatures that iterates may visit; a solution at a limit is not a solution."""

MOST_PIECES = 16
"""Pieces into which a candidate's stretch may be cut (see :func:`hurried`): one that makes sense takes a few, one that has run
away hundreds."""

_most_pieces: ContextVar[float] = ContextVar("most_pieces", default=np.inf)


@contextmanager
def hurried() -> Iterator[None]:
    """Give up rollouts in this thread that would take many times the usual work: they are then not converged."""
    token = _most_pieces.set(MOST_PIECES)
    try:
        yield
    finally:
        _most_pieces.reset(token)


@dataclass(frozen=True)
class Rollout:
    """A trajectory.

    Attributes
    ----------
    stages_K : (n_steps, 2, n_nodes)
        States at the begin and the end of each step.
    start_K : (n_nodes,)
    converged
        False where the balance has no solution within physical temperatures; the states are then NaN from there on.
    """

    stages_K: FloatArray
    start_K: FloatArray
    converged: bool

    def at_samples(self, sample_step: IntArray) -> FloatArray:
        """Return the states at the samples, (n_samples, n_nodes)."""
        return np.concatenate([self.start_K[None], self.stages_K[:, 1]])[sample_step]


def rollout(
    network: Network, values: FloatArray, start_K: FloatArray, forcing: Forcing, *, near: FloatArray | None = None
) -> Rollout:
    """Integrate the network over a forcing.

    Parameters
    ----------
    network
        Network with its terms.
    values : (n_parameters,)
    start_K : (n_nodes,)
        Initial temperatures.
    forcing
        Steps, inputs and boundary temperatures.
    near : (n_steps, 2, n_nodes)
        A trajectory close by, from which Newton's method starts.

    Returns
    -------
    Rollout
        Converged to 1e-7 K, or with ``converged`` False.
    """
    out = np.full((forcing.n_steps, 2, start_K.size), np.nan)
    state, about_K = start_K.astype(np.float64), None
    for first, last in stretches(forcing.n_steps, start_K.size):
        about_K = anchor_K(state, about_K)
        split = Split.at(network, values, forcing, first, last, about_K)
        n_solved = _stretch(split, state, out[first:last], None if near is None else near[first:last])
        if n_solved < last - first:
            return Rollout(out, start_K, False)
        state = out[last - 1, 1]
    return Rollout(out, start_K, True)


def _stretch(split: Split, start_K: FloatArray, out: FloatArray, near: FloatArray | None) -> int:
    """Write the states of the steps of a stretch to ``out``; return how many have a solution."""
    n_steps = out.shape[0]
    if not split.others:
        left, given = split.remainder(None, out, split.first, split.last)
        low, high = limits(split.network, split.values, LIMIT_K)
        step_s = split.forcing.step_s[split.first : split.last]
        guess = NOT_NEAR if near is None else near
        solved, _, n_solved = march(step_s, split.modes, left, split.relays, given, start_K[None], guess, low, high)
        out[:n_solved] = solved[:n_solved]
        return n_solved
    state, done, stretch, n_pieces = start_K, 0, n_steps, 0
    while done < n_steps:
        n_pieces += 1
        if n_pieces > _most_pieces.get():
            return done
        last = min(done + stretch, n_steps)
        guess = np.broadcast_to(state, (last - done, 2, state.size)) if near is None else near[done:last]
        solved = _newton(split, state, split.first + done, split.first + last, guess, near is not None)
        n_solved = solved.shape[0]
        if n_solved == 0 and stretch == 1:
            return done
        if n_solved < last - done:
            stretch, near = max(1, n_solved, (last - done) // 4), None
        else:
            stretch = min(n_steps, stretch * 2)
        if n_solved > 0:
            out[done : done + n_solved] = solved
            state, done = solved[-1, 1], done + n_solved
    return done


def _newton(split: Split, start_K: FloatArray, first: int, last: int, guess: FloatArray, is_near: bool) -> FloatArray:
    """Solve steps first..last-1 together for the enthalpies; return the states of leading steps that have settled.

    ``is_near`` tells whether the guess is a trajectory close by rather than a state that lasts. A step settles once those
    before it have: where the method takes long for all, it has not been in vain for the first.
    """
    network, values, n_steps = split.network, split.values, last - first
    temperatures = np.clip(guess, *LIMIT_K)
    start, stages = to_enthalpy_K(network, values, start_K), to_enthalpy_K(network, values, temperatures)
    lowest, highest = limits(network, values, LIMIT_K)
    step_s = split.forcing.step_s[first:last]
    change_before, settled, n_inside = np.inf, 0, 0
    for iteration in range(N_NEWTON if n_steps > 1 else 2 * N_NEWTON):
        left, given = split.remainder(split.beside(temperatures, first, last), stages, first, last)
        near = stages if is_near or iteration > 0 else NOT_NEAR
        solved, _, n_inside = march(step_s, split.modes, left, split.relays, given, start[None], near, lowest, highest)
        changes = np.abs(solved - stages).max(axis=(1, 2))
        change = float(changes.max())
        if not np.isfinite(change):
            return solved[:0]
        # Newton's method contracts: the next change is no larger than this one times the last contraction (Hairer and
        # Wanner 1996, section IV.8), and the pass that would only confirm it is spared.
        contraction = min(1.0, change / change_before) if iteration > 0 else 1.0
        if change * contraction < TOLERANCE_K:
            settled = n_steps
            break
        # A sharp capacity holds the method up step by step.
        settled = int(np.argmax(changes >= TOLERANCE_K)) if network.capacities else 0
        # A step across a kink may swing from one side to the other: half the way ends that.
        stages = 0.5 * (solved + stages) if n_steps == 1 and iteration > 8 else solved
        temperatures = to_temperatures_K(network, values, stages, temperatures, LIMIT_K)
        if iteration > 8 and change > change_before and n_steps > 1:
            break
        change_before = change
    if settled > n_inside:
        return solved[:0]
    return to_temperatures_K(network, values, solved[:settled], temperatures[:settled], LIMIT_K)
