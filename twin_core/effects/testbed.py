"""A small network with every kind of term, and points in it: where the derivatives of effects are put to the test."""

from collections.abc import Mapping, Sequence

import numpy as np

from twin_core._typing import Json
from twin_core.effects.base import Effect, Survey
from twin_core.errors import ModelError
from twin_core.network.dynamics import evaluate_balance
from twin_core.network.model import Network, build_network
from twin_core.network.spec_io import load_spec
from twin_core.network.terms import Along

EVERY_TERM: Json = {
    "twin": "every-term",
    "boundaries": {
        "space": {"value_K": 3.0},
        "room": {"channel": "T_room"},
        "sink": {"guess_K": 255.0},
    },
    "channels": {
        "T_a": {"kind": "temperature", "unit": "K"},
        "T_b": {"kind": "temperature", "unit": "degC"},
        "T_room": {"kind": "temperature", "unit": "K"},
        "Q_a": {"kind": "power", "unit": "W"},
        "Q_sun": {"kind": "power", "unit": "W"},
        "H": {"kind": "power", "unit": "percent"},
        "pitch": {"kind": "auxiliary", "unit": "deg"},
        "mode": {"kind": "auxiliary", "levels": True},
    },
    "nodes": [
        {"id": "a", "sensor": "T_a", "capacity_J_per_K": {"guess": 8.0e3}},
        {"id": "b", "sensor": "T_b", "capacity_J_per_K": {"guess": 5.0e3, "bounds": [1.0e3, 3.0e4]}},
        {"id": "c", "capacity_J_per_K": {"value": 1.2e4}},
    ],
    "conductors": [
        {"between": ["a", "b"], "conductance_W_per_K": {"guess": 3.0}},
        {"between": ["b", "c"], "conductance_W_per_K": {"guess": 1.5, "bounds": [0.1, 20.0]}},
        {"between": ["c", "room"], "conductance_W_per_K": {"guess": 0.7}},
        {"between": ["sink", "b"], "conductance_W_per_K": {"value": 0.4}},
    ],
    "radiators": [
        {"node": "a", "emissivity": 0.8, "area_m2": 0.3, "sink": "space"},
        {"node": "c", "emissivity": 0.5, "area_m2": 0.2, "sink": "sink"},
    ],
    "loads": [
        {"channel": "Q_a", "node": "a", "weight": 0.6},
        {"channel": "Q_a", "node": "c", "weight": 0.4},
        {"channel": "Q_sun", "node": "b", "solar": True},
        {"channel": "H", "node": "c", "gain": {"guess": 0.4}},
        {"channel": "pitch", "node": "a", "solar": True, "table": {"knots": [45.0, 90.0, 135.0]}},
        {"channel": "mode", "node": "b", "table": {}},
    ],
}
"""A network with every kind of boundary, conductor, radiator and load."""

LEVELS = (0.0, 1.0, 2.0)
"""The states of its channel ``mode``."""

EVERY_TERM_KNOTS = {("mode", "b"): LEVELS}


def every_term_network(effects: Sequence[Effect] = ()) -> Network:
    """Return the network with every term; the values of its tables are not zero."""
    network = build_network(load_spec(EVERY_TERM), effects, table_knots=EVERY_TERM_KNOTS)
    tables = {p.name: 5.0 + 3.0 * i for i, p in enumerate(network.parameters.parameters) if p.name.startswith("table:")}
    return network.with_parameters(network.parameters.updated(tables))


def points(network: Network, n_points: int, seed: int = 0) -> Along:
    """Return points with temperatures, boundaries and inputs well apart, two minutes after each other."""
    rng = np.random.default_rng(seed)
    time_s = 120.0 * np.arange(n_points, dtype=np.float64)
    inputs = {
        "Q_a": rng.uniform(5.0, 60.0, n_points),
        "Q_sun": rng.uniform(0.0, 90.0, n_points),
        "H": rng.uniform(0.0, 100.0, n_points),
        "pitch": rng.uniform(30.0, 150.0, n_points),
        "mode": rng.integers(0, len(LEVELS), n_points).astype(np.float64),
    }
    temperatures = rng.uniform(260.0, 310.0, (n_points, len(network.nodes)))
    boundaries = rng.uniform(200.0, 300.0, (n_points, len(network.layout.boundaries)))
    return Along(time_s, temperatures, boundaries, inputs, rng.uniform(0.95, 1.05, n_points))


def survey_of(network: Network, along: Along, channel_levels: Mapping[str, tuple[float, ...]] | None = None) -> Survey:
    """Return the points as one segment that candidate effects see."""
    balance = evaluate_balance(network, network.parameters.values, along)
    levels = {"mode": LEVELS} if channel_levels is None else channel_levels
    capacity = network.parameters.values[network.capacity_index]
    named = network.parameters.as_dict()
    edges = (0, along.time_s.size)
    residual = np.random.default_rng(0).normal(size=(along.time_s.size, len(network.spec.sensors)))
    return Survey(
        network.layout, along, balance.rate_K_per_s, capacity, levels, edges, named, along.time_s, False, residual
    )


def null_effects(kind: type[Effect]) -> list[Effect]:
    """Return an effect at its first place in the network with every term, at each of its starting points.

    Raises
    ------
    ModelError
        If it has none there.
    """
    network = every_term_network()
    survey = survey_of(network, points(network, 60))
    for where in kind.places(network.layout):
        starts = list(kind.starts(where, survey))
        if starts:
            return list(starts)
    raise ModelError(f"effect {kind.name}: has no place, or no start there, in the network with every term")


def active_effect(kind: type[Effect], amount: float = 0.7) -> Effect:
    """Return an effect in the network with every term, its amplitudes moved from null by a positive amount.

    Where less than one unit lies between null and an upper bound, by that share of it: on a bound nothing has a slope.

    Raises
    ------
    ModelError
        If it has no place there, or cannot have that amplitude.
    """
    start = null_effects(kind)[0]
    parameter_specs = [start.parameter_specs()[i] for i in start.amplitudes]
    rooms = [
        1.0 if q.upper is None or q.null is None or q.upper <= q.null else min(q.upper - q.null, 1.0)
        for q in parameter_specs
    ]
    moved = start.with_amplitudes(amount * np.array(rooms))
    if moved is None:
        raise ModelError(f"effect {kind.name}: refuses amplitudes {amount:g} above null")
    return moved
