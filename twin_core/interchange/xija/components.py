"""Components of a Xija model, as its JSON lists them, and what their time constants say of the nodes.

Xija predicts in degrees Celsius and kiloseconds and knows no capacities: a node of 1000 J/K whose heats are in W obeys the
same equation, dT/dt = heat in K/ks, so that every number stays as it is. Nodes that are coupled both ways with different
time constants get capacities in that proportion, and the coupling becomes one conductor that loses no heat.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from twin_core.errors import SpecError
from twin_core.units import calendar_instant, parse_instant_ns

CAPACITY_J_PER_K = 1000.0
"""Capacity of a node, in J/K: 1 W into 1000 J/K is 1 K/ks, Xija's unit of a heat, so that its numbers stay."""

FIRST_METHOD, FIRST_METHOD_MORE = 1.5, 0.625
"""Xija's first way to integrate (``evolve_method`` 1, and models that name none) goes on from the middle of a step by a whole
one: y_2 = y_0 + h f_0 / 2 + h f_1. Its temperatures move 1.5 times as fast as its time constants say, and a rate z per step
makes 1.5 z + 0.625 z^2 of it, to second order. Models are fitted with it, so that this is what they mean."""

INSTRUMENTS = {
    "AcisPsmcSolarHeat": "all",
    "AllSimZSolarHeat": "all",
    "HrcISAcisSimZSolarHeat": "hrc-is",
    "AcisISHrcSimZSolarHeat": "acis-is",
}
"""Classes of solar heat that depends on the position of the instrument table -> its family of positions."""


@dataclass(frozen=True)
class Component:
    """One component of a model: its class, name, arguments by name, parameters by name, and the line where it stands.

    ``surplus`` is an argument that its class does not have.
    """

    kind: str
    name: str
    args: Mapping[str, Any]
    pars: Mapping[str, float]
    free: frozenset[str]
    line: int
    surplus: str = ""

    def par(self, name: str, default: float = 0.0) -> float:
        """Return the value of a parameter."""
        return float(self.pars.get(name, self.args.get(name, default)))


_SIGNATURES: dict[str, tuple[str, ...]] = {
    "Node": ("msid", "sigma", "quant", "predict", "mask", "name", "data", "fetch_attr"),
    "Coupling": ("node1", "node2", "tau"),
    "HeatSink": ("node", "T", "tau"),
    "HeatSinkRef": ("node", "T", "tau", "T_ref"),
    "SolarHeat": ("node", "pitch_comp", "eclipse_comp", "P_pitches", "Ps", "dPs", "var_func", "tau", "ampl", "bias",
                  "epoch", "dP_pitches"),
    "SolarHeatHrc": ("node", "simz_comp", "pitch_comp", "eclipse_comp", "P_pitches", "Ps", "dPs", "var_func", "tau",
                     "ampl", "bias", "epoch", "hrc_bias", "dP_pitches"),
    "SolarHeatHrcOpts": ("node", "simz_comp", "pitch_comp", "eclipse_comp", "P_pitches", "Ps", "dPs", "var_func", "tau",
                         "ampl", "bias", "epoch", "hrci_bias", "hrcs_bias", "dP_pitches"),
    "AcisPsmcSolarHeat": ("node", "pitch_comp", "simz_comp", "dh_heater_comp", "P_pitches", "P_vals", "dP_pitches",
                          "dPs", "var_func", "tau", "ampl", "epoch", "dh_heater"),
    "SolarHeatOffNomRoll": ("node", "pitch_comp", "roll_comp", "eclipse_comp", "P_plus_y", "P_minus_y"),
    "PropHeater": ("node", "node_control", "k", "T_set"),
    "ThermostatHeater": ("node", "node_control", "P", "T_set"),
    "StepFunctionPower": ("node", "time", "P", "id"),
    "MsidStatePower": ("node", "state_msid", "state_val", "P"),
    "AcisDpaStatePower": ("node", "mult", "fep_count", "ccd_count", "vid_board", "clocking", "pow_states"),
    "CmdStatesData": ("msid",),
    "TelemData": ("msid",),
    "Mask": ("node", "op", "val"),
}  # fmt: skip
"""Names of the arguments that come without one, by class."""
_SIGNATURES |= {
    "SolarHeatMulplicative": _SIGNATURES["SolarHeat"],
    "SolarHeatHrcMult": _SIGNATURES["SolarHeatHrcOpts"],
    **dict.fromkeys(INSTRUMENTS, _SIGNATURES["AcisPsmcSolarHeat"]),
}


