"""A change of phase inside a node: a phase-change material, freezing propellant, a solid transition."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.special import ndtr

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Capacity, Entry
from twin_core.parameters.parameter import Parameter

N_CENTRES = 9
WIDTH_SHARES = (0.03, 0.08, 0.2)
"""Widths that are tried, as shares of the visited range."""
STAY_SHARES = (0.1, 0.2, 0.4)
"""Of the record: a change of phase is looked for where the node stays so long within the narrowest range. Of 286 plateaus in
cooling records, drawn at random, a start lay within a width of 197 (82 without these, 203 at half, 146 at double)."""

WIDEST_SHARE = 0.25
"""The greatest width, as a share of the visited range: centred in it, two standard deviations on either side fill it. Of a wider
change of phase the record does not see what it takes up in all."""


@dataclass(frozen=True)
class Melting:
    """Extra capacity: a Gaussian in T of area L; values are L, T_m, w."""

    node: int
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, temperature_K: FloatArray, values: FloatArray) -> Capacity:
        """Evaluate the extra capacity and what it has taken up."""
        heat, centre, width = values
        x = (temperature_K - centre) / width
        density = np.exp(-0.5 * x**2) / (np.sqrt(2.0 * np.pi) * width)
        extra, molten = heat * density, ndtr(x)
        return Capacity(
            self.node,
            extra,
            -extra * x / width,
            [
                Entry(0, self.node, density),
                Entry(1, self.node, extra * x / width),
                Entry(2, self.node, extra * (x**2 - 1.0) / width),
            ],
            heat * molten,
            [Entry(0, self.node, molten), Entry(1, self.node, -extra), Entry(2, self.node, -extra * x)],
        )


def stays_K(visited_K: FloatArray) -> list[tuple[float, float]]:
    """Return middle and width of the narrowest ranges that hold shares of sorted temperatures (n_points,).

    A change of phase holds its node at one temperature until it is complete, which may lie at the end of what is visited.
    """
    found = []
    for share in STAY_SHARES:
        n_within = max(int(share * visited_K.size), 2)
        widths = visited_K[n_within - 1 :] - visited_K[: visited_K.size - n_within + 1]
        first = int(np.argmin(widths))
        if widths[first] > 0.0:
            found.append((float(visited_K[first] + 0.5 * widths[first]), float(widths[first])))
    return found


class LatentHeat(Effect):
    """C -> C + L g(T), g a Gaussian of area one."""

    name = "latent_heat"
    keys = ("node",)
    equation = "C -> C + L g(T), g = exp(-(T - T_m)^2 / (2 w^2)) / (w sqrt(2 pi))"
    reference = "Bonacina et al., Int. J. Heat Mass Transfer 16 (1973): apparent heat capacity; stepped by its enthalpy"
    sentence = "a phase change in {node} was missing"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the latent heat, where it melts and over what width: within what the record visits, or L is a guess."""
        low_K, high_K = self.settings.get("low_K"), self.settings.get("high_K")
        widest_K = None if low_K is None or high_K is None else WIDEST_SHARE * (high_K - low_K)
        return (
            ParameterSpec("L_J", "J", null=0.0, positive=True),
            ParameterSpec("T_m_K", "K", prior_std=20.0, lower=low_K, upper=high_K),
            ParameterSpec("w_K", "K", positive=True, prior_std=1.0, upper=widest_K),
        )

    def addition(self, layout: Layout) -> Addition:
        """Return the extra capacity."""
        return Addition(capacities=(Melting(layout.node(self.where["node"]), self.parameters()),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node."""
        yield from ({"node": node} for node in layout.declared_nodes)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield centres evenly over the visited range, each with several widths, and ranges in which the node stays."""
        visited_K = np.sort(survey.temperature_K(where["node"]))
        low, high = np.quantile(visited_K, (0.005, 0.995))
        if not high > low:
            return
        even = [(c, w * (high - low)) for c in np.linspace(low, high, N_CENTRES + 2)[1:-1] for w in WIDTH_SHARES]
        stays = [(c, w) for c, w in stays_K(visited_K) if w < WIDEST_SHARE * (high - low)]
        for centre, width in [*even, *stays]:
            start = {"L_J": 0.0, "T_m_K": float(np.clip(centre, low, high)), "w_K": float(width)}
            yield cls(where, start, {"low_K": float(low), "high_K": float(high)})
