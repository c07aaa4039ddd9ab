"""The contract that every registered effect keeps: a new one joins by its line in the registry."""

import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.helpers import active_effect, every_term_network, null_effects, points, survey_of
from twin_core.effects import REGISTRY, Effect, effect_from_json, effect_to_json
from twin_core.effects.base import ParameterSpec, Survey
from twin_core.network.dynamics import evaluate_balance
from twin_core.network.model import Layout, Network
from twin_core.network.surroundings import surround
from twin_core.network.terms import Along

WHERE_KEYS = {"node", "nodes", "sink", "boundary", "channel", "sensor"}
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
N_STARTS = 8
"""Starting points that are put to the dear tests."""

DOCS = Path(__file__).parents[2] / "docs" / "effects.md"

each_effect = pytest.mark.parametrize("kind", REGISTRY.values(), ids=list(REGISTRY))


def some(starts: list[Effect]) -> list[Effect]:
    """Return starting points evenly spread over all of them, which differ in settings alone."""
    return starts[:: 1 + len(starts) // N_STARTS]


def layout_with(effect: Effect) -> Layout:
    return every_term_network([effect]).layout


def adds_a_reading(effect: Effect) -> bool:
    """Whether the effect adds a state that a sensor reads instead of its node."""
    return any(node.reads is not None for node in effect.extra_nodes(every_term_network().layout))


def lags_a_boundary(effect: Effect) -> bool:
    """Whether the effect adds a state that stands for a boundary; see tests/twin_core/effects/test_boundaries.py."""
    return any(node.follows is not None for node in effect.extra_nodes(every_term_network().layout))


def stores_heat(effect: Effect) -> bool:
    """Whether the effect adds a mass: the unit capacity of a mere state, such as a relay's, is held."""
    return any(not node.capacity.frozen for node in effect.extra_nodes(every_term_network().layout))


def smooth_points(network: Network, n_points: int) -> Along:
    """Return points whose temperatures swing slowly, as those of a survey do."""
    along = points(network, n_points)
    phase = along.time_s[:, None] / 900.0 + np.arange(len(network.nodes))
    return replace(along, temperatures_K=285.0 + 20.0 * np.sin(phase))


def sink_heat_W(network: Network, along: Along) -> np.ndarray:
    """Return what the declared network exchanges through changed boundaries beyond what it does through declared ones."""
    declared, n = every_term_network(), len(every_term_network().nodes)
    bare = replace(along, temperatures_K=along.temperatures_K[:, :n])
    changed = replace(bare, boundaries_K=surround(network, network.parameters.values, along).along.boundaries_K)
    heat = np.zeros_like(along.temperatures_K)
    for points_, sign in ((changed, 1.0), (bare, -1.0)):
        heat[:, :n] += sign * evaluate_balance(declared, declared.parameters.values, points_).heat_W
    return heat


def added_heat_W(effect: Effect, network: Network, along: Along, rate_K_per_s: np.ndarray) -> np.ndarray:
    """Return the heat that an effect brings into every state, extra capacity as heat that it swallows."""
    addition = effect.addition(network.layout)
    named = network.parameters.as_dict() | {p.name: p.value for p in effect.parameters()}
    heat = sink_heat_W(network, along) if addition.boundaries else np.zeros_like(along.temperatures_K)
    for term in addition.terms:
        part = term.evaluate(along, np.array([named[n] for n in (*(p.name for p in term.parameters), *term.borrows)]))
        heat[:, list(part.nodes)] += part.heat_W
    for capacity in addition.capacities:
        names = (*(p.name for p in capacity.parameters), *capacity.borrows)
        more = capacity.evaluate(along.temperatures_K[:, capacity.node], np.array([named[n] for n in names]))
        heat[:, more.node] -= more.extra_J_per_K * rate_K_per_s[:, more.node]
    return heat


def with_own_states(effect: Effect, network: Network, along: Along) -> Along:
    """Return the points with the states that the effect adds integrated by SciPy along the declared ones."""
    n = len(every_term_network().nodes)
    if len(network.nodes) == n:
        return along
    capacity = network.parameters.values[network.capacity_index][n:]
    own = [network.nodes.index(node.like) for node in network.extra]

    def rates(t: float, x: np.ndarray) -> np.ndarray:
        states = np.append([np.interp(t, along.time_s, column) for column in along.temperatures_K.T[:n]], x)
        moment = Along(np.array([t]), states[None], along.boundaries_K[:1], {}, np.ones(1))
        return added_heat_W(effect, network, moment, np.zeros_like(moment.temperatures_K))[0, n:] / capacity

    found = [along.temperatures_K[0, own]]
    for span in pairwise(along.time_s.tolist()):  # no step over a kink of the straight lines between the points
        found.append(solve_ivp(rates, span, found[-1], method="LSODA", rtol=1e-10, atol=1e-10).y[:, -1])
    return replace(along, temperatures_K=np.hstack([along.temperatures_K[:, :n], np.array(found)]))


def declared_heat_W(effect: Effect, survey: Survey) -> np.ndarray:
    """Return the heat into the declared nodes along a survey, (n_points, n_nodes)."""
    network = every_term_network([effect])
    n = len(survey.layout.nodes)
    missing = len(network.nodes) - n
    along = replace(survey.along, temperatures_K=np.pad(survey.along.temperatures_K, ((0, 0), (0, missing))))
    rates = np.pad(survey.rate_K_per_s, ((0, 0), (0, missing)))
    return added_heat_W(effect, network, with_own_states(effect, network, along), rates)[:, :n]


@each_effect
def test_an_effect_adds_unknowns_and_takes_none_away(kind: type[Effect]) -> None:
    """What it does is asked with it and without it, at the same values of all else."""
    declared = set(every_term_network().parameters.free_names)
    for effect in some(null_effects(kind)):
        assert declared <= set(every_term_network([effect]).parameters.free_names)


@each_effect
def test_its_name_is_its_key_and_it_explains_itself(kind: type[Effect]) -> None:
    assert REGISTRY[kind.name] is kind
    assert re.fullmatch(r"[a-z]+(_[a-z]+)*", kind.name)
    assert set(kind.keys + kind.optional_keys) <= WHERE_KEYS and kind.keys
    assert not set(kind.keys) & set(kind.optional_keys)
    assert "=" in kind.equation
    assert len(kind.reference) > 10


@each_effect
def test_it_has_a_sentence_of_its_own_that_names_its_whole_place(kind: type[Effect]) -> None:
    assert kind.sentence == kind.sentence.strip().rstrip(".") and kind.sentence[0] == kind.sentence[0].lower()
    assert [other for other in REGISTRY.values() if other.sentence == kind.sentence] == [kind]
    for where in kind.places(every_term_network().layout):
        sentence = kind.told(where)
        for key in kind.keys:
            for name in [where[key]] if isinstance(where[key], str) else where[key]:
                assert re.search(rf"\b{re.escape(name)}\b", sentence), sentence


@each_effect
def test_its_parameters_have_units_that_fit_their_names(kind: type[Effect]) -> None:
    effect = active_effect(kind)
    parameter_specs: tuple[ParameterSpec, ...] = effect.parameter_specs()
    assert len({q.name for q in parameter_specs}) == len(parameter_specs) == len(effect.parameters())
    assert effect.amplitudes, "nothing scales the effect"
    for spec in parameter_specs:
        base = spec.name.partition("[")[0]
        suffix = next((end for end in UNITS if base.endswith(end)), None)
        if suffix is not None:
            assert spec.unit == UNITS[suffix], spec.name
    for parameter in effect.parameters():
        assert parameter.name.startswith(f"{effect.label}.")
        assert np.isfinite(parameter.value)


@each_effect
def test_every_place_can_be_built_and_has_the_declared_keys(kind: type[Effect]) -> None:
    layout = every_term_network().layout
    survey = survey_of(every_term_network(), points(every_term_network(), 60))
    places = list(kind.places(layout))
    assert places
    keys = set()
    for where in places:
        assert tuple(where) in {kind.keys, kind.keys + kind.optional_keys}
        for effect in list(kind.starts(where, survey))[:1]:
            assert layout_with(effect) is not None
            keys.add(effect.place)
    starts = [next(iter(kind.starts(where, survey)), None) for where in places]
    assert len(keys) == sum(s is not None for s in starts), "two places are one"


@each_effect
def test_it_starts_at_null(kind: type[Effect]) -> None:
    for effect in null_effects(kind):
        parameter_specs = effect.parameter_specs()
        for i in effect.amplitudes:
            assert effect.values[parameter_specs[i].name] == parameter_specs[i].null


@each_effect
def test_null_is_exactly_nothing(kind: type[Effect]) -> None:
    network = every_term_network()
    for effect in some(null_effects(kind)):
        if adds_a_reading(effect) or lags_a_boundary(effect):
            continue  # no lag is a state that moves at once: see the test of a lag that vanishes
        heat = declared_heat_W(effect, survey_of(network, smooth_points(network, 20)))
        np.testing.assert_array_equal(heat, 0.0)
        for term in effect.addition(layout_with(effect)).readings:
            values = np.array([effect.values[q.name] for q in effect.parameter_specs()])
            np.testing.assert_array_equal(term.evaluate(np.arange(5.0), values).offset_K, 0.0)


@each_effect
def test_what_it_adds_to_readings_leaves_the_nodes_alone(kind: type[Effect]) -> None:
    effect = active_effect(kind)
    if adds_a_reading(effect):
        network = every_term_network()
        survey = survey_of(network, smooth_points(network, 20))
        np.testing.assert_array_equal(declared_heat_W(effect, survey), 0.0)


@each_effect
@pytest.mark.parametrize("n_points", [1, 7])
def test_shapes_and_precision(kind: type[Effect], n_points: int) -> None:
    effect = active_effect(kind)
    network = every_term_network([effect])
    along = points(network, n_points, 3)
    addition, named = effect.addition(network.layout), network.parameters.as_dict()
    for term in addition.terms:
        names = (*(p.name for p in term.parameters), *term.borrows)
        part = term.evaluate(along, np.array([named[n] for n in names]))
        local = len(part.nodes)
        assert part.heat_W.shape == (n_points, local)
        assert part.heat_W.dtype == part.d_temperature.dtype == np.float64
        assert part.d_temperature.shape[0] in (1, n_points)
        assert part.d_temperature.shape[1:] == (local, local)
        assert {e.item for e in part.d_values} == set(range(len(names)))
        for entry in (*part.d_values, *part.d_boundaries):
            assert entry.series.shape == (n_points,)
            assert entry.series.dtype == np.float64
            assert np.isfinite(entry.series).all()
        assert {e.node for e in part.d_values} <= set(part.nodes)
    for capacity in addition.capacities:
        names = (*(p.name for p in capacity.parameters), *capacity.borrows)
        more = capacity.evaluate(along.temperatures_K[:, capacity.node], np.array([named[n] for n in names]))
        assert more.extra_J_per_K.shape == (n_points,)
        assert more.extra_J_per_K.dtype == np.float64


@each_effect
def test_unit_heats_are_the_slope_of_the_added_heat(kind: type[Effect]) -> None:
    """The added heat at small amplitudes, own states integrated by SciPy, against what the screening is told."""
    network = every_term_network()
    survey = survey_of(network, smooth_points(network, 40))
    where = next(w for w in kind.places(network.layout) if list(kind.starts(w, survey)))
    for effect in some(list(kind.starts(where, survey))):
        if lags_a_boundary(effect):
            continue  # its response is that at the assumed lag, not at none
        columns = effect.unit_heats(survey)
        assert len(columns) == len(effect.amplitudes)
        if adds_a_reading(effect):
            assert all(not column for column in columns)
            continue
        for k, column in enumerate(columns):
            found = np.zeros_like(survey.along.temperatures_K)
            for node, series in column:
                found[:, node] += series
            expected = slope_at_null(effect, survey, k)
            scale = float(np.abs(expected).max())
            np.testing.assert_allclose(found, expected, atol=1e-4 * scale, err_msg=f"{effect.label} {effect.settings}")


def slope_at_null(effect: Effect, survey: Survey, amplitude: int, step: float = 1e-3) -> np.ndarray:
    """Return d heat / d amplitude at null by one-sided differences of second order: some amplitudes are positive.

    Some cannot move alone either: the slope is that along all of them with this one twice, less that along all.
    """

    def slope(direction: np.ndarray) -> np.ndarray:
        def heat(amount: float) -> np.ndarray:
            moved = effect.with_amplitudes(amount * direction) if amount else effect
            assert moved is not None
            return declared_heat_W(moved, survey)

        return (4.0 * heat(step) - heat(2.0 * step) - 3.0 * heat(0.0)) / (2.0 * step)

    together, alone = np.ones(len(effect.amplitudes)), np.eye(len(effect.amplitudes))[amplitude]
    return slope(together + alone) - slope(together)


@each_effect
def test_an_exchange_between_states_sums_to_zero(kind: type[Effect]) -> None:
    effect = active_effect(kind)
    if not ("nodes" in kind.keys or stores_heat(effect)):
        return
    network = every_term_network([effect])
    along = points(network, 9, 4)
    heat = added_heat_W(effect, network, along, np.zeros_like(along.temperatures_K))
    assert np.abs(heat).max() > 0.0
    np.testing.assert_allclose(heat.sum(axis=1), 0.0, atol=1e-12 * np.abs(heat).max())


@each_effect
def test_json_there_and_back_is_exact(kind: type[Effect]) -> None:
    for effect in (*null_effects(kind), active_effect(kind, 1.0 / 3.0)):
        data = json.loads(json.dumps(effect_to_json(effect), allow_nan=False))
        again = effect_from_json(data)
        assert again == effect
        assert again.label == effect.label
        assert again.place == effect.place
        assert effect_to_json(again) == data


@each_effect
def test_its_label_names_it_and_its_place(kind: type[Effect]) -> None:
    effect = active_effect(kind)
    assert effect.label.startswith(f"{kind.name}(") and effect.label.endswith(")")
    for value in effect.where.values():
        for name in (value,) if isinstance(value, str) else value:
            assert name in effect.label
    moved = effect.at_parameters({p.name: 2.0 * p.value for p in effect.parameters()})
    assert all(moved.values[q.name] == 2.0 * effect.values[q.name] for q in effect.parameter_specs())
    assert moved.place == effect.place


@each_effect
def test_a_law_has_no_limits_and_what_was_learned_knows_its_own(kind: type[Effect]) -> None:
    """Far from everything visited: a named effect is silent, the fallback says where it was at home and how unsure it is."""
    effect = active_effect(kind)
    network = every_term_network([effect])
    carried = effect.learned(np.eye(len(effect.parameter_specs())))
    assert (carried.values, carried.label) == (effect.values, effect.label)
    along = points(network, 9)
    far = carried.beyond(network.layout, replace(along, temperatures_K=along.temperatures_K + 1.0e3))
    assert (far is not None) == kind.fallback
    if far is not None:
        assert far.outside.all() and far.std_W.shape == (9,) and (far.std_W > 0.0).all()
        assert network.nodes[far.node] == effect.where["node"] and effect.where["node"] in far.visited


@each_effect
def test_a_pair_has_no_order(kind: type[Effect]) -> None:
    effect = active_effect(kind)
    if "nodes" in kind.keys:
        assert replace(effect, where={**effect.where, "nodes": effect.where["nodes"][::-1]}).place == effect.place


@each_effect
def test_amplitudes_that_are_not_physical_are_refused_or_put_on_their_bound(kind: type[Effect]) -> None:
    effect = null_effects(kind)[0]
    parameter_specs = [effect.parameter_specs()[i] for i in effect.amplitudes]
    far = effect.with_amplitudes(np.full(len(parameter_specs), -1.0e6))
    refused = any(q.positive and not q.null for q in parameter_specs)
    if far is None:
        assert refused or any(q.upper is not None for q in parameter_specs)
    else:
        assert not refused
        assert all(q.lower is None or far.values[q.name] == q.lower for q in parameter_specs)
        assert all(far.values[q.name] > 0.0 for q in parameter_specs if q.positive)


def rows() -> dict[str, str]:
    """Return the table rows of the documentation by effect."""
    lines = DOCS.read_text(encoding="utf-8").splitlines()
    found = [re.match(r"\| `(\w+)` \|", line) for line in lines]
    return {match[1]: line for match, line in zip(found, lines, strict=True) if match}


@each_effect
def test_its_parameters_are_documented(kind: type[Effect]) -> None:
    assert kind.name in rows(), f"{kind.name} has no row in docs/effects.md"
    row = rows()[kind.name]
    effect = active_effect(kind)
    for name in {q.name.partition("[")[0] for q in effect.parameter_specs()} | set(kind.reported_settings):
        assert f"`{name}`" in row, f"the row of {kind.name} lacks the parameter {name}"
