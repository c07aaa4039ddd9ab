"""Powers of a temperature and of a boundary temperature, centred and scaled, that know the range they were visited over.

x^a z^b,   x = (T - centre) / scale,   z likewise of the boundary temperature
"""

from dataclasses import dataclass
from functools import cached_property
from math import comb

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.errors import ModelError
from twin_core.gp.checked import whole

SMALLEST_SCALE_K = 1e-3
"""Half-range below which a temperature counts as constant."""
HERMITE_POINTS = np.array([-np.sqrt(3.0), 0.0, np.sqrt(3.0)])
HERMITE_WEIGHTS = np.array([1.0, 4.0, 1.0]) / 6.0


@dataclass(frozen=True)
class Basis:
    """Powers of a scaled temperature (and of the scaled boundary temperature).

    Attributes
    ----------
    degree
        Highest total degree.
    vanishing
        Whether x is (T - T_b) / scale and every term has it: no heat where there is no difference, as in convection,
        leaks and radiation. Otherwise x = (T - centre) / scale, and the first term is a constant.
    low_K, high_K : (1,) or (2,)
        Visited range of T (vanishing: of T - T_b) and, where there is one, of T_b. A boundary that has not moved is no
        variable, yet leaving its range is told.
    """

    degree: int
    vanishing: bool
    low_K: tuple[float, ...]
    high_K: tuple[float, ...]

    def __post_init__(self) -> None:
        """Refuse what is no degree or no range."""
        whole(self.degree, "degree", lowest=int(self.vanishing))
        sizes = {len(self.low_K), len(self.high_K)}
        if sizes not in ({1}, {2}) or (self.vanishing and sizes != {2}):
            raise ModelError("low_K and high_K must hold one temperature each, or two where a boundary takes part")
        if not all(-np.inf < low <= high < np.inf for low, high in zip(self.low_K, self.high_K, strict=True)):
            raise ModelError("low_K and high_K must be finite, low_K not above high_K")

    @classmethod
    def over(
        cls, degree: int, temperature_K: FloatArray, boundary_K: FloatArray | None = None, *, vanishing: bool = False
    ) -> "Basis":
        """Return the basis of a total degree over visited temperatures.

        Raises
        ------
        ModelError
            The degree is negative (vanishing: below one), temperatures are not finite, or the boundary is missing.
        """
        if vanishing and boundary_K is None:
            raise ModelError("a vanishing basis needs the boundary temperature")
        visited = [np.asarray(temperature_K, dtype=np.float64)]
        if boundary_K is not None:
            visited = list(np.broadcast_arrays(visited[0], np.asarray(boundary_K, dtype=np.float64)))
        if visited[0].size == 0 or not all(np.isfinite(v).all() for v in visited):
            raise ModelError("the polynomial needs finite temperatures")
        if vanishing:
            visited = [visited[0] - visited[1], visited[1]]
        return cls(degree, vanishing, tuple(float(v.min()) for v in visited), tuple(float(v.max()) for v in visited))

    @property
    def has_boundary(self) -> bool:
        """Whether a boundary takes part."""
        return len(self.low_K) == 2

    @cached_property
    def exponents(self) -> tuple[tuple[int, int], ...]:
        """Powers of x and z of every term, by rising total degree."""
        pairs = [(k - j, j) for k in range(self.degree + 1) for j in range(k + 1 if self._boundary_moves else 1)]
        return tuple((a, b) for a, b in pairs if a > 0 or not self.vanishing)

    @property
    def _boundary_moves(self) -> bool:
        return self.has_boundary and self.high_K[1] - self.low_K[1] > 2.0 * SMALLEST_SCALE_K

    @cached_property
    def _edges_K(self) -> FloatArray:
        """Return the lowest and highest x and z in K, (2, 2); a boundary that takes no part stays at zero."""
        return np.array([[*edge, 0.0][:2] for edge in (self.low_K, self.high_K)])

    @cached_property
    def centre_K(self) -> FloatArray:
        """Origin of x and z, (2,)."""
        middle = self._edges_K.mean(axis=0)
        return np.array([0.0 if self.vanishing else middle[0], middle[1]])

    @cached_property
    def scale_K(self) -> FloatArray:
        """Unit of x and z, (2,)."""
        return np.maximum(np.abs(self._edges_K - self.centre_K).max(axis=0), SMALLEST_SCALE_K)

    def scaled(self, temperature_K: FloatArray, boundary_K: FloatArray | None = None) -> FloatArray:
        """Return x and z, (2, ...); z is zero without a boundary.

        Raises
        ------
        ModelError
            The heat depends on the boundary temperature and none is given.
        """
        if boundary_K is None and (self.vanishing or self._boundary_moves):
            raise ModelError("boundary_K is missing: the heat depends on the boundary temperature too")
        given = boundary_K if self.has_boundary and boundary_K is not None else self.centre_K[1]
        t, b = np.broadcast_arrays(np.asarray(temperature_K, dtype=np.float64), np.asarray(given, dtype=np.float64))
        x = (t - (b if self.vanishing else self.centre_K[0])) / self.scale_K[0]
        return np.stack([x, (b - self.centre_K[1]) / self.scale_K[1]])

    def held(self, scaled: FloatArray) -> FloatArray:
        """Return the point of the visited range next to x and z, (2, ...)."""
        edges = (self._edges_K - self.centre_K) / self.scale_K
        low, high = (np.reshape(edge, (2, *(1,) * (scaled.ndim - 1))) for edge in edges)
        return np.clip(scaled, low, high)

    def at_scaled(self, scaled: FloatArray) -> FloatArray:
        """Return the terms at x and z (2, ...), (..., n_terms)."""
        (by_x, by_z), (a, b) = self._powers(scaled), self._exponents
        return np.moveaxis(by_x[a] * by_z[b], 0, -1)

    def gradient(self, scaled: FloatArray, coefficients: FloatArray) -> FloatArray:
        """Return the derivatives of a polynomial of (n_terms,) coefficients in x and in z at x and z (2, n), (2, n)."""
        (by_x, by_z), (a, b) = self._powers(scaled), self._exponents
        in_x = (coefficients * a) @ (by_x[np.maximum(a - 1, 0)] * by_z[b])
        in_z = (coefficients * b) @ (by_x[a] * by_z[np.maximum(b - 1, 0)])
        return np.stack([in_x, in_z])

    @cached_property
    def _exponents(self) -> IntArray:
        """Return the powers of x and of z of every term, (2, n_terms)."""
        return np.array(self.exponents, dtype=np.int64).reshape(-1, 2).T

    def _powers(self, scaled: FloatArray) -> FloatArray:
        """Return the powers of x and z (2, ...) by products, (2, degree + 1, ...): ten times as fast as ``**``."""
        powers = np.ones((2, self.degree + 1, *scaled.shape[1:]))
        for k in range(self.degree):
            np.multiply(powers[:, k], scaled, out=powers[:, k + 1])
        return powers

    def taylor(self, scaled: FloatArray) -> FloatArray:
        """Return the Taylor coefficients dx^i dz^j of every term about x and z (2, n), (n, n_terms, degree + 1, same)."""
        size = self.degree + 1
        out = np.zeros((scaled.shape[1], len(self.exponents), size, size))
        for k, (a, b) in enumerate(self.exponents):
            for i in range(a + 1):
                for j in range(b + 1):
                    out[:, k, i, j] = comb(a, i) * comb(b, j) * scaled[0] ** (a - i) * scaled[1] ** (b - j)
        return out

    def terms(
        self, temperature_K: FloatArray, boundary_K: FloatArray | None = None, std_K: FloatArray | None = None
    ) -> FloatArray:
        """Return the terms, (..., n_terms); with ``std_K`` their mean over T ~ N(temperature_K, std_K²).

        The mean is by three-point Gauss-Hermite quadrature, exact to degree five: the smoothed temperature's own
        uncertainty takes part in the regression.
        """
        if std_K is None:
            return self.at_scaled(self.scaled(temperature_K, boundary_K))
        spread = [
            weight * self.at_scaled(self.scaled(temperature_K + point * std_K, boundary_K))
            for point, weight in zip(HERMITE_POINTS, HERMITE_WEIGHTS, strict=True)
        ]
        return np.sum(spread, axis=0)
