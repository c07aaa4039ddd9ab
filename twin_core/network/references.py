"""Whether what a specification names is declared, and declared once: every reference that is broken, in words."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from twin_core.network.formula import channels_of
from twin_core.network.orbit_block import PREFIX

if TYPE_CHECKING:
    from twin_core.network.spec import TwinSpec


def broken_references(spec: "TwinSpec") -> Iterable[str]:
    """Yield every broken reference; the first becomes the headline."""
    nodes = [node.id for node in spec.nodes]
    yield from _twice(nodes)
    yield from (f"boundaries.{name}: a node has the same id" for name in spec.boundaries if name in nodes)
    for name, boundary in spec.boundaries.items():
        if boundary.channel is not None:
            yield from _channel(spec, f"boundaries.{name}.channel", boundary.channel, ("temperature",))
    seen: dict[str, str] = {}
    for i, node in enumerate(spec.nodes):
        for sensor in node.sensors:
            yield from _channel(spec, f"nodes[{i}].sensor", sensor, ("temperature",))
            if sensor in seen:
                yield f"nodes[{i}].sensor: '{sensor}' already reads node '{seen[sensor]}'"
            seen[sensor] = node.id
    for name, boundary in spec.boundaries.items():
        if boundary.channel in seen:
            yield f"boundaries.{name}.channel: '{boundary.channel}' reads node '{seen[boundary.channel]}'; one of both"
    if not seen:
        yield "nodes: none has a sensor; name the temperature channel of at least one node"
    yield from _conductors(spec, nodes)
    yield from _unseen(spec)
    for i, radiator in enumerate(spec.radiators):
        yield from _end(f"radiators[{i}].node", radiator.node, nodes)
        yield from _end(f"radiators[{i}].sink", radiator.sink, list(spec.boundaries), "boundary")
        if (radiator.node, radiator.sink) in [(r.node, r.sink) for r in spec.radiators[:i]]:
            yield f"radiators[{i}]: '{radiator.node}' radiates to '{radiator.sink}' twice; add the areas"
    yield from _orbit(spec)
    yield from _radiation(spec, nodes)
    yield from _heaters(spec, nodes)
    yield from _derived(spec)
    yield from _loads(spec, nodes)
    yield from _shared(spec)
    for sensor in spec.criteria.per_sensor:
        if sensor not in seen:
            yield f"criteria.per_sensor.{sensor}: reads no node (sensors: {', '.join(seen) or 'none'})"


def unknown_names(data: Mapping[str, Any]) -> Iterable[str]:
    """Yield names that data declare nowhere, or twice, where other faults keep them from being a specification.

    What has not the form that it should have is passed over: those faults are told already.
    """

    def entries(field: str) -> Iterable[tuple[int, Mapping[str, Any]]]:
        listed = data.get(field)
        return (
            (i, entry)
            for i, entry in enumerate(listed if isinstance(listed, list) else ())
            if isinstance(entry, Mapping)
        )

    def keys(field: str) -> list[str]:
        declared = data.get(field)
        return [str(name) for name in declared] if isinstance(declared, Mapping) else []

    nodes = [str(entry.get("id")) for _, entry in entries("nodes")]
    yield from _twice(nodes)
    ends, channels = [*nodes, *keys("boundaries")], [*keys("channels"), *keys("derived")]
    for field in ("conductors", "radiation"):
        for i, entry in entries(field):
            pair = entry.get("between")
            for end in pair if isinstance(pair, list) else ():
                yield from _end(f"{field}[{i}].between", str(end), ends, "node or boundary")
    for field in ("radiators", "loads", "heaters"):
        for i, entry in entries(field):
            if "node" in entry:
                yield from _end(f"{field}[{i}].node", str(entry["node"]), nodes)
            if field == "radiators" and "sink" in entry:
                yield from _end(f"{field}[{i}].sink", str(entry["sink"]), keys("boundaries"), "boundary")
            if field == "loads" and "channel" in entry and not str(entry["channel"]).startswith(PREFIX):
                yield from _end(f"{field}[{i}].channel", str(entry["channel"]), channels, "channel")
    for i, entry in entries("nodes"):
        read = entry.get("sensor")
        for name in read if isinstance(read, list) else [] if read is None else [read]:
            yield from _end(f"nodes[{i}].sensor", str(name), channels, "channel")


def _twice(nodes: Sequence[str]) -> Iterable[str]:
    return (f"nodes[{i}].id: '{n}' is declared twice" for i, n in enumerate(nodes) if n in nodes[:i])


def _unseen(spec: "TwinSpec") -> Iterable[str]:
    """Refuse hidden nodes that are joined with one another and with no node that is read: no data tell anything of them.

    A single one may yet be joined by what the closed loop finds; it is told among the doubts. Nodes whose capacities are
    known, those of an imported deck, say, need no data.
    """
    groups = {node.id: {node.id} for node in spec.nodes}
    for first, second in [*(c.between for c in spec.conductors), *(r.between for r in spec.radiation)]:
        one, other = groups.get(first), groups.get(second)
        if one is not None and other is not None and one is not other:
            one |= other
            groups |= dict.fromkeys(other, one)
    read = {node.id for node in spec.nodes if node.sensors}
    known = {n.id for n in spec.nodes if n.capacity_J_per_K is not None and n.capacity_J_per_K.value is not None}
    for group in {id(group): group for group in groups.values()}.values():
        if len(group) > 1 and not group & read and not group <= known:
            names = ", ".join(sorted(group)[:5]) + (f" and {len(group) - 5} more" if len(group) > 5 else "")
            yield f"nodes: no sensor sees {names}: join one of them to a node with a sensor, or remove them"


def _shared(spec: "TwinSpec") -> Iterable[str]:
    """Check the shared unknowns: each is used, by quantities of one kind, and has a size to start from."""
    used: dict[str, str] = {}
    for field, tie, unit in spec.ties:
        if tie[0] not in spec.parameters:
            known = ", ".join(spec.parameters) or "none"
            yield f"{field}: unknown parameter '{tie[0]}'; declare it under parameters (known: {known})"
        elif used.setdefault(tie[0], unit) != unit:
            yield f"{field}: '{tie[0]}' is in {used[tie[0]]} elsewhere and would be in {unit} here; give it another name"
    for name, quantity in spec.parameters.items():
        if ":" in name or "." in name:
            yield f"parameters.{name}: a shared unknown has neither ':' nor '.' in its name"
        if quantity.guess is None and quantity.value is None:
            yield f"parameters.{name}: give a 'guess' that is calibrated, or a 'value' that is held"
        if name not in used:
            yield f"parameters.{name}: is used nowhere; name it as 'per_area', 'per_mass' or 'scale', or remove it"


def _orbit(spec: "TwinSpec") -> Iterable[str]:
    for name in () if spec.orbit is None else spec.orbit.units:
        if name in spec.channels:
            yield f"channels.{name}: comes from the orbit; remove it, or declare no orbit"
    for name in spec.attitude_channels:
        yield from _channel(spec, "orbit.attitude.quaternion_channels", name, ("auxiliary",))
        if name in spec.channels and spec.channels[name].levels:
            yield f"orbit.attitude.quaternion_channels: channel '{name}' has levels; a quaternion has none"


def _conductors(spec: "TwinSpec", nodes: list[str]) -> Iterable[str]:
    pairs: set[tuple[frozenset[str], str | None]] = set()
    joined: set[frozenset[str]] = set()
    for i, conductor in enumerate(spec.conductors):
        ends = frozenset(conductor.between)
        for end in conductor.between:
            yield from _end(f"conductors[{i}].between", end, [*nodes, *spec.boundaries], "node or boundary")
        if ends <= set(spec.boundaries):
            yield f"conductors[{i}].between: joins two boundaries; one end must be a node"
        if conductor.into in spec.boundaries:
            yield f"conductors[{i}].into: '{conductor.into}' is a boundary, which nothing heats; name the node"
        if (ends, conductor.into) in pairs or (((ends, None) in pairs or conductor.into is None) and ends in joined):
            yield f"conductors[{i}].between: {' and '.join(conductor.between)} are joined twice; add the conductances"
        pairs.add((ends, conductor.into))
        joined.add(ends)


def _radiation(spec: "TwinSpec", nodes: list[str]) -> Iterable[str]:
    seen = {frozenset((r.node, r.sink)) for r in spec.radiators}
    for i, coupling in enumerate(spec.radiation):
        for end in coupling.between:
            yield from _end(f"radiation[{i}].between", end, [*nodes, *spec.boundaries], "node or boundary")
        ends = frozenset(coupling.between)
        if ends <= set(spec.boundaries):
            yield f"radiation[{i}].between: joins two boundaries; one end must be a node"
        if ends in seen:
            yield f"radiation[{i}].between: {' and '.join(coupling.between)} radiate twice; add the areas"
        seen.add(ends)


def _heaters(spec: "TwinSpec", nodes: list[str]) -> Iterable[str]:
    names = [heater.name for heater in spec.heaters]
    for i, heater in enumerate(spec.heaters):
        yield from _end(f"heaters[{i}].node", heater.node, nodes)
        yield from _end(f"heaters[{i}].control", heater.controlled_by, nodes)
        if heater.thermostat is not None and heater.controlled_by != heater.node:
            yield (
                f"heaters[{i}].control: a thermostat is switched by the node that it heats; leave 'control' out, or use"
                " 'proportional', which may read another node"
            )
        if heater.name in names[:i]:
            yield f"heaters[{i}]: node '{heater.node}' has another heater with the same control; add the powers"


def _derived(spec: "TwinSpec") -> Iterable[str]:
    known = [*spec.channels, *spec.orbit_channels]
    for name, derived in spec.derived.items():
        if name in known:
            yield f"derived.{name}: a channel has the same name"
        for read in channels_of(derived.formula):
            if read not in known:
                yield f"derived.{name}.formula: unknown channel '{read}' (known: {', '.join(known) or 'none'})"
            elif spec.inputs[read].kind == "temperature":
                yield f"derived.{name}.formula: '{read}' is a temperature, which the model predicts; use other channels"
        known.append(name)


def _loads(spec: "TwinSpec", nodes: list[str]) -> Iterable[str]:
    weights: dict[str, float] = {}
    for i, load in enumerate(spec.loads):
        yield from _end(f"loads[{i}].node", load.node, nodes)
        yield from _channel(spec, f"loads[{i}].channel", load.channel, ("power", "auxiliary"))
        if load.solar and load.channel in spec.orbit_channels:
            yield f"loads[{i}].solar: '{load.channel}' follows the Sun's distance already; leave it out"
        if load.factor is not None:
            yield from _channel(spec, f"loads[{i}].factor", load.factor, ("auxiliary",))
        if (load.channel, load.node, load.factor) in [(x.channel, x.node, x.factor) for x in spec.loads[:i]]:
            yield f"loads[{i}]: channel '{load.channel}' heats node '{load.node}' twice; add the weights"
        channel = spec.inputs.get(load.channel)
        if channel is None or channel.kind == "temperature":
            continue
        if load.table is None and channel.kind == "auxiliary":
            yield f"loads[{i}].table: auxiliary channel '{load.channel}' is not heat; give a table with knots"
        if load.table is not None and channel.kind == "power":
            yield f"loads[{i}].table: '{load.channel}' is heat already; a table explains an auxiliary channel"
        if load.table is not None and load.gain is not None:
            yield f"loads[{i}].gain: a load with a table has no gain; its values are calibrated"
        if load.table is not None and channel.levels is False and load.table.knots is None:
            yield f"loads[{i}].table.knots: missing; '{load.channel}' has no levels"
        if load.table is None and load.gain is None and channel.unit == "W" and load.factor is None:
            weights[load.channel] = weights.get(load.channel, 0.0) + load.weight
    for name, total in weights.items():
        if total > 1.0 + 1e-9:
            yield f"loads: the weights of channel '{name}' add to {total:g}; they may add to 1 at most"


def _channel(spec: "TwinSpec", field: str, name: str, kinds: tuple[str, ...]) -> Iterable[str]:
    if name not in spec.inputs:
        how = "declare it under channels"
        if name.startswith(PREFIX):
            how = "declare the orbit" if spec.orbit is None else "correct its name"
        yield f"{field}: unknown channel '{name}'; {how} (known: {', '.join(spec.inputs) or 'none'})"
    elif spec.inputs[name].kind not in kinds:
        yield f"{field}: channel '{name}' is {spec.inputs[name].kind}, must be {' or '.join(kinds)}"


def _end(field: str, name: str, known: list[str], what: str = "node") -> Iterable[str]:
    if name not in known:
        yield f"{field}: unknown {what} '{name}' (known: {', '.join(dict.fromkeys(known)) or 'none'})"
