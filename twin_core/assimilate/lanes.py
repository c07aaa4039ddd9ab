"""The filter of many twins at once, compiled: the twin is the innermost index, so that every loop is one over twins.

The same step as that of one twin (``simulate.kernels``, ``gp.kalman``): the exponential trapezoidal rule from the filtered
mean, its exact transition, then the readings one by one in Joseph form. As the balance is linearised about the filtered mean
itself, one pass is what the passes of the filter of one twin come to.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from twin_core._typing import BoolArray, FloatArray, IntArray
from twin_core.simulate.modes import phi

REST_K = 1e-12
"""The end of each step is iterated until no node moves by more, in K: a thousandth of the 1e-9 K that are promised."""
N_FIXED = 40
"""A step that takes more iterations is left to the filter of one twin, which goes on with Newton's method. So many are enough
wherever each at least halves the error (2**-40 = 1e-12): steps well below the time constants do much better."""


class Lanes(NamedTuple):
    """Twins with as many nodes and steps each, sensors at the same nodes; leaders compute covariances for those that follow.

    Attributes
    ----------
    step_s : (n_steps, n_twins)
    rate_per_s : (n, n_twins)
    outward, inward : (n, n, n_twins)
        The modes of A.
    linear, fourth : (n, n, n_twins)
        Rates beside A: linear @ T + fourth @ T^4 + given.
    given : (n_steps, 2, n, n_twins)
        In K/s, at the begin and the end of each step.
    mean_K : (n, n_twins)
        Where the first step begins; overwritten by the mean where the last one ends.
    leader : (n_twins,)
        Whose covariance is a twin's own, as a position among the leaders.
    twin : (n_leaders,)
        Which twin a leader is.
    covariance_K2 : (n, n, n_leaders)
        Overwritten likewise.
    density_K2_per_s : (n, n_leaders)
    noise_K2 : (n_sensors, n_leaders)
    node : (n_sensors,)
        Which node each sensor reads.
    reading_K : (n_steps, n_sensors, n_twins)
        At the end of each step; NaN where there is none.
    """

    step_s: FloatArray
    rate_per_s: FloatArray
    outward: FloatArray
    inward: FloatArray
    linear: FloatArray
    fourth: FloatArray
    given: FloatArray
    mean_K: FloatArray
    leader: IntArray
    twin: IntArray
    covariance_K2: FloatArray
    density_K2_per_s: FloatArray
    noise_K2: FloatArray
    node: IntArray
    reading_K: FloatArray


@njit(cache=True, nogil=True)
def _apply(matrix: FloatArray, vector: FloatArray, out: FloatArray) -> None:
    """Write matrix @ vector, (n, n, n_twins) and (n, n_twins)."""
    n, n_twins = vector.shape
    for i in range(n):
        for b in range(n_twins):
            out[i, b] = matrix[i, 0, b] * vector[0, b]
        for j in range(1, n):
            for b in range(n_twins):
                out[i, b] += matrix[i, j, b] * vector[j, b]


@njit(cache=True, nogil=True)
def _rates(lanes: Lanes, k: int, side: int, state: FloatArray, power: FloatArray, out: FloatArray) -> None:
    """Write the rates beside A at one side of a step; ``power`` is scratch."""
    n, n_twins = state.shape
    for i in range(n):
        for b in range(n_twins):
            square = state[i, b] * state[i, b]
            power[i, b] = square * square
            out[i, b] = lanes.given[k, side, i, b]
    for i in range(n):
        for j in range(n):
            for b in range(n_twins):
                out[i, b] += lanes.linear[i, j, b] * state[j, b] + lanes.fourth[i, j, b] * power[j, b]


@njit(cache=True, nogil=True)
def _end(
    lanes: Lanes, k: int, whole: FloatArray, late: FloatArray, state: FloatArray, is_linear: bool,
    ahead: FloatArray, left: BoolArray,
) -> None:  # fmt: skip
    """Write the end of step k from its begin ``state``; marks the twins whose end does not come to rest."""
    n, n_twins = state.shape
    mode, beside, pushed = np.empty((n, n_twins)), np.empty((n, n_twins)), np.empty((n, n_twins))
    base, power = np.empty((n, n_twins)), np.empty((n, n_twins))
    _apply(lanes.inward, state, mode)
    _rates(lanes, k, 0, state, power, beside)
    _apply(lanes.inward, beside, pushed)
    for i in range(n):
        for b in range(n_twins):
            base[i, b] = whole[i, b] * (lanes.rate_per_s[i, b] * mode[i, b] + pushed[i, b]) - late[i, b] * pushed[i, b]
            ahead[i, b] = state[i, b]
    change = np.empty(n_twins)
    for _ in range(N_FIXED):
        _rates(lanes, k, 1, ahead, power, beside)
        _apply(lanes.inward, beside, pushed)
        for i in range(n):
            for b in range(n_twins):
                pushed[i, b] = base[i, b] + late[i, b] * pushed[i, b]
        _apply(lanes.outward, pushed, beside)
        change[:] = 0.0
        for i in range(n):
            for b in range(n_twins):
                new = state[i, b] + beside[i, b]
                change[b] = max(change[b], abs(new - ahead[i, b]))
                ahead[i, b] = new
        if is_linear or change.max() < REST_K:
            return
    for b in range(n_twins):
        if not change[b] < REST_K:
            left[b] = True


@njit(cache=True, nogil=True)
def _transition(
    lanes: Lanes, keep: FloatArray, whole: FloatArray, late: FloatArray, state: FloatArray, ahead: FloatArray,
    is_linear: bool, forward: FloatArray, matrix: FloatArray,
) -> None:  # fmt: skip
    """Write d end / d begin of a step of every leader, (n, n, n_leaders): (1 - L J_1)^-1 (K + E J_0)."""
    n, n_leaders = state.shape[0], lanes.twin.size
    for i in range(n):
        for j in range(n):
            for l in range(n_leaders):
                forward[i, j, l] = 0.0
            for m in range(n):
                for l in range(n_leaders):
                    b = lanes.twin[l]
                    forward[i, j, l] += lanes.outward[i, m, b] * keep[m, b] * lanes.inward[m, j, b]
    if is_linear:
        return
    early, slope = np.empty((n, n, n_leaders)), np.empty((2, n, n, n_leaders))
    for i in range(n):
        for j in range(n):
            for l in range(n_leaders):
                b = lanes.twin[l]
                fourth = 4.0 * lanes.fourth[i, j, b]
                slope[0, i, j, l] = lanes.linear[i, j, b] + fourth * state[j, b] * state[j, b] * state[j, b]
                slope[1, i, j, l] = lanes.linear[i, j, b] + fourth * ahead[j, b] * ahead[j, b] * ahead[j, b]
    for side in range(2):
        for i in range(n):
            for j in range(n):
                for l in range(n_leaders):
                    early[i, j, l] = 0.0
                for m in range(n):
                    for l in range(n_leaders):
                        b = lanes.twin[l]
                        weight = late[m, b] if side == 1 else whole[m, b] - late[m, b]
                        early[i, j, l] += lanes.outward[i, m, b] * weight * lanes.inward[m, j, b]
        for i in range(n):
            for j in range(n):
                for l in range(n_leaders):
                    if side == 1:
                        matrix[i, j, l] = 1.0 if i == j else 0.0
                for m in range(n):
                    for l in range(n_leaders):
                        if side == 0:
                            forward[i, j, l] += early[i, m, l] * slope[0, m, j, l]
                        else:
                            matrix[i, j, l] -= early[i, m, l] * slope[1, m, j, l]
    _solve(matrix, forward)


@njit(cache=True, nogil=True)
def _solve(matrix: FloatArray, right: FloatArray) -> None:
    """Replace ``right`` by matrix^-1 right; near one, as these are, a matrix needs no pivots."""
    n, n_leaders = matrix.shape[0], matrix.shape[2]
    factor = np.empty(n_leaders)
    for p in range(n):
        for i in range(n):
            if i == p:
                continue
            for l in range(n_leaders):
                factor[l] = matrix[i, p, l] / matrix[p, p, l]
            for j in range(p + 1, n):
                for l in range(n_leaders):
                    matrix[i, j, l] -= factor[l] * matrix[p, j, l]
            for j in range(n):
                for l in range(n_leaders):
                    right[i, j, l] -= factor[l] * right[p, j, l]
    for i in range(n):
        for j in range(n):
            for l in range(n_leaders):
                right[i, j, l] /= matrix[i, i, l]


@njit(cache=True, nogil=True)
def _spread(lanes: Lanes, k: int, forward: FloatArray, work: FloatArray) -> None:
    """Advance the covariances over step k: F P F' + Q."""
    cov = lanes.covariance_K2
    n, n_leaders = cov.shape[0], cov.shape[2]
    for i in range(n):
        for j in range(n):
            for l in range(n_leaders):
                work[i, j, l] = 0.0
            for m in range(n):
                for l in range(n_leaders):
                    work[i, j, l] += forward[i, m, l] * cov[m, j, l]
    for i in range(n):
        for j in range(i + 1):
            for l in range(n_leaders):
                cov[i, j, l] = 0.0
            for m in range(n):
                for l in range(n_leaders):
                    cov[i, j, l] += work[i, m, l] * forward[j, m, l]
            for l in range(n_leaders):
                cov[j, i, l] = cov[i, j, l]
        for l in range(n_leaders):
            cov[i, i, l] += lanes.density_K2_per_s[i, l] * lanes.step_s[k, lanes.twin[l]]


