"""Xija models (JSON), as they fly at the Chandra observatory -> a specification."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from twin_core.constants import ZERO_CELSIUS_K
from twin_core.errors import SpecError
from twin_core.interchange.imported import Data, Imported, name_of, number, twin_id
from twin_core.interchange.xija.components import (
    CAPACITY_J_PER_K,
    INSTRUMENTS,
    Component,
    capacities,
    couplings,
    instant,
    is_whole,
    read_components,
    speeds,
)
from twin_core.interchange.xija.draft import FITTED_SPREAD, Draft, UnknownError
from twin_core.interchange.xija.solar import off_nominal_roll, solar, solar_by_instrument

SWITCHING_BAND_K = 0.1
"""Width in K over which a thermostat without a deadband goes from all to nothing, for at its set-point it would switch at every
instant. Chosen: a small part of the 1 to 3 K by which flown models miss their telemetry."""

_POWER_STATES = ("0xxx", "1xxx", "2xxx", "3xx0", "3xx1", "4xxx", "5xxx", "66x0", "6611", "6xxx")


def read_xija(
    text: str,
    source: str,
    *,
    channels: Mapping[str, str] | None = None,
    constants: Mapping[str, float] | None = None,
    hidden: Sequence[str] = (),
    held: bool = False,
    spread: float = FITTED_SPREAD,
) -> Imported:
    """Return a Xija model as a specification.

    Parameters
    ----------
    text
        The JSON of its specification.
    source
        Its file, for messages.
    channels
        Component or MSID -> column of the telemetry. A column for ``dpa_power`` is the measured power in W, which then takes
        the place of the power that Xija looks up by the commanded state.
    constants
        Component -> the value that it always has: of an eclipse flag, say, that the telemetry lacks.
    hidden
        Nodes whose telemetry is not there.
    held
        Take every parameter as known; by default those that Xija does not freeze are calibrated.
    spread
        The factor by which what was fitted before may be off, one standard deviation; of a sink the same share of 100 K.

    Raises
    ------
    SpecError
        If the text is no Xija model, or a name in ``channels``, ``constants`` or ``hidden`` is none of its components.
    """
    try:
        model = json.loads(text)
    except ValueError as error:
        raise SpecError(f"{source}: not valid JSON ({error})") from error
    if not isinstance(model, dict) or not isinstance(model.get("comps"), list):
        raise SpecError(f"{source}: has no list 'comps'; a Xija model has one")
    components = read_components(model, text, source)
    names = {c.name for c in components} | {str(c.args.get("msid", "")).lower() for c in components}
    for name in (*(channels or {}), *(constants or {}), *hidden):
        if name not in names:
            known = ", ".join(sorted(n for n in names if n))
            raise SpecError(f"{source}: has no component '{name}' (it has {known})")
    speed = speeds(model, components, source)
    write = Draft(source, capacities(components), channels or {}, constants or {}, held, spread, speed)
    for component in components:
        translate = _TRANSLATORS.get(component.kind)
        try:
            if translate is None:
                raise UnknownError("is not a component that can be translated")
            if component.surplus:
                raise UnknownError(f"has the argument {component.surplus}, which is not read")
            if component.kind == "Node":
                _node(write, component, hidden, model.get("limits") or {})
            else:
                translate(write, component)
        except UnknownError as error:
            write.refused.append(f"{write.at(component)} {error}")
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            write.refused.append(f"{write.at(component)} cannot be read ({type(error).__name__}: {error})")
    _couple(write, components)
    read = {*write.channels, *write.derived}
    for c in components:
        if c.kind == "CmdStatesData" and write.measured.get(c.name, name_of(c.name, "_")) not in read:
            write.notes.append(f"{write.at(c)} is read by nothing and left out")
    return Imported(_document(write, model), tuple(write.notes), tuple(write.refused), _starts(components))


def _starts(components: Sequence[Component]) -> dict[str, float]:
    found = {c.name: c.args.get("data") for c in components if c.kind == "Node"}
    return {name_of(n): float(v) + ZERO_CELSIUS_K for n, v in found.items() if isinstance(v, int | float)}


def _document(write: Draft, model: Mapping[str, Any]) -> Data:
    excluded = [
        {"start": instant(start), "stop": instant(stop), "reason": "bad time of the Xija model"}
        for start, stop in model.get("bad_times", ())
    ]
    document: Data = {"twin": twin_id(str(model.get("name") or "xija"))}
    for key in ("boundaries", "channels", "derived", "nodes", "conductors", "loads", "heaters"):
        if part := getattr(write, key):
            document[key] = part
    return document | ({"exclude": excluded} if excluded else {})


def _couple(write: Draft, components: Sequence[Component]) -> None:
    """Add the couplings: one conductor where both ways fit to the capacities, else one for each way."""
    tau, done = couplings(components), set()
    for (a, b), coupling in tau.items():
        if a not in write.scale or b not in write.scale:
            write.refused.append(f"{write.at(coupling)} joins what is no node")
            continue
        conductance = write.scale[a] / coupling.par("tau", math.nan)
        entry: Data = {"between": [name_of(a), name_of(b)]}
        entry["conductance_W_per_K"] = write.quantity(coupling, conductance, "tau")
        back = tau.get((b, a))
        if back is None or not math.isclose(write.scale[b] / back.par("tau"), conductance, rel_tol=1e-9):
            write.conductors.append({**entry, "into": name_of(a)})
        elif (b, a) not in done:
            write.conductors.append(entry)
        done.add((a, b))


def _node(write: Draft, component: Component, hidden: Sequence[str], limits: Mapping[str, Any]) -> None:
    msid = str(component.args["msid"]).lower()
    if component.args.get("predict") is False:
        raise UnknownError("is not predicted but read from telemetry, as a boundary is")
    capacity = {"value": number(CAPACITY_J_PER_K * write.scale[component.name] / write.speed[component.name])}
    node: Data = {"id": name_of(component.name), "capacity_J_per_K": capacity}
    if isinstance(component.args.get("data"), int | float):
        write.notes.append(f"{write.at(component)} starts from {component.args['data']:g} degC and has no telemetry")
    elif component.name not in hidden and msid not in hidden:
        column = write.measured.get(component.name, write.measured.get(msid, name_of(f"T_{msid}")))
        node["sensor"] = column
        write.channels[column] = {"kind": "temperature", "unit": "degC"} | _limits(limits.get(msid) or {})
    write.nodes.append(node)


def _limits(told: Mapping[str, Any]) -> Data:
    """Return caution limits as yellow and warning limits as red."""
    found: Data = {}
    for colour, word in (("yellow", "caution"), ("red", "warning")):
        ends = [told.get(f"odb.{word}.{side}") for side in ("low", "high")]
        if any(end is not None for end in ends) and told.get("unit", "degC") == "degC":
            found[colour] = ends
    return {"limits": found} if found else {}


def _input(write: Draft, component: Component) -> None:
    """Declared by what reads it."""


def _heat_sink(write: Draft, component: Component) -> None:
    node, tau = str(component.args["node"]), component.par("tau", 20.0)
    sink_C = component.par("T")
    if tau <= 0.0:
        raise UnknownError(f"has a tau of {tau:g}")
    if component.kind == "HeatSinkRef":
        sink_C = component.par("P") * tau + component.par("T_ref", 20.0)
    name = name_of(component.name)
    key = "value_K" if write.key(component, "T", "P") == "value" else "guess_K"
    if sink_C < -ZERO_CELSIUS_K:
        raise UnknownError(f"has a sink of {sink_C:.0f} degC, below absolute zero")
    write.boundaries[name] = {key: number(sink_C + ZERO_CELSIUS_K)}
    if key == "guess_K":
        write.boundaries[name]["spread"] = number(100.0 * (write.spread - 1.0))
    conductance = write.quantity(component, write.scale[node] / tau, "tau")
    write.conductors.append({"between": [name_of(node), name], "conductance_W_per_K": conductance})


def _heater(write: Draft, component: Component) -> None:
    """A proportional heater; a thermostat without a deadband as one that goes from all to nothing within a narrow band."""
    node, set_K = str(component.args["node"]), component.par("T_set", 20.0) + ZERO_CELSIUS_K
    par = "k" if component.kind == "PropHeater" else "P"
    amount = component.par(par, 0.1)
    if amount == 0.0:
        write.notes.append(f"{write.at(component)}: {par} is 0 and left out")
        return
    if component.free & {"T_set"}:
        write.notes.append(f"{write.at(component)}: T_set is held, not calibrated")
    heat = write.quantity(component, write.scale[node] * amount, par)
    law: Data = {"set_K": number(set_K), "gain_W_per_K": heat}
    if par == "P":
        gain = {"value": number(write.scale[node] * amount / SWITCHING_BAND_K)}
        law = {"set_K": number(set_K + 0.5 * SWITCHING_BAND_K), "gain_W_per_K": gain, "most_W": heat}
        write.notes.append(
            f"{write.at(component)} has no deadband: it goes from P to nothing within {SWITCHING_BAND_K:g} K about T_set"
        )
    heater: Data = {"node": name_of(node), "proportional": law}
    if control := component.args.get("node_control"):
        heater["control"] = name_of(str(control))
    write.heaters.append(heater)


def _step_power(write: Draft, component: Component) -> None:
    when = instant(str(component.args["time"]))
    write.power(component, str(component.args["node"]), component.par("P"), f"days('{when}') >= 0.0", "P")


def _state_power(write: Draft, component: Component) -> None:
    flag = write.channel(component.name, levels=True)
    write.notes.append(
        f"{write.at(component)}: channel '{flag}' is 1 where {component.args['state_msid']} reads"
        f" '{component.args['state_val']}', else 0"
    )
    write.power(component, str(component.args["node"]), component.par("P"), f"1.0 * {flag}", "P")


def _electronics(write: Draft, component: Component) -> None:
    """Heat of the electronics: mult/100 (power - bias), the power looked up by the commanded state, or measured."""
    args, node = component.args, str(component.args["node"])
    mult, bias = component.par("mult", 1.0) / 100.0, component.par("bias", 70.0)
    if component.name in write.measured:
        column = write.measured[component.name]
        write.channels[column] = {"kind": "power", "unit": "W"}
        gain = write.quantity(component, write.scale[node] * mult, "mult")
        write.loads.append({"channel": column, "node": name_of(node), "gain": gain})
        write.power(component, node, -mult * bias, "1.0", "bias")
        write.notes.append(f"{write.at(component)}: driven by the measured power '{column}', not by commanded states")
        return
    parts = [write.channel(str(args[k]), levels=True) for k in ("fep_count", "ccd_count", "vid_board", "clocking")]
    told = [par.removeprefix("pow_") for par in component.pars if par.startswith("pow_")]
    patterns = told or list(args.get("pow_states") or _POWER_STATES)  # the parameters' own names win, as in Xija
    index = f"{len(patterns) - 1}.0"
    for k in reversed(range(len(patterns) - 1)):
        tests = [f"({c} == {d})" for c, d in zip(parts, patterns[k], strict=True) if d != "x"]
        index = f"where({' * '.join(tests) or '1.0'}, {k}.0, {index})"
    state = write.formula(f"{component.name}_state", index, levels=True)
    names = [f"pow_{p}" for p in patterns]
    heats = [mult * (component.par(n, 20.0) - bias) for n in names]
    write.table(component, node, state, list(range(len(patterns))), heats, None, names)


def _mask(write: Draft, component: Component) -> None:
    args = component.args
    write.notes.append(
        f"{write.at(component)}: samples of '{args.get('node')}' not {args.get('op')} {args.get('val')} take no part in"
        " Xija's fit; exclude them if they should take none here"
    )


def _coupling(write: Draft, component: Component) -> None:
    """Written after all, both ways together."""
    if component.kind == "Coupling" and not is_whole(component):
        raise UnknownError("does not name two nodes and a positive tau")


_TRANSLATORS: dict[str, Callable[[Draft, Component], None]] = {
    "Node": _coupling,
    "Coupling": _coupling,
    "HeatSink": _heat_sink,
    "HeatSinkRef": _heat_sink,
    **dict.fromkeys(
        ("SolarHeat", "SolarHeatMulplicative", "SolarHeatHrc", "SolarHeatHrcOpts", "SolarHeatHrcMult"), solar
    ),
    **dict.fromkeys(INSTRUMENTS, solar_by_instrument),
    "SolarHeatOffNomRoll": off_nominal_roll,
    **dict.fromkeys(("PropHeater", "ThermostatHeater"), _heater),
    "StepFunctionPower": _step_power,
    "MsidStatePower": _state_power,
    "AcisDpaStatePower": _electronics,
    "Mask": _mask,
    **dict.fromkeys(
        ("Pitch", "Roll", "Eclipse", "SimZ", "DetectorHousingHeater", "CmdStatesData", "TelemData"), _input
    ),
}
"""How each class is written; what is not here is refused by its name."""
