"""Xija models (JSON), as they fly at the Chandra observatory -> a specification.

Xija predicts in degrees Celsius and kiloseconds and knows no capacities: a node of 1000 J/K whose heats are in W obeys the
same equation, dT/dt = heat in K/ks, so that every number stays as it is. Nodes that are coupled both ways with different
time constants get capacities in that proportion, and the coupling becomes one conductor that loses no heat.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from twin_core.constants import ZERO_CELSIUS_K
from twin_core.errors import SpecError
from twin_core.interchange.imported import Data, Imported, name_of, number, twin_id
from twin_core.units import calendar_instant, parse_instant_ns

CAPACITY_J_PER_K = 1000.0
"""Makes a heat in W the same number as a rate in K/ks."""

FIRST_METHOD, FIRST_METHOD_MORE = 1.5, 0.625
"""Xija's first way to integrate (``evolve_method`` 1, and models that name none) goes on from the middle of a step by a whole
one: y_2 = y_0 + h f_0 / 2 + h f_1. Its temperatures move 1.5 times as fast as its time constants say, and a rate z per step
makes 1.5 z + 0.625 z^2 of it, to second order. Models are fitted with it, so that this is what they mean."""

FITTED_SPREAD, LEAST_SPREAD_W = 1.1, 0.05
"""How far off a fit of years of telemetry is taken to be, unless the user says so, as a factor; and for a table of zeros."""

YEAR_DAYS = 365.3
"""Xija's year, a tenth of 2000 to 2010."""

_INSTRUMENTS = {
    "AcisPsmcSolarHeat": "all",
    "AllSimZSolarHeat": "all",
    "HrcISAcisSimZSolarHeat": "hrc-is",
    "AcisISHrcSimZSolarHeat": "acis-is",
}
_POSITIONS: dict[str, tuple[tuple[str, float, float], ...]] = {
    "all": (
        ("hrcs", -400000.0, -85000.0),
        ("hrci", -85000.0, 0.0),
        ("aciss", 0.0, 83000.0),
        ("acisi", 83000.0, 400000.0),
    ),
    "hrc-is": (("hrcs", -400000.0, -85000.0), ("hrci", -85000.0, 0.0), ("acis", 0.0, 400000.0)),
    "acis-is": (("acisi", -400000.0, 0.0), ("aciss", 0.0, 83000.0), ("hrc", 83000.0, 400000.0)),
}
"""Positions of the instrument table for each family of solar heat: name, above, up to."""

HRC_S = -86147.0

_POWER_STATES = ("0xxx", "1xxx", "2xxx", "3xx0", "3xx1", "4xxx", "5xxx", "66x0", "6611", "6xxx")


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
    **dict.fromkeys(_INSTRUMENTS, _SIGNATURES["AcisPsmcSolarHeat"]),
}


def instant(text: str) -> str:
    """Return one of Xija's dates as RFC 3339: ``2016:322:12:00:00``, or ``2016:322``, which means noon."""
    full = text if text.count(":") > 1 else f"{text}:12:00:00"
    found = calendar_instant(full)
    parse_instant_ns(found)
    return found


