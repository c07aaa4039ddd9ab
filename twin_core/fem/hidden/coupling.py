"""Hidden changes of what is declared: a joint or a radiator that is not what it was, or depends on temperature."""

from collections.abc import Iterable
from typing import Literal

from twin_core._typing import FloatArray
from twin_core.fem.hidden.base import Bound, Declared, HiddenEffect, Instant, Moment, Plant, seconds
from twin_core.network.quantities import Name, Number, Positive, Temperature


def _unjoined(nodes: tuple[str, str], declared: Declared) -> Iterable[str]:
    if frozenset(nodes) not in declared.pairs_joined():
        yield f"'{nodes[0]}' and '{nodes[1]}' have no joint or strap that could change"


class ConductanceStep(HiddenEffect):
    """G becomes f G from an instant on; the change is heat (f - 1) times the joint's own."""

    effect: Literal["conductance_step"]
    nodes: tuple[Name, Name]
    f: Positive
    time: Instant

    def problems(self, declared: Declared) -> Iterable[str]:
        """Yield a pair that nothing joins."""
        return _unjoined(self.nodes, declared)

    def bind(self, plant: Plant) -> Bound:
        """Return the change of the joint's heat."""
        start_s = seconds(self.time, plant.epoch_ns)

        def heat_W(moment: Moment) -> FloatArray:
            extra = self.f - 1.0 if moment.time_s > start_s else 0.0
            return extra * plant.joint_heat_W(self.nodes, moment.temperature_K)

        return Bound(heat_W)


class ConductanceTemperature(HiddenEffect):
    """G becomes G (1 + beta (T_ab - T_ref)), T_ab the mean of both regions."""

    effect: Literal["conductance_temperature"]
    nodes: tuple[Name, Name]
    beta_per_K: Number
    T_ref_K: Temperature

    def problems(self, declared: Declared) -> Iterable[str]:
        """Yield a pair that nothing joins."""
        return _unjoined(self.nodes, declared)

    def bind(self, plant: Plant) -> Bound:
        """Return the change of the joint's heat."""

        def heat_W(moment: Moment) -> FloatArray:
            mean_K = sum(moment.mean_K(node) for node in self.nodes) / 2.0
            return self.beta_per_K * (mean_K - self.T_ref_K) * plant.joint_heat_W(self.nodes, moment.temperature_K)

        return Bound(heat_W)


class EmissivityStep(HiddenEffect):
    """A radiator's emissivity becomes f times its own from an instant on (f below 1: it is covered)."""

    effect: Literal["emissivity_step"]
    node: Name
    sink: Name
    f: Positive
    time: Instant

    def problems(self, declared: Declared) -> Iterable[str]:
        """Yield a radiator that is not declared."""
        if (self.node, self.sink) not in declared.radiating_pairs():
            yield f"'{self.node}' has no radiator to '{self.sink}'"

    def bind(self, plant: Plant) -> Bound:
        """Return the change of the radiator's heat."""
        start_s = seconds(self.time, plant.epoch_ns)

        def heat_W(moment: Moment) -> FloatArray:
            extra = self.f - 1.0 if moment.time_s > start_s else 0.0
            return extra * plant.radiator_heat_W(
                self.node, self.sink, moment.temperature_K, moment.boundary_K[self.sink]
            )

        return Bound(heat_W)
