"""The honest fallback: a repeatable heat flow without a name, as a polynomial of temperature."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Beyond, Effect, ParameterSpec, Survey, Where
from twin_core.errors import ModelError
from twin_core.gp.basis import SMALLEST_SCALE_K, Basis
from twin_core.gp.polynomial import ForcePolynomial
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Along, Entry, Heat
from twin_core.parameters.parameter import Parameter

MAX_DEGREE, MAX_DEGREE_WITH_BOUNDARY = 6, 3
"""Of the polynomials that are tried: of one temperature enough for a heat that rises and falls, of two as many terms."""


@dataclass(frozen=True)
class PolynomialHeat:
    """The heat of a basis and its coefficients, held at its edge value outside the visited range."""

    node: int
    boundary: int | None
    basis: Basis
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the polynomial; where x or z lies outside its range the heat does not answer to it."""
        raw = self.basis.scaled(*_at(along, self.node, self.boundary))
        held = self.basis.held(raw)
        terms, slopes = self.basis.at_scaled(held), self.basis.gradient(held, values)
        by_x, by_z = np.where(raw == held, slopes, 0.0) / self.basis.scale_K[:, None]
        entries = [Entry(k, self.node, terms[:, k]) for k in range(values.size)]
        ends = []
        if self.boundary is not None:
            ends = [Entry(self.boundary, self.node, by_z - by_x if self.basis.vanishing else by_z)]
        return Heat((self.node,), (terms @ values)[:, None], by_x[:, None, None], entries, ends)


class LearnedHeatFlow(Effect):
    """q = Bayesian polynomial of T (and T_s), from the latent force (paper B, eqs. 33-41).

    Its settings are the degree, the form, the visited range and, once fitted, the covariance of the coefficients: where a
    rollout leaves the range it says so, and its band grows.
    """

    name = "learned_heat_flow"
    keys = ("node",)
    optional_keys = ("boundary",)
    equation = "q = sum_k c_k x^a_k z^b_k, x = (T - T_c) / T_w or (T - T_s) / T_w, z = (T_s - T_sc) / T_sw"
    reference = "Kouw et al., CCTA 2024, section III-C"
    sentence = "a repeatable heat flow into {node} that no named effect explains was missing"
    reported_settings = ("degree",)
    fallback = True

    @property
    def basis(self) -> Basis:
        """Its terms and their range; ModelError where a setting is not what it must be."""
        s = self.settings
        try:
            low, high = tuple(map(float, s["low_K"])), tuple(map(float, s["high_K"]))
            basis = Basis(int(s["degree"]), bool(s["vanishing"]), low, high)
        except (TypeError, ValueError) as error:
            raise ModelError(f"{self.label}: a setting is no number ({error})") from error
        if basis.has_boundary != ("boundary" in self.where):
            raise ModelError(f"{self.label}: low_K holds {len(low)} temperatures, where has {', '.join(self.where)}")
        return basis

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the coefficients, in W."""
        return tuple(ParameterSpec(f"coefficients[{k}]", "W", null=0.0) for k in range(len(self.basis.exponents)))

    def addition(self, layout: Layout) -> Addition:
        """Return the polynomial."""
        return Addition((PolynomialHeat(*self._place(layout), self.basis, self.parameters()),))

    def learned(self, covariance: FloatArray) -> Self:
        """Return the effect carrying the covariance of its coefficients, in W²."""
        return replace(self, settings={**self.settings, "covariance_W2": tuple(covariance.ravel().tolist())})

    def beyond(self, layout: Layout, along: Along) -> Beyond | None:
        """Return where temperatures leave the visited range and how uncertain the heat is there."""
        node, boundary = self._place(layout)
        law = ForcePolynomial(
            self.basis,
            np.array([self.values[q.name] for q in self.parameter_specs()]),
            self._covariance(),
            float(self.settings["misfit_W"]),
        )
        found = law.predict(*_at(along, node, boundary))
        if not found.outside.any():
            return None
        about = [self.where[key] for key in ("node", "boundary") if key in self.where]
        if law.basis.vanishing:
            about[0] = " - ".join(about)
        ranges = zip(about, law.basis.low_K, law.basis.high_K, strict=True)
        return Beyond(
            node,
            found.outside,
            found.beyond_W,
            " and ".join(f"{n} {low:.2f} to {high:.2f} K" for n, low, high in ranges),
        )

    def _place(self, layout: Layout) -> tuple[int, int | None]:
        boundary = self.where.get("boundary")
        return layout.node(self.where["node"]), None if boundary is None else layout.boundary(boundary)

    def _covariance(self) -> FloatArray:
        size = len(self.basis.exponents)
        given = np.array(self.settings["covariance_W2"], dtype=np.float64)
        if given.size not in (0, size**2) or not np.isfinite(given).all():
            raise ModelError(f"{self.label}: covariance_W2 must hold {size} x {size} numbers, or none")
        return given.reshape(size, size) if given.size else np.zeros((size, size))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node, alone and with every boundary."""
        for node in layout.declared_nodes:
            yield {"node": node}
            yield from ({"node": node, "boundary": boundary} for boundary in layout.boundaries)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield polynomials of rising degree over the visited range; with a boundary only where it has moved."""
        temperature, boundary = survey.temperature_K(where["node"]), None
        forms = [False]
        if "boundary" in where:
            boundary = survey.along.boundaries_K[:, survey.layout.boundary(where["boundary"])]
            forms = [False, True] if np.ptp(boundary) > 2.0 * SMALLEST_SCALE_K else []
        for vanishing in forms:
            for degree in range(1, (MAX_DEGREE if boundary is None else MAX_DEGREE_WITH_BOUNDARY) + 1):
                basis = Basis.over(degree, temperature, boundary, vanishing=vanishing)
                none = np.zeros(len(basis.exponents))
                settings, values = ForcePolynomial(basis, none, np.zeros((0, 0))).effect_settings()
                yield cls(where, values, settings)


def _at(along: Along, node: int, boundary: int | None) -> tuple[FloatArray, FloatArray | None]:
    """Return the temperatures of the node and, if any, of the boundary, (n_points,)."""
    return along.temperatures_K[:, node], None if boundary is None else along.boundaries_K[:, boundary]
