"""A declared conductor that changes at an instant: a bolt that loosened, a strap that tore, a joint that froze."""

from collections.abc import Iterable

from twin_core.effects.base import ParameterSpec, Where
from twin_core.effects.declared import Changed, conductor_places, declared_conductor
from twin_core.effects.onset import OnsetEffect
from twin_core.network.model import Addition, Layout


class ConductanceStep(OnsetEffect):
    """G -> f G from an instant on."""

    name = "conductance_step"
    keys = ("nodes",)
    equation = "q_a = -q_b = f G (T_b - T_a) from time on"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 8 (contact conductance)"
    sentence = "the conductance between {first} and {second} changed during the record"
    amplitude = ParameterSpec("f", "", null=1.0, lower=0.0)

    def addition(self, layout: Layout) -> Addition:
        """Return the change of the declared conductor."""
        conductor, name = declared_conductor(self, layout)
        term = Changed(conductor, self.change, self.parameters(), (name,))
        return Addition((term,), dated=self.settings["dated"])

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every declared conductor."""
        yield from conductor_places(layout)
