"""What effects on a boundary share: where they can act, and the heat that a change of its temperature sends into the nodes."""

from collections.abc import Iterable

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, Survey, Where
from twin_core.errors import ModelError
from twin_core.network.model import Layout


def boundary_places(layout: Layout, *, constant: bool) -> Iterable[Where]:
    """Yield the boundaries that a channel tells, and where wanted the known constants, if anything declared reads them.

    An unknown constant has no place: it is calibrated as it is.
    """
    read = {boundary for _, boundary in layout.surfaces}
    for name, boundary in layout.spec.boundaries.items():
        if name in read and (boundary.channel is not None or (constant and boundary.value_K is not None)):
            yield {"boundary": name}


def changed_boundary(effect: Effect, layout: Layout, *, constant: bool) -> int:
    """Return the position of an effect's boundary; ModelError where there is none, or nothing of it to be changed."""
    name = effect.where["boundary"]
    position, declared = layout.boundary(name), layout.spec.boundaries[name]
    if declared.guess_K is not None:
        raise ModelError(
            f"effect {effect.name}: boundary '{name}' is an unknown constant, which is calibrated as it is"
        )
    if declared.channel is None and not constant:
        raise ModelError(f"effect {effect.name}: boundary '{name}' is constant; only boundary_offset can change it")
    return position


def heat_of_change(survey: Survey, boundary: str, change: FloatArray) -> list[tuple[int, FloatArray]]:
    """Return the heat into the nodes, (node, (n_points,)), per unit of what changes a boundary by (n_points,) in K."""
    return [(node, slope * change) for node, slope in survey.through_boundary(boundary)]
