"""The rollout: the heat balance integrated from one initial state.

Steps are taken in the nodes' enthalpies: a capacity that changes within a step takes up all of its heat, and the implicit
equations have one solution where the heats fall as the temperatures rise. Those of a whole stretch of steps are solved
together by Newton's method: the heat balance is evaluated once for all points (vectorised), the linear recursion runs
compiled. A stretch that does not converge is cut, down to one step; behind a sharp capacity the leading steps that do are kept.
"""

from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.network.model import Network
from twin_core.network.storage import to_enthalpy_K, to_temperatures_K
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.kernels import GAMMA, march
from twin_core.simulate.stages import balance_along

STRETCH = 1024
"""Steps solved together at first: long enough to vectorise well, short enough for Newton to converge from a constant."""

TOLERANCE_K = 1e-7
N_NEWTON = 25
LIMIT_K = (0.5, 5.0e3)
"""Temperatures that Newton's iterates may visit; a solution at a limit is not a solution."""


@dataclass(frozen=True)
class Rollout:
    """A trajectory.

    Attributes
    ----------
    stages_K : (n_steps, 2, n_nodes)
        Stage states; the second stage is the end of the step.
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
    n_nodes = start_K.size
    out = np.full((forcing.n_steps, 2, n_nodes), np.nan)
    state, done, stretch = start_K.astype(np.float64), 0, STRETCH
    while done < forcing.n_steps:
        last = min(done + stretch, forcing.n_steps)
        guess = np.broadcast_to(state, (last - done, 2, n_nodes)) if near is None else near[done:last]
        solved = _newton(network, values, state, forcing, done, last, guess)
        n_solved = solved.shape[0]
        if n_solved == 0 and stretch == 1:
            return Rollout(out, start_K, False)
        if n_solved < last - done:
            stretch, near = max(1, n_solved, (last - done) // 4), None
        else:
            stretch = min(STRETCH, stretch * 2)
        if n_solved > 0:
            out[done : done + n_solved] = solved
            state, done = solved[-1, 1], done + n_solved
    return Rollout(out, start_K, True)


def _newton(
    network: Network,
    values: FloatArray,
    start_K: FloatArray,
    forcing: Forcing,
    first: int,
    last: int,
    guess: FloatArray,
) -> FloatArray:
    """Solve steps first..last-1 together for the enthalpies; return the stage states of leading steps that have settled.

    A step settles once those before it have: where the method takes long for all, it has not been in vain for the first.
    """
    n_steps, n_nodes = last - first, start_K.size
    shape = (n_steps, 2, n_nodes)
    temperatures = np.clip(guess, *LIMIT_K)
    start, stages = to_enthalpy_K(network, values, start_K), to_enthalpy_K(network, values, temperatures)
    lowest, highest = (to_enthalpy_K(network, values, np.full(n_nodes, limit)) for limit in LIMIT_K)
    change_before, settled = np.inf, 0
    for iteration in range(N_NEWTON if n_steps > 1 else 2 * N_NEWTON):
        balance = balance_along(network, values, forcing, temperatures, first, last)
        jacobian, rate = balance.jacobian, (balance.heat_W / balance.own_J_per_K).reshape(shape)
        solved = march(
            forcing.step_s[first:last],
            jacobian.constant,
            jacobian.row,
            jacobian.column,
            jacobian.moving.reshape(n_steps, 2, jacobian.row.size),
            rate,
            stages,
            start,
            GAMMA,
        )
        changes = np.abs(solved - stages).max(axis=(1, 2))
        change = float(changes.max())
        if not np.isfinite(change):
            return solved[:0]
        inside = bool((solved >= lowest).all() and (solved <= highest).all())
        # Newton's method contracts: the next change is no larger than this one times the last contraction (Hairer and
        # Wanner 1996, section IV.8), and the pass that would only confirm it is spared.
        contraction = min(1.0, change / change_before) if iteration > 0 else 1.0
        if change * contraction < TOLERANCE_K:
            settled = n_steps
            break
        # A sharp capacity holds the method up step by step. What else does is a relay's switching, no place to cut at.
        settled = int(np.argmax(changes >= TOLERANCE_K)) if network.capacities else 0
        # A step across a kink may swing from one side to the other: half the way ends that.
        stages = 0.5 * (solved + stages) if n_steps == 1 and iteration > 8 else solved
        stages = stages if inside else np.clip(stages, lowest, highest)
        temperatures = to_temperatures_K(network, values, stages, temperatures, LIMIT_K)
        if iteration > 8 and change > change_before and n_steps > 1:
            break
        change_before = change
    leading = solved[:settled]
    if not ((leading >= lowest).all() and (leading <= highest).all()):
        return solved[:0]
    return to_temperatures_K(network, values, leading, temperatures[:settled], LIMIT_K)
