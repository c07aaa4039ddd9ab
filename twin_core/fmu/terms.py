"""The heat balance of a network as C: one statement per heat flow, over temperatures T, boundaries B, inputs u, parameters p."""

import ast
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4
from twin_core.effects.base import Effect
from twin_core.effects.boundary_offset import Offset
from twin_core.effects.capacity_temperature import LEAST_SHARE, LinearCapacity
from twin_core.effects.constant_heat_load import ConstantHeat
from twin_core.effects.heat_load_step import SteppedHeat
from twin_core.effects.inputs import InputCorrection
from twin_core.effects.latent_heat import Melting
from twin_core.effects.missing_conductor import PairConductor
from twin_core.effects.nonlinear_convection import ROUNDING_K, PowerConvection
from twin_core.effects.periodic_heat_load import PeriodicHeat
from twin_core.effects.radiative_exchange import PairRadiation
from twin_core.effects.sensor_bias import Bias
from twin_core.effects.sensor_lag import Lag
from twin_core.errors import ModelError
from twin_core.network.formula import DAYS, parse
from twin_core.network.model import Network
from twin_core.network.terms import (
    BoundaryConductor,
    ChannelLoad,
    Conductors,
    NodeRadiation,
    OneWayConductor,
    ProportionalHeat,
    SinkRadiation,
    SteeredTable,
    TableLoad,
    Term,
)
from twin_core.network.thermostat import ThermostatHeat
from twin_core.units import parse_instant_ns

SIGMA = f"{STEFAN_BOLTZMANN_W_PER_M2_K4!r}"


@dataclass(frozen=True)
class Names:
    """Where things stand in the generated C.

    Attributes
    ----------
    inputs
        Channel -> position in u, derived channels included.
    parameters
        Parameter -> position in p.
    """

    inputs: Mapping[str, int]
    parameters: Mapping[str, int]

    def p(self, term: Any) -> list[str]:
        """Return the term's parameters, own and borrowed, as C."""
        names = [parameter.name for parameter in term.parameters] + list(term.borrows)
        return [f"p[{self.parameters[name]}]" for name in names]

    def u(self, channel: str) -> str:
        """Return a channel as C."""
        return f"u[{self.inputs[channel]}]"


def heats(network: Network, effects: Sequence[Effect], names: Names) -> Iterator[str]:
    """Yield the statements that add every heat to Q, (n_nodes,).

    Raises
    ------
    ModelError
        Naming what has no form in C.
    """
    added = [(effect, term) for effect in effects for term in effect.addition(network.layout).terms]
    declared = network.terms[: len(network.terms) - len(added)]
    told = [(term, "a declared term", "") for term in declared]
    told += [(term, f"the effect {effect.label}", effect.name) for effect, term in added]
    relay = 0
    for term, what, effect in told:
        if isinstance(term, ThermostatHeat):  # its memory changes at events alone
            yield f"Q[{term.node}] += {names.p(term)[0]} * share[{relay}];"
            relay += 1
        else:
            yield from _heat(term, names, what, effect)


