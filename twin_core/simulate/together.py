"""Rollouts of one network from one state under many forcings at once: the members of an ensemble.

They share steps, capacities and modes, so that a step of all is a product of a matrix with a matrix, member by member in the
innermost loop. Where that will not do (terms beside the couplings, relays, a step that does not come to rest by fixed-point
iteration) each is a rollout of its own.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from twin_core._typing import FloatArray, IntArray
from twin_core.network.model import Network
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.kernels import STEP_K, Remainder
from twin_core.simulate.matrices import multiply_columns
from twin_core.simulate.modes import Modes, weights
from twin_core.simulate.rollout import LIMIT_K, Rollout, rollout
from twin_core.simulate.splitting import LONGEST_STRETCH, Split, anchor_K, stretches

N_FIXED = 20
"""Iterations of a step: contracting by less than a third, as few do, they reach the rounding of a temperature."""
MOST_VALUES = 2_000_000
"""Rates of members that are held at once, 16 MB; more members go in groups."""
MOST_EVALUATED = 100_000
"""Rates that are evaluated at once: what a core's cache holds."""


@dataclass(frozen=True)
class Variants:
    """What replaces inputs and boundaries of a forcing in each member.

    Attributes
    ----------
    inputs : channel -> (n_members, n_steps, 2)
    boundaries_K : column -> (n_members, n_steps, 2)
    n_members
    """

    inputs: Mapping[str, FloatArray]
    boundaries_K: Mapping[int, FloatArray]
    n_members: int

    def part(self, members: slice, steps: slice) -> "Variants":
        """Return some steps of some members."""
        inputs = {name: series[members, steps] for name, series in self.inputs.items()}
        boundaries_K = {column: series[members, steps] for column, series in self.boundaries_K.items()}
        return Variants(inputs, boundaries_K, len(range(*members.indices(self.n_members))))

    def one_after_another(self, forcing: Forcing) -> Forcing:
        """Return the steps of all members as those of one forcing."""
        n = self.n_members
        boundaries_K = np.tile(forcing.boundaries_K, (n, 1, 1))
        for column, series in self.boundaries_K.items():
            boundaries_K[:, :, column] = series.reshape(-1, 2)
        kept = {name: np.tile(series, (n, 1)) for name, series in forcing.inputs.items() if name not in self.inputs}
        return replace(
            forcing,
            step_s=np.tile(forcing.step_s, n),
            stage_time_s=np.tile(forcing.stage_time_s, (n, 1)),
            boundaries_K=boundaries_K,
            inputs=kept | {name: series.reshape(-1, 2) for name, series in self.inputs.items()},
            sun_factor=np.tile(forcing.sun_factor, (n, 1)),
        )