@dataclass
class _Writer:
    """The specification as it grows."""

    source: str
    scale: Mapping[str, float]
    measured: Mapping[str, str]
    constant: Mapping[str, float]
    held: bool
    spread: float
    speed: Mapping[str, float]
    boundaries: Data = field(default_factory=dict)
    channels: Data = field(default_factory=dict)
    derived: Data = field(default_factory=dict)
    nodes: list[Data] = field(default_factory=list)
    conductors: list[Data] = field(default_factory=list)
    loads: list[Data] = field(default_factory=list)
    heaters: list[Data] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)

    def at(self, component: Component) -> str:
        """Return where a component stands."""
        return f"{self.source}: line {component.line}: {component.kind} '{component.name}'"

    def key(self, component: Component, *pars: str) -> str:
        """Return whether parameters are known or to be calibrated, as the specification says it."""
        return "guess" if not self.held and component.free & set(pars) else "value"

    def quantity(self, component: Component, value: float, *pars: str) -> Data:
        key = self.key(component, *pars)
        return {key: number(value)} | ({"spread": self.spread} if key == "guess" else {})

    def channel(self, name: str, *, levels: bool = False, unit: str | None = None) -> str:
        """Return the name of an auxiliary channel, declared once; a constant where the user says so."""
        if name in self.constant:
            self.derived[name_of(name, "_")] = {"formula": repr(float(self.constant[name]))}
            return name_of(name, "_")
        column = self.measured.get(name, name_of(name, "_"))
        entry: Data = {"kind": "auxiliary"} | ({"unit": unit} if unit else {})
        entry |= {"levels": True} if levels else {"interpolation": "hold"}
        self.channels.setdefault(column, entry)
        return column

    def formula(self, name: str, formula: str, *, levels: bool = False, unit: str | None = None) -> str:
        """Return the name of a derived channel, made once for each formula."""
        entry: Data = {"formula": formula} | ({"levels": True} if levels else {}) | ({"unit": unit} if unit else {})
        name = name_of(name, "_")
        while name in self.channels or self.derived.get(name, entry) != entry:
            name += "_"
        self.derived[name] = entry
        return name

    def table(
        self,
        component: Component,
        node: str,
        channel: str,
        knots: Sequence[float],
        values: Sequence[float],
        factor: str | None,
        pars: Sequence[str],
    ) -> None:
        """Add heat in K/ks over a channel."""
        if len(knots) == 1:
            raise _UnknownError("has a table of one value")
        known = self.key(component, *pars) == "value"
        scaled = [number(self.scale[node] * v) for v in values]
        key = "values_W" if known else "guess_W"
        table: Data = {"knots": [float(k) for k in knots], key: scaled}
        if not known:
            table["spread_W"] = number(max((self.spread - 1.0) * max(map(abs, scaled)), LEAST_SPREAD_W))
        load: Data = {"channel": channel, "node": name_of(node), "table": table}
        self._add({**load, "factor": factor} if factor is not None else load, component)

    def power(self, component: Component, node: str, amount: float, unit_heat: str, par: str) -> None:
        """Add ``amount`` times a formula, in K/ks."""
        if amount == 0.0:
            if component.free & {par}:
                self.notes.append(f"{self.at(component)}: {par} is 0 and left out")
            return
        sign = "" if amount > 0.0 else "-1.0 * "
        channel = self.formula(f"{component.name}_{par}", f"{sign}({unit_heat})", unit="W")
        gain = self.quantity(component, self.scale[node] * abs(amount), par)
        self._add({"channel": channel, "node": name_of(node), "gain": gain}, component)

    def _add(self, load: Data, component: Component) -> None:
        """Add a load; a second one of the same channel and factor on a node gets a factor of its own name."""
        seen = [(x["channel"], x["node"], x.get("factor")) for x in self.loads]
        if (load["channel"], load["node"], load.get("factor")) in seen:
            load["factor"] = self.formula(f"of_{component.name}", load.get("factor") or "1.0")
        self.loads.append(load)


class _UnknownError(Exception):
    """What a component is or has that cannot be translated."""


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
    components = _components(model, text, source)
    names = {c.name for c in components} | {str(c.args.get("msid", "")).lower() for c in components}
    for name in (*(channels or {}), *(constants or {}), *hidden):
        if name not in names:
            known = ", ".join(sorted(n for n in names if n))
            raise SpecError(f"{source}: has no component '{name}' (it has {known})")
    speed = _speeds(model, components, source)
    write = _Writer(source, _capacities(components), channels or {}, constants or {}, held, spread, speed)
    for component in components:
        translate = _TRANSLATORS.get(component.kind)
        try:
            if translate is None:
                raise _UnknownError("is not a component that can be translated")
            if component.surplus:
                raise _UnknownError(f"has the argument {component.surplus}, which is not read")
            if component.kind == "Node":
                _node(write, component, hidden, model.get("limits") or {})
            else:
                translate(write, component)
        except _UnknownError as error:
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