def _heat(term: Term, names: Names, what: str, effect: str) -> Iterator[str]:
    p = names.p(term)
    match term:
        case Conductors(pairs=pairs):
            yield from (_between(a, b, f"{g} * (T[{b}] - T[{a}])") for (a, b), g in zip(pairs, p, strict=True))
        case PairConductor(first=a, second=b):
            yield _between(a, b, f"{p[0]} * (T[{b}] - T[{a}])")
        case NodeRadiation(pairs=pairs):
            yield from (_between(a, b, _fourth(r, f"T[{a}]", f"T[{b}]")) for (a, b), r in zip(pairs, p, strict=True))
        case PairRadiation(first=a, second=b):
            yield _between(a, b, _fourth(p[0], f"T[{a}]", f"T[{b}]"))
        case BoundaryConductor(node=a, boundary=b):
            yield f"Q[{a}] += {p[0]} * (B[{b}] - T[{a}]);"
        case SinkRadiation(node=a, boundary=b):
            yield f"Q[{a}] += {_fourth(p[0], f'T[{a}]', f'B[{b}]')};"
        case OneWayConductor(node=a, source=b):
            yield f"Q[{a}] += {p[0]} * (T[{b}] - T[{a}]);"
        case PowerConvection(node=a, boundary=b):
            yield f"Q[{a}] += convection({p[0]}, {p[1]}, B[{b}] - T[{a}], {ROUNDING_K!r});"
        case ProportionalHeat(node=a, control=control):
            sensed = a if control is None else control
            limit = p[2] if len(p) > 2 else "INFINITY"
            yield f"Q[{a}] += fmin({p[0]} * fmax({p[1]} - T[{sensed}], 0.0), {limit});"
        case ChannelLoad(node=a):
            yield f"Q[{a}] += {p[0]} * {_unit_heat(term, names)};"
        case InputCorrection(load=load) if effect in _CORRECTIONS:
            shape = _CORRECTIONS[effect](names.u(load.channel), p)
            yield f"Q[{load.node}] += {p[-1]} * {_unit_heat(load, names)} * ({shape});"
        case TableLoad(node=a, channel=x, knots=knots, levels=levels) if not isinstance(term, SteeredTable):
            weight = _product(
                repr(term.weight), "sun" if term.solar else "", names.u(term.factor) if term.factor else ""
            )
            table, places = ", ".join(p), ", ".join(map(repr, knots))
            lookup = f"{'nearest' if levels else 'linear'}({names.u(x)}, {len(knots)}, knots, values)"
            if term.visits:
                mean = " + ".join(f"{share!r} * {value}" for share, value in zip(term.visits, p, strict=True))
                lookup = f"({lookup} - ({mean}))"
            yield (f"{{ const double knots[] = {{{places}}}, values[] = {{{table}}}; Q[{a}] += {weight} * {lookup}; }}")
        case ConstantHeat(node=a):
            yield f"Q[{a}] += {p[0]};"
        case PeriodicHeat(node=a, origin_s=origin):
            phase = f"6.283185307179586 * (clock - {origin!r}) / {p[3]}"
            yield f"Q[{a}] += {p[0]} + {p[1]} * sin({phase}) + {p[2]} * cos({phase});"
        case SteppedHeat(node=a, effect=onset):
            width = repr(float(onset.settings["width_s"]))
            off = f" - ramp(clock, {p[2]}, {width})" if len(p) > 2 else ""
            yield f"Q[{a}] += {p[0]} * (ramp(clock, {p[1]}, {width}){off});"
        case Lag(node=a, reading=r):
            yield f"Q[{r}] += (T[{a}] - T[{r}]) / {p[0]};"
        case _:
            raise ModelError(
                f"{what} ({type(term).__name__}) has no form in C yet; take it out, or use the twin itself"
            )


_CORRECTIONS: dict[str, Callable[[str, list[str]], str]] = {
    "input_gain": lambda u, p: f"{p[0]} - 1.0",
}
"""Effects on inputs -> the factor of what is delivered beyond the declared heat."""


def extra_capacities(network: Network, names: Names) -> dict[int, str]:
    """Return node -> what it stores beyond its own capacity, in J/K, as C."""
    found: dict[int, str] = {}
    for term in network.capacities:
        p = names.p(term)
        match term:
            case LinearCapacity(node=a, reference_K=reference):
                more = f"{p[1]} * (bent(1.0 + {p[0]} * (T[{a}] - {reference!r}), {LEAST_SHARE!r}) - 1.0)"
            case Melting(node=a):
                more = f"{p[0]} * bell(T[{a}] - {p[1]}, {p[2]})"
            case _:
                raise ModelError(f"a capacity ({type(term).__name__}) has no form in C yet; use the twin itself")
        found[term.node] = found.get(term.node, "") + f" + {more}"
    return found


