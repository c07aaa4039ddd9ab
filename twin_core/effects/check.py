"""Whether an effect keeps the conventions, and whether its derivatives are right: what a plug-in must pass to be used."""

import json
import pickle
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, read, to_json
from twin_core.effects.heat import effect_heat_W
from twin_core.effects.slopes import slope_errors
from twin_core.effects.testbed import active_effect, every_term_network, null_effects, points, survey_of
from twin_core.errors import PluginError, TwinError
from twin_core.network.dynamics import fill_boundaries
from twin_core.network.model import Network
from twin_core.network.terms import Along

WHERE_KEYS = ("node", "nodes", "sink", "boundary", "channel", "sensor")
UNITS = {
    "_J_per_K": "J/K",
    "_W_per_K": "W/K",
    "_K_per_s": "K/s",
    "_per_K": "1/K",
    "_per_s": "1/s",
    "_m2": "m2",
    "_J": "J",
    "_W": "W",
    "_K": "K",
    "_s": "s",
}
"""How the name of a parameter ends -> its unit."""

N_POINTS, SEED = 60, 1
"""Points of the test network, other than those that the effects start from: a set-point lies on one of those."""

AMOUNT = 1e-3
"""How far amplitudes are moved from null to tell the slope there."""

TOLERANCE = 1e-5
"""Of a slope, as a share of the largest one; of the slope at null, ten times as much."""

COLDEST_K, HOTTEST_K = 100.0, 450.0


@dataclass(frozen=True)
class Check:
    """One line of the outcome.

    Attributes
    ----------
    name
        What was checked.
    passed
        Whether it holds.
    detail
        What was found, or what is wrong and what to do.
    """

    name: str
    passed: bool
    detail: str


class _Wrong(Exception):
    """A convention is not kept; the message says which and what to do."""


def check_effect(kind: type[Effect]) -> list[Check]:
    """Check an effect in a network with every kind of term; the first four decide whether the rest is tried."""
    outcome = []
    for position, (name, check) in enumerate(CHECKS.items()):
        try:
            with np.errstate(all="ignore"):  # a number that is not finite is told by the check that meets it
                outcome.append(Check(name, True, check(kind)))
        except _Wrong as wrong:
            outcome.append(Check(name, False, str(wrong)))
        except TwinError as error:
            outcome.append(Check(name, False, str(error)))
        except Exception as error:
            outcome.append(Check(name, False, f"raises {type(error).__name__}: {error}"))
        if position < 4 and not outcome[-1].passed:
            break
    return outcome


def require_sound(outcomes: Mapping[type[Effect], Sequence[Check]], file: Path) -> None:
    """Raise PluginError with the first check that an effect of a file fails."""
    for kind, outcome in outcomes.items():
        failed = [check for check in outcome if not check.passed]
        if failed:
            raise PluginError(
                f"{file}: effect {kind.name}: {failed[0].name}: {failed[0].detail}; correct it "
                f"(twin check-effect {file} shows every check)"
            )


def _names(kind: type[Effect]) -> str:
    if not re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", kind.name):
        raise _Wrong(f"name '{kind.name}' must be lower-case words joined by underscores")
    unknown = [key for key in (*kind.keys, *kind.optional_keys) if key not in WHERE_KEYS]
    if unknown:
        raise _Wrong(f"keys: '{unknown[0]}' is none of {', '.join(WHERE_KEYS)}")
    if "=" not in kind.equation:
        raise _Wrong("equation must say what the heat or the change is, with a '='")
    places = list(kind.places(every_term_network().layout))
    for where in places:
        try:
            kind.told(where)
        except (KeyError, IndexError, ValueError) as error:
            raise _Wrong(f"sentence '{kind.sentence}' does not fit the place {where} ({error})") from error
    return kind.told(places[0]) if places else kind.sentence


def _places(kind: type[Effect]) -> str:
    layout = every_term_network().layout
    places = list(kind.places(layout))
    if not places:
        raise _Wrong("places yields none in a network with every kind of term")
    for where in places:
        if tuple(where) not in {kind.keys, kind.keys + kind.optional_keys}:
            raise _Wrong(f"places yields {where}, whose keys are not those of 'keys'")
    return f"{len(places)}"


def _starts(kind: type[Effect]) -> str:
    starts = null_effects(kind)
    for effect in starts:
        if not effect.amplitudes:
            raise _Wrong("no parameter has a null value; give the one that scales the effect 'null='")
        for spec in effect.parameter_specs():
            if spec.null is not None and effect.values[spec.name] != spec.null:
                raise _Wrong(f"starts yields {spec.name} = {effect.values[spec.name]:g}, not null")
    layout = every_term_network([starts[0]]).layout
    return f"{len(starts)} at the first place, {len(layout.nodes) - len(layout.declared_nodes)} states of its own"


