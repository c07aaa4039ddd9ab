"""Covariance functions of time that are linear stochastic differential equations, and their sums.

    dx/dt = F x + white noise of spectral density D,   f(t) = h x(t)

A kernel holds structure only; its hyperparameters are handed in as a vector, which may be complex: a tiny imaginary part
carries a derivative through everything that follows (complex step). Derivative states are scaled by the rate, so that
all states of a block have the unit of f and matrices stay well scaled at any length. Hartikainen and Särkkä, *Kalman
filtering and smoothing solutions to temporal Gaussian process regression models* (2010); Solin and Särkkä, *Explicit
link between periodic covariance functions and state space models* (2014).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import ive

from twin_core._typing import FloatArray
from twin_core.errors import ModelError
from twin_core.gp.checked import whole

ROUGHEST = 1e8
"""Largest smoothness⁻²: all harmonics kept are alike there to eight digits, and Bessel functions end soon after."""

Values = NDArray[np.inexact[Any]]
"""Real, or complex with a tiny imaginary part that carries a derivative."""


@dataclass(frozen=True)
class Block:
    """A kernel at given hyperparameters, as a stochastic differential equation.

    Attributes
    ----------
    feedback : (n, n)
        F, in 1/s.
    diffusion : (n, n)
        D, in (unit of f)²/s.
    observation : (n,)
        h.
    stationary_cov : (n, n)
        Covariance of the state at any time, P with F P + P Fᵀ + D = 0.
    """

    feedback: Values
    diffusion: Values
    observation: FloatArray
    stationary_cov: Values


class Kernel(ABC):
    """A stationary covariance function of time."""

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Hyperparameters in order, all positive; std in the unit of f, lengths in s."""

    @abstractmethod
    def block(self, values: Values) -> Block:
        """Return the differential equation at hyperparameters (n_hyper,)."""

    @abstractmethod
    def covariance(self, values: FloatArray, lag_s: FloatArray) -> FloatArray:
        """Return Cov(f(t), f(t + lag)) in closed form, in the shape of ``lag_s``."""

    def __add__(self, other: "Kernel") -> "Sum":
        """Return the kernel of the sum of two independent processes."""
        return Sum((*_parts(self), *_parts(other)))


@dataclass(frozen=True)
class Matern(Kernel):
    """Matérn kernel; rate = ``decay`` / length.

    Attributes
    ----------
    half_order
        Smoothness doubled: 1, 3 or 5 for Matérn 1/2, 3/2, 5/2.
    decay
        sqrt(half_order) by default. Kouw et al. (CCTA 2024, eq. 6) write sqrt(3) for Matérn-1/2.
    """

    half_order: int = 3
    decay: float | None = None

    def __post_init__(self) -> None:
        """Refuse an order without a finite state."""
        if self.half_order not in (1, 3, 5):
            raise ModelError(f"Matern: half_order must be 1, 3 or 5, not {self.half_order}")
        if self.decay is not None and not 0.0 < self.decay < np.inf:
            raise ModelError(f"Matern: decay must be positive, it is {self.decay}")

    @property
    def names(self) -> tuple[str, ...]:
        """Standard deviation and length."""
        return ("std", "length_s")

    def block(self, values: Values) -> Block:
        """Return the companion form with states f, f'/rate, f''/rate²."""
        std, length = values
        rate, power = self._decay / length, std * std
        shape = {1: [[-1.0]], 3: [[0.0, 1.0], [-1.0, -2.0]], 5: [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, -3.0, -3.0]]}
        cov = {1: [[1.0]], 3: [[1.0, 0.0], [0.0, 1.0]], 5: [[1, 0, -1 / 3], [0, 1 / 3, 0], [-1 / 3, 0, 1.0]]}
        n = (self.half_order + 1) // 2
        last = np.zeros((n, n))
        last[-1, -1] = {1: 2.0, 3: 4.0, 5: 16.0 / 3.0}[self.half_order]
        stationary = power * np.array(cov[self.half_order])
        return Block(rate * np.array(shape[self.half_order]), power * rate * last, np.eye(n)[0], stationary)

    def covariance(self, values: FloatArray, lag_s: FloatArray) -> FloatArray:
        """Return std² exp(-r) times 1, 1 + r or 1 + r + r²/3, r = rate |lag|."""
        std, length = values
        r = self._decay * np.abs(lag_s) / length
        growth = {1: np.ones_like(r), 3: 1.0 + r, 5: 1.0 + r + r * r / 3.0}[self.half_order]
        return np.asarray(std**2 * growth * np.exp(-r))

    @property
    def _decay(self) -> float:
        return float(np.sqrt(self.half_order)) if self.decay is None else self.decay