def boundary_changes(network: Network, names: Names) -> Iterator[str]:
    """Yield the statements that change boundary temperatures."""
    for term in network.boundary_terms:
        if not isinstance(term, Offset):
            raise ModelError(f"a change of a boundary ({type(term).__name__}) has no form in C yet")
        yield f"B[{term.boundary}] += {names.p(term)[0]};"


def reading_offsets(network: Network, names: Names) -> dict[int, str]:
    """Return sensor -> what it reads beyond its state, as C."""
    found: dict[int, str] = {}
    for term in network.readings:
        if not isinstance(term, Bias):
            raise ModelError(f"a fault of a sensor ({type(term).__name__}) has no form in C yet")
        p, width = names.p(term), repr(float(term.effect.settings["width_s"]))
        found[term.sensor] = found.get(term.sensor, "") + f" + {p[0]} * ramp(clock, {p[1]}, {width})"
    return found


def _between(a: int, b: int, heat: str) -> str:
    return f"q = {heat}; Q[{a}] += q; Q[{b}] -= q;"


def _fourth(area: str, own: str, other: str) -> str:
    return f"{SIGMA} * {area} * (fourth({other}) - fourth({own}))"


def _unit_heat(load: ChannelLoad, names: Names) -> str:
    factors = (repr(load.weight), names.u(load.channel), names.u(load.factor) if load.factor else "")
    return _product(*factors, "sun" if load.solar else "")


def _product(*factors: str) -> str:
    return " * ".join(factor for factor in factors if factor)


_BINARY: dict[type, str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_COMPARED: dict[type, str] = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
_CALLS = {
    "sin": "sin",
    "cos": "cos",
    "exp": "exp",
    "sqrt": "sqrt",
    "abs": "fabs",
    "round": "rint",
    "min": "fmin",
    "max": "fmax",
}


def formula(text: str, names: Names) -> str:
    """Return the formula of a derived channel as C."""
    return _c(parse(text), names)


def _c(tree: ast.expr, names: Names) -> str:
    match tree:
        case ast.Constant(value=value):
            return repr(float(value))  # type: ignore[arg-type]
        case ast.Name(id=name):
            return names.u(name)
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            return f"pow({_c(left, names)}, {_c(right, names)})"
        case ast.BinOp(left=left, op=op, right=right):
            return f"({_c(left, names)} {_BINARY[type(op)]} {_c(right, names)})"
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return f"(double)({_c(operand, names)} == 0.0)"
        case ast.UnaryOp(op=op, operand=operand):
            return f"({'-' if isinstance(op, ast.USub) else ''}{_c(operand, names)})"
        case ast.BoolOp(op=op, values=joined):
            sign = " && " if isinstance(op, ast.And) else " || "
            return f"(double)({sign.join(f'({_c(part, names)} != 0.0)' for part in joined)})"
        case ast.Compare(left=left, ops=[op], comparators=[right]):
            return f"(double)({_c(left, names)} {_COMPARED[type(op)]} {_c(right, names)})"
        case ast.Call(func=ast.Name(id=name), args=[ast.Constant(value=date)]) if name == DAYS:
            return f"((clock - {parse_instant_ns(str(date)) / 1e9!r}) / 86400.0)"
        case ast.Call(func=ast.Name(id="radians"), args=[arg]):
            return f"({_c(arg, names)} * 0.017453292519943295)"
        case ast.Call(func=ast.Name(id="where"), args=[test, yes, no]):
            return f"(({_c(test, names)}) != 0.0 ? {_c(yes, names)} : {_c(no, names)})"
        case ast.Call(func=ast.Name(id=name), args=args):
            return f"{_CALLS[name]}({', '.join(_c(arg, names) for arg in args)})"
    raise ModelError(f"the formula '{ast.unparse(tree)}' has no form in C yet")