def _parameters(kind: type[Effect]) -> str:
    effect = active_effect(kind)
    parameter_specs = effect.parameter_specs()
    if len({q.name for q in parameter_specs}) < len(parameter_specs):
        raise _Wrong("two parameters have the same name")
    for spec in parameter_specs:
        base = spec.name.partition("[")[0]
        suffix = next((end for end in UNITS if base.endswith(end)), None)
        if suffix is not None and spec.unit != UNITS[suffix]:
            raise _Wrong(f"{spec.name} says {UNITS[suffix]}, its unit is '{spec.unit}'")
        wanted = next((end for end, unit in UNITS.items() if unit == spec.unit), None)
        if suffix is None and wanted is not None and spec.instant is None and not kind.fallback:
            raise _Wrong(f"{spec.name} is in {spec.unit}; let its name end in {wanted}")
    return ", ".join(f"{q.name} ({q.unit})" if q.unit else q.name for q in parameter_specs)


def _null(kind: type[Effect]) -> str:
    declared = every_term_network().layout
    for effect in null_effects(kind):
        if any(node.reads or node.follows for node in effect.extra_nodes(declared)):
            return "a state that follows at once: not checked"
        network = every_term_network([effect])
        along = _filled(network, points(network, N_POINTS, SEED))
        if np.any(_added_heat_W(effect, network, along)[:, : len(declared.nodes)]):
            raise _Wrong(f"at null ({_values(effect)}) it still brings heat")
        for term in effect.addition(network.layout).readings:
            at_null = network.parameters.values[network.term_index(term)]
            if np.any(term.evaluate(along.time_s, at_null).offset_K):
                raise _Wrong(f"at null ({_values(effect)}) it still changes the reading")
    return "exactly nothing"


def _finite(kind: type[Effect]) -> str:
    effect = active_effect(kind)
    network = every_term_network([effect])
    along = points(network, N_POINTS, SEED)
    spread = np.linspace(COLDEST_K, HOTTEST_K, N_POINTS)
    along = replace(along, temperatures_K=np.broadcast_to(spread[:, None], along.temperatures_K.shape).copy())
    if not np.isfinite(_added_heat_W(effect, network, _filled(network, along))).all():
        raise _Wrong(f"its heat is not finite between {COLDEST_K:g} K and {HOTTEST_K:g} K")
    return f"{COLDEST_K:g} K to {HOTTEST_K:g} K"


def _derivatives(kind: type[Effect]) -> str:
    network = every_term_network([effect := active_effect(kind)])
    along = _filled(network, points(network, N_POINTS, SEED))
    worst = 0.0
    for what, error in slope_errors(network, effect.addition(network.layout), along):
        if not error <= TOLERANCE:
            raise _Wrong(f"{what} is off by {error:.1g} of the largest, against central differences")
        worst = max(worst, error)
    return f"central differences agree to {worst:.0e}" if worst else "central differences agree to rounding"


def _amplitude(kind: type[Effect]) -> str:
    declared = every_term_network()
    survey = survey_of(declared, points(declared, N_POINTS, SEED))
    effect = null_effects(kind)[0]
    if effect.extra_nodes(declared.layout):
        return "adds a state: not checked"
    columns = effect.unit_heats(survey)
    if len(columns) != len(effect.amplitudes):
        raise _Wrong(f"unit_heats returns {len(columns)} columns for {len(effect.amplitudes)} amplitudes")
    for k, column in enumerate(columns):
        found = np.zeros_like(survey.along.temperatures_K)
        for node, series in column:
            found[:, node] += series
        expected = _slope_at_null(effect, survey.along, survey.rate_K_per_s, k)
        scale = float(np.abs(expected).max())
        if not np.abs(found - expected).max() <= 10.0 * TOLERANCE * scale + 1e-9:
            name = effect.parameter_specs()[effect.amplitudes[k]].name
            raise _Wrong(f"unit_heats is not the slope of the heat with {name} at null")
    return "the slope at null"


def _energy(kind: type[Effect]) -> str:
    effect = active_effect(kind)
    network = every_term_network([effect])
    inner = "nodes" in kind.keys and all(name in network.nodes for name in effect.where["nodes"])
    stores = any(not node.capacity.frozen for node in effect.extra_nodes(every_term_network().layout))
    if not (inner or stores):
        return "no exchange between nodes"
    heat = _added_heat_W(effect, network, _filled(network, points(network, N_POINTS, SEED)))
    if np.abs(heat.sum(axis=1)).max() > 1e-9 * np.abs(heat).max():
        raise _Wrong("what one node gives, the other does not receive: the heats must add up to zero")
    return "what one node gives, the other receives"