def _components(model: Mapping[str, Any], text: str, source: str) -> list[Component]:
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


def _couplings(components: Sequence[Component]) -> dict[tuple[str, str], Component]:
    whole = [c for c in components if c.kind == "Coupling" and _is_whole(c)]
    return {(str(c.args["node1"]), str(c.args["node2"])): c for c in whole}


def _is_whole(coupling: Component) -> bool:
    return {"node1", "node2"} <= coupling.args.keys() and coupling.par("tau") > 0.0


def _capacities(components: Sequence[Component]) -> dict[str, float]:
    """Return node -> capacity over ``CAPACITY_J_PER_K``: in proportion to the time constants of two-way couplings."""
    found, tau = {c.name: math.nan for c in components if c.kind == "Node"}, _couplings(components)
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


def _speeds(model: Mapping[str, Any], components: Sequence[Component], source: str) -> dict[str, float]:
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


def _couple(write: _Writer, components: Sequence[Component]) -> None:
    """Add the couplings: one conductor where both ways fit to the capacities, else one for each way."""
    tau, done = _couplings(components), set()
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


def _document(write: _Writer, model: Mapping[str, Any]) -> Data:
    excluded = [
        {"start": instant(start), "stop": instant(stop), "reason": "bad time of the Xija model"}
        for start, stop in model.get("bad_times", ())
    ]
    document: Data = {"twin": twin_id(str(model.get("name") or "xija"))}
    for key in ("boundaries", "channels", "derived", "nodes", "conductors", "loads", "heaters"):
        if part := getattr(write, key):
            document[key] = part
    return document | ({"exclude": excluded} if excluded else {})


def _node(write: _Writer, component: Component, hidden: Sequence[str], limits: Mapping[str, Any]) -> None:
    msid = str(component.args["msid"]).lower()
    if component.args.get("predict") is False:
        raise _UnknownError("is not predicted but read from telemetry, as a boundary is")
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


def _input(write: _Writer, component: Component) -> None:
    """Declared by what reads it."""


def _sunlit(write: _Writer, component: Component) -> str | None:
    """Return the channel that is 1 in sunlight and 0 in eclipse; None where the component knows no eclipse."""
    eclipse = component.args.get("eclipse_comp")
    if eclipse is None:
        return None
    return write.formula("sunlit", f"1.0 - {write.channel(str(eclipse), levels=True)}")


def _ageing(component: Component) -> str:
    """Return by how much heats have changed since their epoch, as a share of dP."""
    days = f"days('{instant(str(component.args.get('epoch', '2010:001:12:00:00')))}')"
    tau = component.par("tau", 1732.0)
    default = "linear" if component.kind in _INSTRUMENTS else "exp"
    law = component.args.get("var_func", default)
    if law == "linear":
        return f"{days} / {tau!r}"
    if law == "exp":
        return f"1.0 - exp(-1.0 * {days} / {tau!r})"
    raise _UnknownError(f"varies as '{law}'")


def _season() -> str:
    return f"cos({2.0 * math.pi / YEAR_DAYS!r} * days('2000-01-01T00:00:00Z'))"


def _values(component: Component, prefix: str, pitches: Sequence[float]) -> tuple[list[float], list[str]]:
    names = [f"{prefix}_{p:.0f}" for p in pitches]
    if lacking := [n for n in names if n not in component.pars]:
        raise _UnknownError(f"has no parameter {', '.join(lacking)}")
    return [component.par(n) for n in names], names


def _pitches(component: Component, key: str = "P_pitches") -> list[float]:
    return [float(p) for p in component.args.get(key) or component.args.get("P_pitches") or (45, 65, 90, 130, 180)]


