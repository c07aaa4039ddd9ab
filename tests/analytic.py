"""Problems with known answers, worked out without the code under test."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

SIGMA = 5.670374419e-8
FloatArray = NDArray[np.float64]


def laplacian(n_nodes: int, edges: list[tuple[int, int]], conductance_W_per_K: list[float]) -> FloatArray:
    """Return the weighted graph Laplacian, (n_nodes, n_nodes): heat into the nodes is -L T."""
    matrix = np.zeros((n_nodes, n_nodes))
    for (a, b), g in zip(edges, conductance_W_per_K, strict=True):
        matrix[a, a] += g
        matrix[b, b] += g
        matrix[a, b] -= g
        matrix[b, a] -= g
    return matrix


def linear_states(
    rates_per_s: FloatArray, drive_K_per_s: FloatArray, start_K: FloatArray, time_s: FloatArray
) -> FloatArray:
    """Return the exact states of dx/dt = A x + b[k] at the times, (n_times, n_nodes); b[k] holds from time k to k + 1.

    The matrix exponential of the augmented system [[A, b], [0, 0]] needs no inverse of A.
    """
    n = start_K.size
    states = [start_K]
    for k, step in enumerate(np.diff(time_s)):
        joint = np.zeros((n + 1, n + 1))
        joint[:n, :n], joint[:n, n] = rates_per_s, drive_K_per_s[k]
        states.append((expm(joint * step) @ np.append(states[-1], 1.0))[:n])
    return np.array(states)


def radiative_equilibrium_K(heat_W: float, emissive_area_m2: float, sink_K: float) -> float:
    """Return the temperature at which a radiator sheds its heat: (Q / (sigma eps A) + T_s^4)^(1/4)."""
    return float((heat_W / (SIGMA * emissive_area_m2) + sink_K**4) ** 0.25)