def _sign(kind: type[Effect]) -> str:
    effect = active_effect(kind)
    network = every_term_network([effect])
    addition = effect.addition(network.layout)
    other = effect.where.get("sink") or effect.where.get("boundary")
    pair = effect.where.get("nodes")
    own = len(addition.terms) and not any(term.borrows for term in addition.terms) and not kind.fallback
    if not own or not (pair or (other and "node" in effect.where)):
        return "no exchange of its own"
    along = _filled(network, points(network, N_POINTS, SEED))
    heat = _added_heat_W(effect, network, along)
    known = dict(zip(network.nodes, along.temperatures_K.T, strict=True))
    known |= dict(zip(network.layout.boundaries, along.boundaries_K.T, strict=True))
    first, second = pair or (effect.where["node"], str(other))
    if np.any(heat[:, network.layout.node(first)] * (known[second] - known[first]) < 0.0):
        raise _Wrong(f"heat flows into {first} while {second} is colder: heat into a node counts positive")
    return "heat into a node is positive, from warm to cold"


def _json(kind: type[Effect]) -> str:
    for effect in (*null_effects(kind), active_effect(kind, 1.0 / 3.0)):
        again = read(kind, json.loads(json.dumps(to_json(effect), allow_nan=False)), "effects[0]")
        if again != effect:
            raise _Wrong(
                "written to JSON and read back, it is another: settings hold numbers, strings and tuples alone"
            )
    return "there and back is exact"


def _processes(kind: type[Effect]) -> str:
    effect = active_effect(kind)
    try:
        again, addition = pickle.loads(pickle.dumps((effect, effect.addition(every_term_network([effect]).layout))))
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise _Wrong(
            f"{error}: candidates are fitted in processes of their own, so let terms hold methods or "
            "functions of the module instead of local ones"
        ) from error
    if again != effect or len(addition.terms) != len(effect.addition(every_term_network([effect]).layout).terms):
        raise _Wrong("sent to another process, it is another")
    return "can be sent from one to another"


CHECKS: dict[str, Callable[[type[Effect]], str]] = {
    "name and sentence": _names,
    "places": _places,
    "starts": _starts,
    "parameters": _parameters,
    "null": _null,
    "range": _finite,
    "derivatives": _derivatives,
    "amplitude": _amplitude,
    "energy": _energy,
    "sign": _sign,
    "model file": _json,
    "processes": _processes,
}


def _values(effect: Effect) -> str:
    return ", ".join(f"{name} = {value:g}" for name, value in effect.values.items())


def _filled(network: Network, along: Along) -> Along:
    """Return the points with unknown boundaries at their value."""
    return replace(along, boundaries_K=fill_boundaries(network, network.parameters.values, along.boundaries_K))


def _added_heat_W(effect: Effect, network: Network, along: Along, rate_K_per_s: FloatArray | None = None) -> FloatArray:
    """Return the heat that an effect brings, (n_points, n_nodes); a capacity at given rates as what it swallows."""
    heat = effect_heat_W(effect, network, along)
    rates = np.ones_like(heat) if rate_K_per_s is None else rate_K_per_s
    for term in effect.addition(network.layout).capacities:
        values = network.parameters.values[network.term_index(term)]
        more = term.evaluate(along.temperatures_K[:, term.node], values)
        heat[:, term.node] -= more.extra_J_per_K * rates[:, term.node]
    return heat


def _slope_at_null(effect: Effect, along: Along, rate_K_per_s: FloatArray, amplitude: int) -> FloatArray:
    """Return d heat / d amplitude at null by one-sided differences of second order: some amplitudes are positive.

    Some cannot move alone either: the slope is that along all of them with this one twice, less that along all.
    """

    def heat(direction: FloatArray, amount: float) -> FloatArray:
        moved = effect.with_amplitudes(amount * direction) if amount else effect
        if moved is None:
            raise _Wrong(f"refuses amplitudes {amount:g} above null")
        return _added_heat_W(moved, every_term_network([moved]), along, rate_K_per_s)

    def slope(direction: FloatArray) -> FloatArray:
        rise = 4.0 * heat(direction, AMOUNT) - heat(direction, 2.0 * AMOUNT) - 3.0 * heat(direction, 0.0)
        return rise / (2.0 * AMOUNT)

    together, alone = np.ones(len(effect.amplitudes)), np.eye(len(effect.amplitudes))[amplitude]
    return slope(together + alone) - slope(together)
