"""The rollout: the heat balance integrated from one initial state, with exact sensitivities.

The implicit scheme's equations of a whole stretch of steps are solved together by Newton's method: the heat balance is
evaluated once for all points (vectorised), the linear recursion runs compiled. A stretch that does not converge is cut
in half, down to one step.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.network.dynamics import Balance, evaluate_balance, fill_boundaries
from twin_core.network.model import Network
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.kernels import GAMMA, march, march_sensitivities

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
        if solved is None:
            if stretch == 1:
                return Rollout(out, start_K, False)
            stretch, near = max(1, (last - done) // 4), None
            continue
        out[done:last] = solved
        state, done, stretch = solved[-1, 1], last, min(STRETCH, stretch * 2)
    return Rollout(out, start_K, True)


def _newton(
    network: Network,
    values: FloatArray,
    start_K: FloatArray,
    forcing: Forcing,
    first: int,
    last: int,
    guess: FloatArray,
) -> FloatArray | None:
    """Solve steps first..last-1 together; None if Newton's method does not settle."""
    n_steps, n_nodes = last - first, start_K.size
    stages = np.clip(guess, *LIMIT_K)
    change_before = np.inf
    for iteration in range(N_NEWTON if n_steps > 1 else 2 * N_NEWTON):
        balance = balance_along(network, values, forcing, stages, first, last)
        jacobian, rate = balance.jacobian, balance.rate_K_per_s.reshape(n_steps, 2, n_nodes)
        solved = march(
            forcing.step_s[first:last],
            jacobian.constant,
            jacobian.row,
            jacobian.column,
            jacobian.moving.reshape(n_steps, 2, jacobian.row.size),
            rate,
            stages,
            start_K,
            GAMMA,
        )
        change = float(np.abs(solved - stages).max())
        if not np.isfinite(change):
            return None
        inside = solved.min() >= LIMIT_K[0] and solved.max() <= LIMIT_K[1]
        # Newton's method contracts: the next change is no larger than this one times the last contraction (Hairer and
        # Wanner 1996, section IV.8), and the pass that would only confirm it is spared.
        contraction = min(1.0, change / change_before) if iteration > 0 else 1.0
        if change * contraction < TOLERANCE_K:
            return solved if inside else None
        # A step across a kink may swing from one side to the other: half the way ends that.
        stages = 0.5 * (solved + stages) if n_steps == 1 and iteration > 8 else solved
        stages = stages if inside else np.clip(stages, *LIMIT_K)
        if iteration > 8 and change > change_before and n_steps > 1:
            return None
        change_before = change
    return None


def balance_along(
    network: Network,
    values: FloatArray,
    forcing: Forcing,
    stages_K: FloatArray,
    first: int,
    last: int,
    *,
    derivatives: bool = False,
    extra_W: FloatArray | None = None,
) -> Balance:
    """Evaluate the heat balance at the stages of steps first..last-1, flattened to (2 n_steps, ...).

    ``extra_W`` (n_steps, n_nodes) is heat beyond the network's terms; a capacity answers to it as to any other.
    """
    boundaries = fill_boundaries(network, values, forcing.boundaries_flat_K(first, last))
    along = forcing.along(stages_K.reshape(-1, stages_K.shape[2]), boundaries, first, last)
    extra = None if extra_W is None else np.repeat(extra_W, 2, axis=0)
    return evaluate_balance(network, values, along, derivatives=derivatives, extra_W=extra)


def sensitivities(
    network: Network,
    values: FloatArray,
    forcing: Forcing,
    trajectory: Rollout,
    start_columns: FloatArray,
    n_free: int,
    observed: IntArray,
) -> Iterator[tuple[slice, FloatArray]]:
    """Yield d observed state / d (free parameters, start columns) at the samples, stretch by stretch.

    Parameters
    ----------
    network, values, forcing, trajectory
        A converged rollout.
    start_columns : (n_nodes, n_columns)
        d start / d column: columns beyond ``n_free`` belong to the initial state.
    n_free
        Number of leading columns that are the network's free parameters.
    observed : (n_observed,)
        States wanted.

    Yields
    ------
    slice, (n_samples_here, n_observed, n_columns)
        Which samples, and their derivatives: exact for the discrete scheme.
    """
    state = start_columns.astype(np.float64)
    n_nodes = state.shape[0]
    for first in range(0, max(forcing.n_steps, 1), 2 * STRETCH):
        last = min(first + 2 * STRETCH, forcing.n_steps)
        low = int(np.searchsorted(forcing.sample_step, first, side="left" if first == 0 else "right"))
        high = int(np.searchsorted(forcing.sample_step, last, side="right"))
        balance = balance_along(
            network, values, forcing, trajectory.stages_K[first:last], first, last, derivatives=True
        )
        block, state = march_sensitivities(
            forcing.step_s[first:last],
            balance.jacobian_per_s.reshape(-1, 2, n_nodes, n_nodes),
            balance.entry_free,
            balance.entry_node,
            balance.entry_series.reshape(balance.entry_free.size, last - first, 2),
            state,
            forcing.sample_step[low:high] - first,
            observed,
            GAMMA,
        )
        yield slice(low, high), block