@njit(cache=True, nogil=True)
def _update(lanes: Lanes, k: int, gain: FloatArray, variance: FloatArray, deviation: FloatArray) -> None:
    """Condition the covariances on the readings at the end of step k, sensor by sensor; write gains and variances."""
    cov = lanes.covariance_K2
    n, n_leaders, n_sensors = cov.shape[0], cov.shape[2], lanes.node.size
    row = np.empty((n, n_leaders))
    for s in range(n_sensors):
        for l in range(n_leaders):
            deviation[s, l] = np.sqrt(cov[lanes.node[s], lanes.node[s], l] + lanes.noise_K2[s, l])
    for s in range(n_sensors):
        at = lanes.node[s]
        for l in range(n_leaders):
            variance[s, l] = cov[at, at, l] + lanes.noise_K2[s, l]
        for i in range(n):
            for l in range(n_leaders):
                row[i, l] = cov[at, i, l]
                is_read = not np.isnan(lanes.reading_K[k, s, lanes.twin[l]])
                gain[s, i, l] = row[i, l] / variance[s, l] if is_read else 0.0
        for i in range(n):
            for j in range(n):
                for l in range(n_leaders):
                    cov[i, j, l] -= gain[s, i, l] * row[j, l]
        for i in range(n):
            for l in range(n_leaders):
                row[i, l] = cov[i, at, l] - lanes.noise_K2[s, l] * gain[s, i, l]
        for i in range(n):
            for j in range(n):
                for l in range(n_leaders):
                    cov[i, j, l] -= row[i, l] * gain[s, j, l]
        for i in range(n):
            for j in range(i):
                for l in range(n_leaders):
                    cov[i, j, l] = 0.5 * (cov[i, j, l] + cov[j, i, l])
                    cov[j, i, l] = cov[i, j, l]


