"""Whether a model that was made elsewhere fits a twin: its filter reads the archive by name, in the declared units."""

from service.errors import BadField
from service.registry import Entry
from twin_core.network.spec import Node, TwinSpec


def refuse_foreign(model: TwinSpec, twin: Entry) -> None:
    """Refuse a model of another twin, or of other channels or nodes (422 naming the field).

    What a model declares beyond that, such as couplings and guesses, is its own affair.
    """
    if model.twin != twin.name:
        raise BadField("spec.twin", f"is '{model.twin}', must be '{twin.name}'")
    _compare_channels(model, twin.spec)
    _compare_nodes(model.nodes, twin.spec.nodes)


def _compare_channels(model: TwinSpec, declared: TwinSpec) -> None:
    for name in declared.channels:
        if name not in model.channels:
            raise BadField("spec.channels", f"lacks the twin's channel '{name}'")
    for name, channel in model.channels.items():
        if name not in declared.channels:
            known = ", ".join(declared.channels)
            raise BadField(f"spec.channels.{name}", f"is no channel of the twin (known: {known})")
        for field in ("kind", "unit", "levels"):
            ours, own = getattr(channel, field), getattr(declared.channels[name], field)
            if ours != own:
                raise BadField(f"spec.channels.{name}.{field}", f"is {ours}, the twin's is {own}")


def _compare_nodes(model: tuple[Node, ...], declared: tuple[Node, ...]) -> None:
    for index, (ours, own) in enumerate(zip(model, declared, strict=False)):
        if ours.id != own.id:
            raise BadField(f"spec.nodes[{index}].id", f"is '{ours.id}', the twin's is '{own.id}'")
        if ours.sensors != own.sensors:
            read, wanted = (", ".join(node.sensors) or "no sensor" for node in (ours, own))
            raise BadField(f"spec.nodes[{index}].sensor", f"is {read}, the twin's is {wanted}")
    if len(model) != len(declared):
        raise BadField("spec.nodes", f"are {len(model)}, the twin has {len(declared)}")
