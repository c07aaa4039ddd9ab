"""From a specification to a network: which parameters there are, which are held, and what is refused."""

import copy

import numpy as np
import pytest

from tests.helpers import EVERY_TERM, EVERY_TERM_KNOTS, every_term_network
from twin_core.effects import REGISTRY
from twin_core.errors import ModelError
from twin_core.network.calibrated import with_values
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.parameters.parameter import GUESS_LOG_STD, NO_GUESS_LOG_STD
from twin_core.parameters.transforms import is_logarithmic


def test_known_values_are_held_and_the_rest_is_free() -> None:
    network = every_term_network()
    held = {p.name for p in network.parameters.parameters if p.frozen}
    assert held == {"C:c", "G:sink|b", "R:a|space", "R:c|sink", "gain:Q_a|a", "gain:Q_a|c", "gain:Q_sun|b"}
    free = {"C:a", "C:b", "G:a|b", "G:b|c", "G:c|room", "T:sink", "gain:H|c"}
    tables = {f"table:pitch|a[{k}]" for k in (45, 90, 135)} | {f"table:mode|b[{k}]" for k in (0, 1, 2)}
    assert set(network.parameters.free_names) == free | tables


def test_declared_numbers_arrive() -> None:
    values = every_term_network().parameters.as_dict()
    assert values["C:b"] == 5.0e3
    assert values["G:c|room"] == 0.7
    assert values["R:a|space"] == pytest.approx(0.8 * 0.3)
    assert values["T:sink"] == 255.0
    assert values["gain:Q_a|a"] == 1.0  # watts are delivered as declared; the weight is the load's own


def test_what_nobody_guessed_has_a_wide_prior() -> None:
    data = copy.deepcopy(EVERY_TERM)
    del data["conductors"][0]["conductance_W_per_K"]
    network = build_network(load_spec(data), table_knots=EVERY_TERM_KNOTS)
    by_name = {p.name: p for p in network.parameters.parameters}
    assert by_name["G:a|b"].guessed and by_name["G:a|b"].prior_std == NO_GUESS_LOG_STD
    assert not by_name["C:a"].guessed and by_name["C:a"].prior_std == GUESS_LOG_STD


def test_defaults_start_only_what_nobody_guessed() -> None:
    data = copy.deepcopy(EVERY_TERM)
    del data["conductors"][0]["conductance_W_per_K"]
    network = build_network(load_spec(data), table_knots=EVERY_TERM_KNOTS, defaults={"G:a|b": 9.0, "C:a": 9.0})
    assert network.parameters.as_dict()["G:a|b"] == 9.0
    assert network.parameters.as_dict()["C:a"] == 8.0e3


@pytest.mark.parametrize("free", [-90.0, 90.0])
def test_whatever_is_calibrated_can_be_declared(free: float) -> None:
    data = copy.deepcopy(EVERY_TERM)
    del data["conductors"][0]["conductance_W_per_K"], data["nodes"][0]["capacity_J_per_K"]
    spec = load_spec(data)
    parameters = build_network(spec, table_knots=EVERY_TERM_KNOTS).parameters
    positive = {p.name: p.transform.to_value(free) for p in parameters.parameters if is_logarithmic(p.transform)}
    assert {"C:a", "G:a|b", "G:b|c", "gain:H|c"} <= positive.keys()
    values = parameters.updated(positive).as_dict()
    declared = load_spec(with_values(spec, values))
    assert declared.nodes[0].capacity_J_per_K is not None
    assert declared.nodes[0].capacity_J_per_K.value == values["C:a"]


def test_sensors_read_their_nodes() -> None:
    data = copy.deepcopy(EVERY_TERM)
    data["channels"]["T_c2"] = {"kind": "temperature", "unit": "K"}
    data["nodes"][1]["sensor"] = ["T_b", "T_c2"]
    network = build_network(load_spec(data), table_knots=EVERY_TERM_KNOTS)
    np.testing.assert_array_equal(network.sensor_node, [0, 1, 1])
    assert network.layout.sensor_node("T_c2") == "b"


def test_a_table_without_levels_is_refused() -> None:
    with pytest.raises(ModelError, match=r"load 'mode' on 'b': the levels"):
        build_network(load_spec(EVERY_TERM))


@pytest.mark.parametrize(
    ("name", "where", "values", "message"),
    [
        ("constant_heat_load", {"node": "x"}, {"Q_W": 1.0}, "unknown node 'x'"),
        ("leak_to_boundary", {"node": "a", "boundary": "x"}, {"G_W_per_K": 1.0}, "unknown boundary 'x'"),
        ("radiation_to_sink", {"node": "a", "sink": "x"}, {"R_m2": 1.0}, "unknown boundary 'x'"),
        ("missing_conductor", {"nodes": ["a", "x"]}, {"G_W_per_K": 1.0}, "unknown node 'x'"),
        ("input_gain", {"channel": "T_a"}, {"g": 1.0}, "channel 'T_a' drives no declared load"),
    ],
)
def test_an_effect_at_a_place_that_does_not_exist_is_refused(
    name: str, where: dict, values: dict, message: str
) -> None:
    with pytest.raises(ModelError, match=message):
        every_term_network([REGISTRY[name](where, values)])


def test_an_effect_twice_at_one_place_is_one_term_too_many() -> None:
    effect = REGISTRY["constant_heat_load"]({"node": "a"}, {"Q_W": 1.0})
    one, two = every_term_network([effect]), every_term_network([effect, effect])
    assert len(two.terms) == len(one.terms) + 1
    assert two.parameters.index == one.parameters.index


def test_with_values_changes_numbers_alone() -> None:
    network = every_term_network()
    doubled = network.with_values(2.0 * network.parameters.values)
    np.testing.assert_array_equal(doubled.parameters.values, 2.0 * network.parameters.values)
    assert doubled.nodes == network.nodes
    assert doubled.parameters.free_names == network.parameters.free_names