def rollouts(
    network: Network,
    values: FloatArray,
    forcing: Forcing,
    near: Rollout,
    variants: Variants,
    observed: IntArray,
    after: IntArray,
) -> FloatArray:
    """Return the observed states of each member after some steps.

    Parameters
    ----------
    network, values, forcing
        What all have in common.
    near
        A converged rollout over the forcing; the members start where it does.
    variants
        What each member has instead.
    observed : (n_observed,)
        States wanted.
    after : (n_wanted,)
        Steps taken before each instant that is wanted.

    Returns
    -------
    (n_members, n_wanted, n_observed)
        NaN from where a member has no solution.
    """
    found = np.empty((variants.n_members, after.size, observed.size))
    most = max(1, MOST_VALUES // max(2 * min(forcing.n_steps, LONGEST_STRETCH) * near.start_K.size, 1))
    for first in range(0, variants.n_members, most):
        members = slice(first, min(first + most, variants.n_members))
        some = variants.part(members, slice(None))
        ends_K = _at_once(network, values, forcing, near, some, observed)
        if ends_K is None:
            for k, states_K in enumerate(_one_by_one(network, values, forcing, near, some)):
                found[first + k] = states_K[after][:, observed]
        else:
            found[members] = ends_K[after].transpose(2, 0, 1)
    return found


def _one_by_one(
    network: Network, values: FloatArray, forcing: Forcing, near: Rollout, variants: Variants
) -> Iterator[FloatArray]:
    """Yield each member's states before the first and after each step, (n_steps + 1, n_nodes)."""
    for k in range(variants.n_members):
        other = variants.part(slice(k, k + 1), slice(None)).one_after_another(forcing)
        moved = rollout(network, values, near.start_K, other, near=near.stages_K)
        yield moved.at_samples(np.arange(forcing.n_steps + 1))


def _at_once(
    network: Network, values: FloatArray, forcing: Forcing, near: Rollout, variants: Variants, observed: IntArray
) -> FloatArray | None:
    """Return the observed states before the first and after each step, (n_steps + 1, n_observed, n_members); None if not so."""
    if network.capacities:
        return None
    n_members = variants.n_members
    out = np.empty((forcing.n_steps + 1, observed.size, n_members))
    out[0] = near.start_K[observed, None]
    state, about_K = np.tile(near.start_K[:, None], (1, n_members)), None
    for first, last in stretches(forcing.n_steps, near.start_K.size):
        steps = slice(first, last)
        about_K = anchor_K(near.stages_K[first, 0], about_K)
        here = replace(
            forcing,
            step_s=forcing.step_s[steps],
            stage_time_s=forcing.stage_time_s[steps],
            boundaries_K=forcing.boundaries_K[steps],
            inputs={name: series[steps] for name, series in forcing.inputs.items()},
            sun_factor=forcing.sun_factor[steps],
        )
        split = Split.at(network, values, here, 0, here.n_steps, about_K)
        given = _given(split, variants.part(slice(None), steps))
        if given is None:
            return None
        left, _ = split.remainder(None, near.stages_K[:0], 0, here.n_steps)
        n_solved = _march(here.step_s, split.modes, left, given, state, observed, *LIMIT_K, out[first + 1 : last + 1])
        if n_solved < last - first:
            return None
    return out


def _given(split: Split, variants: Variants) -> FloatArray | None:
    """Return the rates of each member that no temperature changes, (n_members, n_steps, 2, n_nodes); None where others are."""
    n_steps, n_members = split.forcing.n_steps, variants.n_members
    given = np.empty((n_members, n_steps, 2, split.about_K.size))
    most = max(1, MOST_EVALUATED // given[0].size)
    for first in range(0, n_members, most):
        some = variants.part(slice(first, first + most), slice(None))
        rates = split.given_by(some.one_after_another(split.forcing))
        if rates is None:
            return None
        given[first : first + most] = rates.reshape(some.n_members, n_steps, 2, -1)
    return given


@njit(cache=True, nogil=True)
def _push(left: Remainder, given: FloatArray, state: FloatArray, out: FloatArray) -> None:
    """Write given + r(state), (n, n_members), to ``out``; no entry moves."""
    out[:] = given
    for e in range(left.linear.size):
        row, column, factor = left.row[e], left.column[e], left.linear[e]
        for m in range(out.shape[1]):
            out[row, m] += factor * state[column, m]
    for e in range(left.fourth.size):
        row, column, factor = left.fourth_row[e], left.fourth_column[e], left.fourth[e]
        for m in range(out.shape[1]):
            square = state[column, m] * state[column, m]
            out[row, m] += factor * (square * square)


@njit(cache=True, nogil=True)
def _march(
    step_s: FloatArray,
    modes: Modes,
    left: Remainder,
    given: FloatArray,
    state: FloatArray,
    observed: IntArray,
    lowest: float,
    highest: float,
    out: FloatArray,
) -> int:
    """Advance the states of all members, (n, n_members), as ``kernels.march`` does those of one; return how many steps rest.

    ``given`` is (n_members, n_steps, 2, n); the observed ends go to ``out``, (n_steps, n_observed, n_members).
    """
    n, n_members = state.shape
    keep, whole, late = np.empty(n), np.empty(n), np.empty(n)
    mode, pushed, right = np.empty((n, n_members)), np.empty((n, n_members)), np.empty((n, n_members))
    base, ahead, moved = np.empty((n, n_members)), np.empty((n, n_members)), np.zeros((n, n_members))
    multiply_columns(modes.inward, state, mode)
    here = np.empty((2, n, n_members))
    at_s, before_s = np.nan, 0.0
    for k in range(step_s.size):
        share = step_s[k] / before_s if k > 0 else 0.0
        before_s = step_s[k]
        if step_s[k] != at_s:
            at_s = step_s[k]
            weights(at_s, modes.rate_per_s, keep, whole, late)
        for m in range(n_members):
            for i in range(n):
                here[0, i, m], here[1, i, m] = given[m, k, 0, i], given[m, k, 1, i]
        _push(left, here[0], state, right)
        multiply_columns(modes.inward, right, pushed)
        for i in range(n):
            for m in range(n_members):
                base[i, m] = whole[i] * (modes.rate_per_s[i] * mode[i, m] + pushed[i, m]) - late[i] * pushed[i, m]
                ahead[i, m] = state[i, m] + share * moved[i, m]
        change, settled = 0.0, False
        for _ in range(N_FIXED):
            _push(left, here[1], ahead, right)
            multiply_columns(modes.inward, right, pushed)
            for i in range(n):
                for m in range(n_members):
                    pushed[i, m] = base[i, m] + late[i] * pushed[i, m]
            multiply_columns(modes.outward, pushed, right)
            most = 0.0
            for i in range(n):
                for m in range(n_members):
                    most = max(most, abs(state[i, m] + right[i, m] - ahead[i, m]))
                    ahead[i, m] = state[i, m] + right[i, m]
            # a fixed-point iteration contracts: the next change is this one times the last contraction
            contraction = most / change if change > most else 1.0
            change = most
            if most * contraction < STEP_K:
                settled = True
                break
        if not settled:
            return k
        for i in range(n):
            for m in range(n_members):
                if not (ahead[i, m] > lowest and ahead[i, m] < highest):
                    return k
                mode[i, m] += pushed[i, m]
                moved[i, m] = ahead[i, m] - state[i, m]
                state[i, m] = ahead[i, m]
        for s in range(observed.size):
            out[k, s] = state[observed[s]]
    return step_s.size
