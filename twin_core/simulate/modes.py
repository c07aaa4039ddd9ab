"""The modes of a linear balance, and the phi functions of the exponential integrator over them."""

from typing import NamedTuple

import numpy as np
from numba import njit

from twin_core._typing import FloatArray, IntArray
from twin_core.simulate.matrices import multiply_columns


class Modes(NamedTuple):
    """A = outward diag(rate) inward.

    Attributes
    ----------
    rate_per_s : (n,)
    outward, inward : (n, n)
        From modes to states, and back.
    """

    rate_per_s: FloatArray
    outward: FloatArray
    inward: FloatArray


class Turning(NamedTuple):
    """How free parameters change A, or C A.

    Attributes
    ----------
    columns : (n_turned,)
        Positions of these parameters among the free ones.
    which, row, column : (n_entries,)
        Position in ``columns``, and place in the matrix; entries at one place add up.
    value : (n_entries,)
        dA / d free parameter, or C dA (W/K per unit of it).
    """

    columns: IntArray
    which: IntArray
    row: IntArray
    column: IntArray
    value: FloatArray

    def dense(self, n_nodes: int) -> FloatArray:
        """Return the matrices, (n_turned, n_nodes, n_nodes)."""
        out = np.zeros((self.columns.size, n_nodes, n_nodes))
        np.add.at(out, (self.which, self.row, self.column), self.value)
        return out

    def per(self, capacity_J_per_K: FloatArray) -> "Turning":
        """Return dA / d free parameter from C dA, the capacities being (n_nodes,)."""
        return self._replace(value=self.value / capacity_J_per_K[self.row])


_NOTHING = np.zeros(0, dtype=np.int64)
NO_TURNING = Turning(_NOTHING, _NOTHING, _NOTHING, _NOTHING, np.zeros(0))


@njit(cache=True, nogil=True)
def phi(z: float) -> tuple[float, float, float, float]:
    """Return phi_0 = exp to phi_3: by Taylor's series of phi_3 where z is small, and phi_k = z phi_(k+1) + 1 / k!."""
    if abs(z) < 1.0:
        term, third = 1.0 / 6.0, 0.0
        for k in range(4, 22):
            third += term
            term *= z / k
        second = z * third + 0.5
        first = z * second + 1.0
        return z * first + 1.0, first, second, third
    zeroth = np.exp(z)
    first = (zeroth - 1.0) / z
    second = (first - 1.0) / z
    return zeroth, first, second, (second - 0.5) / z


@njit(cache=True, nogil=True)
def weights(step_s: float, rate: FloatArray, keep: FloatArray, whole: FloatArray, late: FloatArray) -> None:
    """Write e^(h rate), h phi_1 and h phi_2 of every mode."""
    for i in range(rate.size):
        zeroth, first, second, _ = phi(step_s * rate[i])
        keep[i], whole[i], late[i] = zeroth, step_s * first, step_s * second


_NODES, _SHARES = np.polynomial.legendre.leggauss(6)
NEAR = 0.5
"""Arguments closer than this have their divided difference as the mean slope between them, by Gauss's rule: exact to
rounding, where the difference of values would cancel."""


@njit(cache=True, nogil=True)
def divided_differences(
    step_s: float, rate: FloatArray, keep: FloatArray, early: FloatArray, late: FloatArray, out: FloatArray
) -> None:
    """Write the divided differences of e^(h x), h (phi_1 - phi_2) and h phi_2 over all pairs of modes, (3, n, n).

    They are the derivatives of the matrix functions (Daleckii and Krein; Higham, Functions of Matrices, theorem 3.11).
    """
    n = rate.size
    for i in range(n):
        for j in range(i + 1):
            distance = step_s * (rate[i] - rate[j])
            if abs(distance) < NEAR:
                zeroth, first, second = 0.0, 0.0, 0.0
                for q in range(_NODES.size):
                    z = step_s * rate[j] + 0.5 * (1.0 + _NODES[q]) * distance
                    p0, p1, p2, p3 = phi(z)
                    zeroth += 0.5 * _SHARES[q] * p0
                    first += 0.5 * _SHARES[q] * (p1 - p2)
                    second += 0.5 * _SHARES[q] * (p2 - 2.0 * p3)
                out[0, i, j] = step_s * zeroth
                out[1, i, j] = step_s * step_s * (first - second)
                out[2, i, j] = step_s * step_s * second
            else:
                gap = rate[i] - rate[j]
                out[0, i, j] = (keep[i] - keep[j]) / gap
                out[1, i, j] = (early[i] - early[j]) / gap
                out[2, i, j] = (late[i] - late[j]) / gap
            for f in range(3):
                out[f, j, i] = out[f, i, j]


@njit(cache=True, nogil=True)
def dense(outward: FloatArray, weight: FloatArray, inward: FloatArray, out: FloatArray) -> None:
    """Write outward diag(weight) inward to ``out``."""
    scaled = np.empty_like(inward)
    for i in range(weight.size):
        for j in range(weight.size):
            scaled[i, j] = weight[i] * inward[i, j]
    multiply_columns(outward, scaled, out)
