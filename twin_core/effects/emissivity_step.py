"""A declared radiator that changes at an instant: contamination, a cover that opened, a coating that came off."""

from collections.abc import Iterable

from twin_core.effects.base import ParameterSpec, Where
from twin_core.effects.declared import Changed, declared_radiator, radiator_places
from twin_core.effects.onset import OnsetEffect
from twin_core.network.model import Addition, Layout


class EmissivityStep(OnsetEffect):
    """epsilon -> f epsilon from an instant on."""

    name = "emissivity_step"
    keys = ("node", "sink")
    equation = "q = sigma f epsilon A (T_s^4 - T^4) from time on"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 4 (thermal surface finishes)"
    sentence = "the emissivity of the radiator from {node} to {sink} changed during the record"
    amplitude = ParameterSpec("f", "", null=1.0, lower=0.0)

    def addition(self, layout: Layout) -> Addition:
        """Return the change of the declared radiator."""
        radiator, name = declared_radiator(self, layout)
        term = Changed(radiator, self.change, self.parameters(), (name,))
        return Addition((term,), dated=self.settings["dated"])

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every declared radiator."""
        yield from radiator_places(layout)
