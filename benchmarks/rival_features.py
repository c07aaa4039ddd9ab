"""Heats that a regression on the residual can be made of: values, slopes, and what the vocabulary calls them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4
from twin_core.effects import REGISTRY
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Along, Heat, table_basis
from twin_core.parameters.parameter import Parameter

Series = Callable[[Along], np.ndarray]


@dataclass(frozen=True)
class Feature:
    """One column of a library.

    Attributes
    ----------
    value : points -> (n_points,)
    slopes
        Node -> derivative with respect to its temperature, (n_points,).
    effect, where
        What the vocabulary calls it; None for what it has no name for, such as a correction of a declared parameter.
    """

    value: Series
    slopes: Mapping[int, Series] = field(default_factory=dict)
    effect: str | None = None
    where: Where = field(default_factory=dict)


@dataclass(frozen=True)
class FeatureTerm:
    """q = offset + sum_k w_k f_k into one node."""

    node: int
    features: Sequence[Feature]
    weights: np.ndarray
    offset_W: float
    parameters: tuple[Parameter, ...] = ()
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: np.ndarray) -> Heat:
        """Evaluate the sum."""
        n_points, n_nodes = along.temperatures_K.shape
        heat, slope = np.zeros((n_points, n_nodes)), np.zeros((n_points, n_nodes, n_nodes))
        heat[:, self.node] = self.offset_W
        for feature, weight in zip(self.features, self.weights, strict=True):
            heat[:, self.node] += weight * feature.value(along)
            for node, series in feature.slopes.items():
                slope[:, self.node, node] += weight * series(along)
        return Heat(tuple(range(n_nodes)), heat, slope)


class FeatureHeat(Effect):
    """A sum of features as an effect, so that a rival's model is rolled out by the same integrator as ours."""

    name = "feature_heat"
    keys = ("node",)
    equation = "q = sum_k w_k f_k"
    reference = "Brunton, Proctor and Kutz, PNAS 2016"
    words = "receives a regressed heat"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return nothing: the weights stay as they were regressed."""
        return ()

    def addition(self, layout: Layout) -> Addition:
        """Return the sum."""
        s: Mapping[str, Any] = self.settings
        return Addition((FeatureTerm(layout.node(self.where["node"]), s["features"], s["weights"], s["offset_W"]),))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield nothing: nobody searches it."""
        return ()

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield nothing."""
        return ()


def constant() -> Series:
    """Return ones."""
    return lambda along: np.ones(along.time_s.size)


def library(layout: Layout, node: str, levels: Mapping[str, tuple[float, ...]], period_s: float) -> list[Feature]:
    """Return the physical library of one node; the constant, always there, is not in it.

    Differences to every other node and boundary, of T and of T^4 to boundaries; every power input; every auxiliary channel,
    by levels where it rests at some (all but the first: together they are the constant); one harmonic.
    """
    i = layout.node(node)
    found = [_difference(i, j, {"nodes": [node, other]}) for j, other in enumerate(layout.nodes) if j != i]
    for b, boundary in enumerate(layout.boundaries):
        found += [_leak(i, b, node, boundary), _radiation(i, b, node, boundary)]
    loaded = {(load.channel, load.node) for load in layout.spec.loads}
    for name, channel in layout.spec.channels.items():
        if channel.kind == "power":
            effect = "input_gain" if (name, node) in loaded else None
            found.append(Feature(_input(name), {}, effect, {"channel": name}))
        elif channel.kind == "auxiliary":
            place = {"node": node, "channel": name}
            columns = [_level(name, levels[name], k) for k in range(1, len(levels[name]))] if name in levels else []
            found += [Feature(c, {}, "channel_heat_load", place) for c in columns or [_input(name)]]
    return [_checked(f, layout) for f in [*found, *_harmonic(node, period_s)]]


def powers(node: int, low_K: float, high_K: float, degree: int) -> list[Feature]:
    """Return x, x^2, ... of the scaled temperature, held outside the visited range."""
    middle, half = 0.5 * (low_K + high_K), max(0.5 * (high_K - low_K), 1e-3)

    def power(k: int) -> Feature:
        def slope(along: Along) -> np.ndarray:
            x = (along.temperatures_K[:, node] - middle) / half
            return np.where(np.abs(x) <= 1.0, k * x ** (k - 1) / half, 0.0)

        return Feature(
            lambda along: np.clip((along.temperatures_K[:, node] - middle) / half, -1.0, 1.0) ** k, {node: slope}
        )

    return [power(k) for k in range(1, degree + 1)]


def _checked(feature: Feature, layout: Layout) -> Feature:
    """Return the feature without its name where the declared model already has that term with a free size."""
    if feature.effect is None:
        return feature
    known = (REGISTRY[feature.effect](where, {}).place for where in REGISTRY[feature.effect].places(layout))
    own = REGISTRY[feature.effect](feature.where, {}).place
    return feature if own in known else Feature(feature.value, feature.slopes)


def _difference(i: int, j: int, where: Where) -> Feature:
    slopes: dict[int, Series] = {i: lambda along: -np.ones(along.time_s.size), j: constant()}
    return Feature(
        lambda along: along.temperatures_K[:, j] - along.temperatures_K[:, i], slopes, "missing_conductor", where
    )


def _leak(i: int, b: int, node: str, boundary: str) -> Feature:
    return Feature(
        lambda along: along.boundaries_K[:, b] - along.temperatures_K[:, i],
        {i: lambda along: -np.ones(along.time_s.size)},
        "leak_to_boundary",
        {"node": node, "boundary": boundary},
    )


def _radiation(i: int, b: int, node: str, sink: str) -> Feature:
    s = STEFAN_BOLTZMANN_W_PER_M2_K4
    return Feature(
        lambda along: s * (along.boundaries_K[:, b] ** 4 - along.temperatures_K[:, i] ** 4),
        {i: lambda along: -4.0 * s * along.temperatures_K[:, i] ** 3},
        "radiation_to_sink",
        {"node": node, "sink": sink},
    )


def _input(channel: str) -> Series:
    return lambda along: along.inputs.get(channel, np.zeros(along.time_s.size))


def _level(channel: str, levels: tuple[float, ...], k: int) -> Series:
    return lambda along: table_basis(along.inputs[channel], levels, True)[:, k]


def _harmonic(node: str, period_s: float) -> list[Feature]:
    rate = 2.0 * np.pi / period_s
    where = {"node": node}
    return [
        Feature(lambda along: np.sin(rate * along.time_s), {}, "periodic_heat_load", where),
        Feature(lambda along: np.cos(rate * along.time_s), {}, "periodic_heat_load", where),
    ]
