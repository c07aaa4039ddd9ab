"""A network of another tool as it is read, node by node and coupling by coupling, and its specification."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from twin_core._typing import Json
from twin_core.constants import ZERO_CELSIUS_K
from twin_core.errors import SpecError
from twin_core.interchange.imported import Course, Imported, number
from twin_core.wording import counted

SMALLEST = 1e-12
"""A coupling that is smaller carries nothing; the specification knows none."""


@dataclass
class Deck:
    """What a deck says, in SI.

    Attributes
    ----------
    name
        Of the model.
    capacities
        Node -> J/K; 0 for an arithmetic one.
    boundaries
        Node -> K.
    start_K
        Node -> its temperature in the deck.
    linear, radiative
        (node, node) -> W/K, m2; parallel ones are added up.
    one_way
        (from, to) -> W/K.
    heats_W
        Cause -> node -> W; what is negative cools.
    driven
        Channel -> node -> factor by which the channel's heat goes into it.
    courses
        Channel -> how it goes over time, in W.
    labels
        Node -> what the deck calls it.
    notes, refused
        As of ``Imported``.
    """

    name: str
    capacities: dict[str, float] = field(default_factory=dict)
    boundaries: dict[str, float] = field(default_factory=dict)
    start_K: dict[str, float] = field(default_factory=dict)
    linear: dict[tuple[str, str], float] = field(default_factory=dict)
    radiative: dict[tuple[str, str], float] = field(default_factory=dict)
    one_way: dict[tuple[str, str], float] = field(default_factory=dict)
    heats_W: dict[str, dict[str, float]] = field(default_factory=dict)
    driven: dict[str, dict[str, float]] = field(default_factory=dict)
    courses: dict[str, Course] = field(default_factory=dict)
    labels: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    parallel: int = 0

    def knows(self, node: str) -> bool:
        """Return whether there is such a node."""
        return node in self.capacities or node in self.boundaries

    def join(self, into: dict[tuple[str, str], float], first: str, second: str, value: float) -> None:
        """Add a symmetric coupling to those that are there."""
        pair = (first, second) if (second, first) not in into else (second, first)
        self.parallel += pair in into
        into[pair] = into.get(pair, 0.0) + value

    def heat(self, cause: str, node: str, value_W: float) -> None:
        """Add a heat to those that are there."""
        own = self.heats_W.setdefault(cause, {})
        own[node] = own.get(node, 0.0) + value_W


def specified(
    deck: Deck, channels: Mapping[str, str], *, held: bool, source: str, by_submodel: bool = False
) -> Imported:
    """Return the specification of a deck.

    Parameters
    ----------
    deck
        What was read.
    channels
        Node -> the column of the telemetry that reads it; every node has one of its own where this is empty.
    held
        Take couplings and capacities as known; else couplings are guesses.
    source
        The deck's file, for messages.
    by_submodel
        Keep the couplings as they are, but for a factor, guessed as 1, of all conductors and one of all radiation between the
        nodes of two submodels, or within one: what stands before the dot of a node's name.
    """
    for node in channels:
        if node not in deck.capacities:
            raise SpecError(f"{source}: has no node '{node}' that a sensor could read")
    read = channels or {node: f"T_{node}" for node, capacity in deck.capacities.items() if capacity > 0.0}
    driven = {name: nodes for name, nodes in deck.driven.items() if nodes}
    derived, loads = _loads(deck)
    document: Json = {
        "twin": deck.name,
        "boundaries": {name: {"value_K": number(value)} for name, value in deck.boundaries.items()},
        "channels": {column: {"kind": "temperature", "unit": "degC"} for column in read.values()}
        | {name: {"kind": "power", "unit": "W", "interpolation": "linear"} for name in driven},
        "derived": derived,
        "nodes": [
            {"id": node, "capacity_J_per_K": {"value": number(capacity)}}
            | ({"sensor": read[node]} if node in read else {})
            for node, capacity in deck.capacities.items()
        ],
        **_couplings(deck, held, by_submodel),
        "loads": loads
        + [
            {"channel": name, "node": node, "gain": {"value": number(gain)}}
            for name, nodes in driven.items()
            for node, gain in nodes.items()
            if node in deck.capacities
        ],
    }
    courses = {name: deck.courses[name] for name in driven}
    notes = (*deck.notes, *_told(deck, not channels, list(driven), source))
    return Imported({k: v for k, v in document.items() if v}, notes, tuple(deck.refused), dict(deck.start_K), courses)


def _couplings(deck: Deck, held: bool, by_submodel: bool) -> Json:
    """Return the document's conductors and radiation, and the parameters that scale them."""
    key, outer = "value" if held else "guess", set(deck.boundaries)
    factors: dict[str, Json] = {}

    def size(pair: tuple[str, str], kind: str, value: float) -> Json:
        if not by_submodel:
            return {key: number(value)}
        factor = "_".join((kind, *sorted({node.split(".")[0] for node in pair})))
        factors[factor] = {"guess": 1.0}
        return {"value": number(value), "scale": factor}

    def rows(table: Mapping[tuple[str, str], float], kind: str, what: str) -> list[Json]:
        return [
            {"between": list(pair), what: size(pair, kind, value)}
            for pair, value in table.items()
            if value >= SMALLEST and not set(pair) <= outer
        ]

    one_way = rows(deck.one_way, "GL", "conductance_W_per_K")
    return {
        "conductors": rows(deck.linear, "GL", "conductance_W_per_K")
        + [{**row, "into": row["between"][1]} for row in one_way],
        "radiation": rows(deck.radiative, "GR", "area_m2"),
        "parameters": factors,
    }


def _told(deck: Deck, unread: bool, driven: Sequence[str], source: str) -> list[str]:
    """Return what to say of channels that were made up, and of couplings that were added up or left out."""
    notes = []
    if unread:
        notes.append(f"{source}: every node got a channel 'T_<node>'; name those that telemetry reads with --channel")
    if deck.parallel:
        lie = counted(deck.parallel, "coupling is parallel to another", "couplings are parallel to others")
        notes.append(f"{source}: {lie}; parallel ones were added up")
    dropped = [f"{a} - {b}" for c in (deck.linear, deck.radiative) for (a, b), v in c.items() if 0.0 <= v < SMALLEST]
    if dropped:
        small = counted(len(dropped), "coupling is", "couplings are")
        more = ", ..." if len(dropped) > 1 else ""
        notes.append(f"{source}: {small} below {SMALLEST:g} and left out ({dropped[0]}{more})")
    if driven:
        vary = counted(len(driven), "heat load varies", "heat loads vary")
        more = ", ..." if len(driven) > 1 else ""
        notes.append(f"{source}: {vary} with time; telemetry must carry a channel for each ({driven[0]}{more})")
    return notes


def _loads(deck: Deck) -> tuple[Json, list[Json]]:
    """Return one derived channel of 1 W, or -1 W, for each cause, and the loads that are multiples of it."""
    derived: Json = {}
    loads: list[Json] = []
    for cause, heats in deck.heats_W.items():
        for sign, suffix in ((1.0, ""), (-1.0, "_cooling")):
            found = {node: abs(q) for node, q in heats.items() if sign * q >= SMALLEST and node in deck.capacities}
            if found:
                derived[cause + suffix] = {"formula": repr(sign), "unit": "W"}
            loads += [
                {"channel": cause + suffix, "node": node, "gain": {"value": number(q)}} for node, q in found.items()
            ]
    return derived, loads


def kelvin(celsius: float) -> float:
    """Return a temperature in K; what lies a little below absolute zero, as decks write deep space, is 0."""
    return max(celsius + ZERO_CELSIUS_K, 0.0)