def instant(text: str) -> str:
    """Return one of Xija's dates as RFC 3339: ``2016:322:12:00:00``, or ``2016:322``, which means noon."""
    full = text if text.count(":") > 1 else f"{text}:12:00:00"
    found = calendar_instant(full)
    parse_instant_ns(found)
    return found


def read_components(model: Mapping[str, Any], text: str, source: str) -> list[Component]:
    """Return the components of a model, parsed from ``text``, each with its parameters.

    Raises
    ------
    SpecError
        If an entry of ``comps`` or ``pars`` is none of a Xija model.
    """
    pars: dict[str, dict[str, float]] = {}
    free: dict[str, set[str]] = {}
    for i, par in enumerate(model.get("pars") or ()):
        try:
            owner, name = par["full_name"].rsplit("__", 1)
            pars.setdefault(owner, {})[name] = float(par["val"])
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise SpecError(f"{source}: pars[{i}] is no parameter of a Xija model ({error})") from error
        if not par.get("frozen", False):
            free.setdefault(owner, set()).add(name)
    found, offset = [], 0
    for i, comp in enumerate(model["comps"]):
        try:
            kind, name = str(comp["class_name"]), str(comp["name"])
            known = _SIGNATURES.get(kind, ())
            told = comp.get("init_args", ())
            args = dict(zip(known, told, strict=False)) | dict(comp.get("init_kwargs", {}))
            beyond = [repr(a) for a in told[len(known) :]] + [repr(n) for n in args if n not in known]
        except (KeyError, TypeError, ValueError) as error:
            raise SpecError(f"{source}: comps[{i}] is no component of a Xija model ({error})") from error
        offset = max(text.find(f'"{kind}"', offset), 0)
        line = text.count("\n", 0, offset) + 1
        offset += 1
        owners = [o for o in pars if o == name] or [o for o in pars if name.startswith(f"{o}__")]
        owner = owners[0] if owners else name
        surplus = beyond[0] if known and beyond else ""
        own = pars.get(owner, {}), frozenset(free.get(owner, ()))
        found.append(Component(kind, name, args, *own, line, surplus))
    return found


def couplings(components: Sequence[Component]) -> dict[tuple[str, str], Component]:
    """Return (changed node, other node) -> the coupling, for those that name both and a time constant."""
    whole = [c for c in components if c.kind == "Coupling" and is_whole(c)]
    return {(str(c.args["node1"]), str(c.args["node2"])): c for c in whole}


def is_whole(coupling: Component) -> bool:
    """Return whether a coupling names both nodes and a positive time constant."""
    return {"node1", "node2"} <= coupling.args.keys() and coupling.par("tau") > 0.0


def capacities(components: Sequence[Component]) -> dict[str, float]:
    """Return node -> capacity over ``CAPACITY_J_PER_K``: in proportion to the time constants of two-way couplings."""
    found, tau = {c.name: math.nan for c in components if c.kind == "Node"}, couplings(components)
    for root in found:
        if math.isnan(found[root]):
            found[root], queue = 1.0, [root]
            while queue:
                here = queue.pop()
                for (a, b), coupling in tau.items():
                    if a == here and (b, a) in tau and math.isnan(found.get(b, 0.0)):
                        found[b] = found[a] * tau[b, a].par("tau") / coupling.par("tau")
                        queue.append(b)
    return found


def speeds(model: Mapping[str, Any], components: Sequence[Component], source: str) -> dict[str, float]:
    """Return node -> by how much its temperature moves faster than its time constants say."""
    if model.get("evolve_method") == 2:
        return dict.fromkeys((c.name for c in components if c.kind == "Node"), 1.0)
    try:
        step_ks = 2.0 * float(model.get("dt", 328.0)) / 1000.0
    except (TypeError, ValueError) as error:
        raise SpecError(f"{source}: 'dt' of the model is no number ({error})") from error
    rate = {c.name: 0.0 for c in components if c.kind == "Node"}
    for c in components:
        node = str(c.args.get("node1" if c.kind == "Coupling" else "node"))
        if c.kind in ("Coupling", "HeatSink", "HeatSinkRef") and node in rate and c.par("tau"):
            rate[node] += 1.0 / c.par("tau")
    return {node: FIRST_METHOD + FIRST_METHOD_MORE * step_ks * r for node, r in rate.items()}