def _solar(write: _Writer, component: Component) -> None:
    """Heat by pitch, ageing and season; the plain family adds the season, the multiplicative one scales with it."""
    args, node = component.args, str(component.args["node"])
    pitch = write.channel(str(args.get("pitch_comp") or "pitch"), unit="deg")
    lit = _sunlit(write, component)
    ampl = component.par("ampl", 0.05)
    times = [lit] if lit else []
    if component.kind in ("SolarHeatMulplicative", "SolarHeatHrcMult"):
        times.append(f"(1.0 + {ampl!r} * {_season()})")
        if component.free & {"ampl"}:
            write.notes.append(f"{write.at(component)}: ampl is held, not calibrated")
    elif ampl:
        write.power(component, node, ampl, " * ".join([*times, _season()]), "ampl")
    factor = (
        lit
        if len(times) < 2 and lit
        else write.formula(f"{component.name}_season", " * ".join(times))
        if times
        else None
    )
    knots, aged = _pitches(component), _pitches(component, "dP_pitches")
    bias = component.par("bias")
    values, names = _values(component, "P", knots)
    write.table(component, node, pitch, knots, [v + bias for v in values], factor, [*names, "bias"])
    changes, names = _values(component, "dP", aged)
    _aged(write, component, node, pitch, aged, changes, times, names)
    if component.kind.startswith("SolarHeatHrc"):
        sim_z = write.channel(str(args.get("simz_comp") or "sim_z"), levels=True)
        for par, where in (
            ("hrc_bias", f"{sim_z} < 0.0"),
            ("hrci_bias", f"({sim_z} < 0.0) * ({sim_z} > {HRC_S})"),
            ("hrcs_bias", f"{sim_z} <= {HRC_S}"),
        ):
            write.power(component, node, component.par(par), where, par)


def _aged(
    write: _Writer,
    component: Component,
    node: str,
    pitch: str,
    knots: Sequence[float],
    changes: Sequence[float],
    times: Sequence[str],
    names: Sequence[str],
) -> None:
    """Add what ageing adds to the heat by pitch."""
    if not any(changes):
        write.notes.append(f"{write.at(component)}: every dP is 0; ageing is left out")
        return
    if component.free & {"tau"}:
        write.notes.append(f"{write.at(component)}: tau of the ageing is held, not calibrated")
    factor = write.formula(f"{component.name}_ageing", " * ".join([*times, f"({_ageing(component)})"]))
    write.table(component, node, pitch, knots, changes, factor, names)


def _solar_by_instrument(write: _Writer, component: Component) -> None:
    """Heat by pitch and position of the instrument table."""
    args, node = component.args, str(component.args["node"])
    pitch = write.channel(str(args.get("pitch_comp") or "pitch"), unit="deg")
    sim_z = write.channel(str(args.get("simz_comp") or "sim_z"), levels=True)
    knots, aged = _pitches(component), _pitches(component, "dP_pitches")
    for name, low, high in _POSITIONS[_INSTRUMENTS[component.kind]]:
        factor = write.formula(f"at_{name}", f"({sim_z} > {low}) * ({sim_z} <= {high})")
        values, names = _values(component, f"P_{name}", knots)
        write.table(component, node, pitch, knots, values, factor, names)
    changes, names = _values(component, "dP", aged)
    _aged(write, component, node, pitch, aged, changes, [], names)
    write.power(component, node, component.par("ampl", 0.05), _season(), "ampl")
    name = str(args.get("dh_heater_comp") or "dh_heater")
    if write.constant.get(name) == 0.0:
        write.notes.append(f"{write.at(component)}: {name} is always 0; its heat is left out")
        return
    heater = write.channel(name, levels=True)
    write.power(component, node, component.par("dh_heater", 0.05), f"1.0 * {heater}", "dh_heater")


def _off_nominal_roll(write: _Writer, component: Component) -> None:
    args, node = component.args, str(component.args["node"])
    pitch = write.channel(str(args.get("pitch_comp") or "pitch"), unit="deg")
    roll = write.channel(str(args.get("roll_comp") or "roll"), unit="deg")
    lit = _sunlit(write, component)
    sun_y = write.formula("sun_y", f"sin(radians({pitch})) * sin(radians({roll}))")
    shade = f" * {lit}" if lit else ""
    write.power(component, node, component.par("P_plus_y"), f"max({sun_y}, 0.0){shade}", "P_plus_y")
    write.power(component, node, component.par("P_minus_y"), f"min({sun_y}, 0.0){shade}", "P_minus_y")


