"""Whether a model that was made elsewhere fits a twin: its filter reads the archive by name, in the declared units."""

from collections.abc import Callable
from typing import Any

from service.errors import BadField
from service.twins.registry import Entry
from twin_core.network.spec import Node, TwinSpec

Json = dict[str, Any]


def refuse_foreign(model: TwinSpec, twin: Entry) -> None:
    """Refuse a model of another twin, or of other channels or nodes (422 naming the field).

    What a model declares beyond that, such as couplings and guesses, is its own affair.
    """
    if model.twin != twin.name:
        raise BadField("spec.twin", f"is '{model.twin}', must be '{twin.name}'")
    _compare_channels(model, twin.spec)
    _compare_nodes(model.nodes, twin.spec.nodes)


def lacks(model: Json, declared: Json) -> list[str]:
    """Return what two specifications do not have in common that shapes temperatures, in words; limits and guesses do not.

    Parameters
    ----------
    model, declared
        The specification that a model was made from, and the twin's as it is now.
    """
    found = []
    for what, parts in _PARTS.items():
        ours, own = parts(model), parts(declared)
        found += [f"{what} {name} is new" for name in sorted(own.keys() - ours.keys())]
        found += [f"{what} {name} is gone" for name in sorted(ours.keys() - own.keys())]
        found += [f"{what} {name} has changed" for name in sorted(ours.keys() & own.keys()) if ours[name] != own[name]]
    return found


def _sensors(spec: Json) -> dict[str, Any]:
    def read(node: Json) -> list[str]:
        sensors = node.get("sensor") or []
        return [sensors] if isinstance(sensors, str) else sensors

    return {sensor: node["id"] for node in spec["nodes"] for sensor in read(node)}


_PARTS: dict[str, Callable[[Json], dict[str, Any]]] = {
    "sensor": _sensors,
    "node": lambda spec: {node["id"]: None for node in spec["nodes"]},
    "boundary": lambda spec: {name: (b or {}).get("channel") for name, b in (spec.get("boundaries") or {}).items()},
    "conductor": lambda spec: {" – ".join(sorted(c["between"])): None for c in spec.get("conductors") or ()},
    "radiator": lambda spec: {
        f"{r['node']} → {r['sink']}": (r["emissivity"], r["area_m2"]) for r in spec.get("radiators") or ()
    },
    "load": lambda spec: {
        f"{c['channel']} → {c['node']}" + (f" × {c['factor']}" if c.get("factor") else ""): c.get("weight")
        for c in spec.get("loads") or ()
    },
    "radiation": lambda spec: {" – ".join(sorted(c["between"])): None for c in spec.get("radiation") or ()},
    "heater": lambda spec: {f"{h.get('control') or h['node']} → {h['node']}": None for h in spec.get("heaters") or ()},
    "derived channel": lambda spec: {name: d["formula"] for name, d in (spec.get("derived") or {}).items()},
}


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
