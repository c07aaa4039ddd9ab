"""The honest fallback: a repeatable heat flow without a name, as a polynomial of temperature."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, Quality, Survey, Where
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Along, Entry, Heat
from twin_core.parameters.parameter import Parameter

MAX_DEGREE = 3


@dataclass(frozen=True)
class PolynomialHeat:
    """q = sum_k c_k x^k with x = (T - centre) / scale, held at its edge value outside the visited range."""

    node: int
    centre_K: float
    scale_K: float
    reach: float
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the polynomial; beyond ``reach`` in x the heat stays what it was at the edge."""
        raw = (along.temperatures_K[:, self.node] - self.centre_K) / self.scale_K
        x = np.clip(raw, -self.reach, self.reach)
        powers = x[:, None] ** np.arange(values.size)
        orders = np.arange(1, values.size)
        slope = (powers[:, :-1] * orders) @ values[1:] if values.size > 1 else np.zeros_like(x)
        slope = np.where(np.abs(raw) < self.reach, slope / self.scale_K, 0.0)
        entries = [Entry(k, self.node, powers[:, k]) for k in range(values.size)]
        return Heat((self.node,), (powers @ values)[:, None], slope[:, None, None], entries)


class LearnedHeatFlow(Effect):
    """q = Bayesian polynomial of T, from the latent force (paper B, eqs. 33-41)."""

    name = "learned_heat_flow"
    keys = ("node",)
    equation = "q = sum_k c_k ((T - T_c) / T_w)^k"
    reference = "Kouw et al., CCTA 2024, section III-C"
    words = "receives a heat that repeats with its temperature but fits no named effect"
    reported_settings = ("degree",)
    fallback = True

    def qualities(self) -> tuple[Quality, ...]:
        """Return the coefficients, in W."""
        return tuple(Quality(f"coefficients[{k}]", "W", null=0.0) for k in range(int(self.settings["degree"]) + 1))

    def addition(self, layout: Layout) -> Addition:
        """Return the polynomial."""
        s = self.settings
        node = layout.node(self.where["node"])
        return Addition((PolynomialHeat(node, s["centre_K"], s["scale_K"], s["reach"], self.parameters()),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node."""
        yield from ({"node": node} for node in layout.declared_nodes)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield polynomials of rising degree, centred and scaled on the visited range."""
        temperature = survey.temperature_K(where["node"])
        centre, scale = float(temperature.mean()), float(max(temperature.std(), 1e-3))
        reach = float(np.abs((temperature - centre) / scale).max())
        for degree in range(1, MAX_DEGREE + 1):
            values = {f"coefficients[{k}]": 0.0 for k in range(degree + 1)}
            settings = {"degree": degree, "centre_K": centre, "scale_K": scale, "reach": reach}
            yield cls(where, values, settings)