@njit(cache=True, nogil=True)
def run(
    lanes: Lanes, is_linear: bool, lowest_K: float, highest_K: float
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Filter all steps of all twins.

    Parameters
    ----------
    lanes
        The twins; means and covariances are advanced in place.
    is_linear
        Whether nothing stands beside A but what is given; else every twin leads itself.
    lowest_K, highest_K
        A twin whose mean leaves these limits is left.

    Returns
    -------
    (n_steps, n_sensors, n_twins), (n_steps, n_sensors, n_leaders), (n_steps, n_twins), (n_twins,)
        Innovations, their standard deviations, NIS, all at the ends of steps, and which twins are left to another filter.
    """
    n_steps, n_twins = lanes.step_s.shape
    n, n_leaders, n_sensors = lanes.mean_K.shape[0], lanes.twin.size, lanes.node.size
    innovation = np.empty((n_steps, n_sensors, n_twins))
    deviation = np.empty((n_steps, n_sensors, n_leaders))
    nis, left = np.full((n_steps, n_twins), np.nan), np.zeros(n_twins, dtype=np.bool_)
    keep, whole, late = np.empty((n, n_twins)), np.empty((n, n_twins)), np.empty((n, n_twins))
    ahead, mean = np.empty((n, n_twins)), lanes.mean_K
    forward, matrix = np.empty((n, n, n_leaders)), np.empty((n, n, n_leaders))
    gain, variance = np.empty((n_sensors, n, n_leaders)), np.empty((n_sensors, n_leaders))
    for k in range(n_steps):
        for b in range(n_twins):
            if k == 0 or lanes.step_s[k, b] != lanes.step_s[k - 1, b]:
                for i in range(n):
                    zeroth, first, second, _ = phi(lanes.step_s[k, b] * lanes.rate_per_s[i, b])
                    keep[i, b] = zeroth
                    whole[i, b], late[i, b] = lanes.step_s[k, b] * first, lanes.step_s[k, b] * second
        _end(lanes, k, whole, late, mean, is_linear, ahead, left)
        _transition(lanes, keep, whole, late, mean, ahead, is_linear, forward, matrix)
        mean[:] = ahead
        for i in range(n):
            for b in range(n_twins):
                if not (mean[i, b] > lowest_K and mean[i, b] < highest_K):
                    left[b] = True
        _spread(lanes, k, forward, matrix)
        for s in range(n_sensors):
            for b in range(n_twins):
                innovation[k, s, b] = lanes.reading_K[k, s, b] - mean[lanes.node[s], b]
        _update(lanes, k, gain, variance, deviation[k])
        for s in range(n_sensors):
            for b in range(n_twins):
                reading = lanes.reading_K[k, s, b]
                if not np.isnan(reading):
                    l = lanes.leader[b]
                    surprise = reading - mean[lanes.node[s], b]
                    for i in range(n):
                        mean[i, b] += gain[s, i, l] * surprise
                    square = surprise * surprise / variance[s, l]
                    nis[k, b] = square if np.isnan(nis[k, b]) else nis[k, b] + square
                    if not variance[s, l] > 0.0:
                        left[b] = True
    return innovation, deviation, nis, left