@dataclass(frozen=True)
class Periodic(Kernel):
    """Process that repeats with a known period (an orbit), by its first harmonics.

    k(lag) = std² sum_j q_j² cos(2 pi j lag / period), the q_j² being the Fourier coefficients of
    exp(-2 sin²(pi lag / period) / smoothness²), normalised over the harmonics kept. With ``forgets`` the pattern drifts:
    the covariance is multiplied by exp(-|lag| / length_s) (quasi-periodic).
    """

    period_s: float
    n_harmonics: int = 6
    forgets: bool = False

    def __post_init__(self) -> None:
        """Refuse a period or a number of harmonics that makes no sense."""
        if not 0.0 < self.period_s < np.inf:
            raise ModelError(f"Periodic: period_s must be positive, it is {self.period_s}")
        whole(self.n_harmonics, "Periodic: n_harmonics", lowest=1)

    @property
    def names(self) -> tuple[str, ...]:
        """Standard deviation, smoothness, and the length of the drift."""
        return ("std", "smoothness", "length_s") if self.forgets else ("std", "smoothness")

    def block(self, values: Values) -> Block:
        """Return a constant and one rotating pair per harmonic."""
        powers = values[0] ** 2 * _harmonic_shares(values[1], self.n_harmonics)
        angular = 2.0 * np.pi / self.period_s
        turns = [np.zeros((1, 1))]
        turns += [j * angular * np.array([[0.0, -1.0], [1.0, 0.0]]) for j in range(1, self.n_harmonics + 1)]
        stationary = np.diag(np.concatenate([[powers[0]], np.repeat(powers[1:], 2)]))
        n = stationary.shape[0]
        rate = 1.0 / values[2] if self.forgets else 0.0
        observation = np.concatenate([[1.0], np.tile([1.0, 0.0], self.n_harmonics)])
        return Block(block_diag(*turns) - rate * np.eye(n), 2.0 * rate * stationary, observation, stationary)

    def covariance(self, values: FloatArray, lag_s: FloatArray) -> FloatArray:
        """Return the sum of cosines, times the decay."""
        shares = np.real(_harmonic_shares(values[1], self.n_harmonics))
        angles = 2.0 * np.pi * np.multiply.outer(np.asarray(lag_s) / self.period_s, np.arange(shares.size))
        decay = np.exp(-np.abs(lag_s) / values[2]) if self.forgets else 1.0
        return np.asarray(values[0] ** 2 * decay * (np.cos(angles) @ shares))


@dataclass(frozen=True)
class Sum(Kernel):
    """Sum of independent kernels."""

    parts: tuple[Kernel, ...]

    def __post_init__(self) -> None:
        """Refuse what is no kernel."""
        if not self.parts or not all(isinstance(part, Kernel) for part in self.parts):
            raise ModelError(f"Sum: needs kernels, it has {self.parts!r}")

    @property
    def names(self) -> tuple[str, ...]:
        """Hyperparameters of the parts, numbered: ``std_1, length_s_1, std_2, ...``."""
        return tuple(f"{name}_{k}" for k, part in enumerate(self.parts, 1) for name in part.names)

    def block(self, values: Values) -> Block:
        """Return the parts side by side."""
        blocks = [part.block(own) for part, own in self._split(values)]
        return Block(
            block_diag(*(b.feedback for b in blocks)),
            block_diag(*(b.diffusion for b in blocks)),
            np.concatenate([b.observation for b in blocks]),
            block_diag(*(b.stationary_cov for b in blocks)),
        )

    def covariance(self, values: FloatArray, lag_s: FloatArray) -> FloatArray:
        """Return the sum of the parts' covariances."""
        total = np.zeros_like(np.asarray(lag_s, dtype=np.float64))
        for part, own in self._split(values):
            total = total + part.covariance(np.real(own), lag_s)
        return total

    def _split(self, values: Values) -> list[tuple[Kernel, Values]]:
        ends = np.cumsum([len(part.names) for part in self.parts])
        return list(zip(self.parts, np.split(np.asarray(values), ends[:-1]), strict=True))


def _parts(kernel: Kernel) -> tuple[Kernel, ...]:
    return kernel.parts if isinstance(kernel, Sum) else (kernel,)


def _harmonic_shares(smoothness: float | complex, n_harmonics: int) -> Values:
    """Return q_j², j = 0..n_harmonics, normalised to one: 2 I_j(z) exp(-z), I_0(z) exp(-z), z = smoothness⁻²."""
    z = 1.0 / (smoothness * smoothness)
    if np.real(z) > ROUGHEST:
        z = ROUGHEST + 0.0 * z
    orders = np.arange(n_harmonics + 1)
    at = ive(orders, np.real(z))
    # d/dz [I_j(z) exp(-z)] by the recurrence of Bessel functions; it carries a complex step that ive itself would lose.
    slope = 0.5 * (ive(np.abs(orders - 1), np.real(z)) + ive(orders + 1, np.real(z))) - at
    shares = (at + 1j * np.imag(z) * slope if np.iscomplexobj(z) else at) * np.where(orders == 0, 1.0, 2.0)
    return np.asarray(shares / shares.sum())