def _heat_sink(write: _Writer, component: Component) -> None:
    node, tau = str(component.args["node"]), component.par("tau", 20.0)
    sink_C = component.par("T")
    if tau <= 0.0:
        raise _UnknownError(f"has a tau of {tau:g}")
    if component.kind == "HeatSinkRef":
        sink_C = component.par("P") * tau + component.par("T_ref", 20.0)
    name = name_of(component.name)
    key = "value_K" if write.key(component, "T", "P") == "value" else "guess_K"
    if sink_C < -ZERO_CELSIUS_K:
        raise _UnknownError(f"has a sink of {sink_C:.0f} degC, below absolute zero")
    write.boundaries[name] = {key: number(sink_C + ZERO_CELSIUS_K)}
    if key == "guess_K":
        write.boundaries[name]["spread"] = number(100.0 * (write.spread - 1.0))
    conductance = write.quantity(component, write.scale[node] / tau, "tau")
    write.conductors.append({"between": [name_of(node), name], "conductance_W_per_K": conductance})


def _proportional_heater(write: _Writer, component: Component) -> None:
    node = str(component.args["node"])
    gain, set_K = component.par("k", 0.1), component.par("T_set", 20.0) + ZERO_CELSIUS_K
    if gain == 0.0:
        write.notes.append(f"{write.at(component)}: k is 0 and left out")
        return
    if component.free & {"T_set"}:
        write.notes.append(f"{write.at(component)}: T_set is held, not calibrated")
    law = {"set_K": number(set_K), "gain_W_per_K": write.quantity(component, write.scale[node] * gain, "k")}
    heater: Data = {"node": name_of(node), "proportional": law}
    if control := component.args.get("node_control"):
        heater["control"] = name_of(str(control))
    write.heaters.append(heater)


def _step_power(write: _Writer, component: Component) -> None:
    when = instant(str(component.args["time"]))
    write.power(component, str(component.args["node"]), component.par("P"), f"days('{when}') >= 0.0", "P")


def _state_power(write: _Writer, component: Component) -> None:
    flag = write.channel(component.name, levels=True)
    write.notes.append(
        f"{write.at(component)}: channel '{flag}' is 1 where {component.args['state_msid']} reads"
        f" '{component.args['state_val']}', else 0"
    )
    write.power(component, str(component.args["node"]), component.par("P"), f"1.0 * {flag}", "P")


def _electronics(write: _Writer, component: Component) -> None:
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


def _mask(write: _Writer, component: Component) -> None:
    args = component.args
    write.notes.append(
        f"{write.at(component)}: samples of '{args.get('node')}' not {args.get('op')} {args.get('val')} take no part in"
        " Xija's fit; exclude them if they should take none here"
    )


def _coupling(write: _Writer, component: Component) -> None:
    """Written after all, both ways together."""
    if component.kind == "Coupling" and not _is_whole(component):
        raise _UnknownError("does not name two nodes and a positive tau")


_TRANSLATORS: dict[str, Callable[[_Writer, Component], None]] = {
    "Node": _coupling,
    "Coupling": _coupling,
    "HeatSink": _heat_sink,
    "HeatSinkRef": _heat_sink,
    **dict.fromkeys(
        ("SolarHeat", "SolarHeatMulplicative", "SolarHeatHrc", "SolarHeatHrcOpts", "SolarHeatHrcMult"), _solar
    ),
    **dict.fromkeys(_INSTRUMENTS, _solar_by_instrument),
    "SolarHeatOffNomRoll": _off_nominal_roll,
    "PropHeater": _proportional_heater,
    "StepFunctionPower": _step_power,
    "MsidStatePower": _state_power,
    "AcisDpaStatePower": _electronics,
    "Mask": _mask,
    **dict.fromkeys(
        ("Pitch", "Roll", "Eclipse", "SimZ", "DetectorHousingHeater", "CmdStatesData", "TelemData"), _input
    ),
}
"""How each class is written; what is not here is refused by its name."""
