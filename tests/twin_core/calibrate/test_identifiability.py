"""What the data cannot see, in words."""

import numpy as np
import pytest

from tests.helpers import conductive_spec, record_of
from twin_core.calibrate.identifiability import (
    blurred_levels,
    identified,
    nothing_is_heated,
    resting_channels,
    strong_correlations,
    unseen_nodes,
    unseen_parameters,
    weakest_direction,
    words,
)
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.parameters.parameter import Parameter, absolute_temperature, positive, real
from twin_core.parameters.transforms import Bounded, Shifted, Transform
from twin_core.parameters.vector import ParameterSet

SET = ParameterSet(
    (positive("C:a", "J/K", 1e4), positive("R", "m2", 1.0, frozen=True), positive("G", "W/K", 2.0), real("Q", "W", 5.0))
)


def test_a_factor_e_of_uncertainty_is_not_seen() -> None:
    assert unseen_parameters(SET, np.array([0.1, 0.2, 1.0])) == []
    assert unseen_parameters(SET, np.array([0.95, 0.2, 1.0])) == ["C:a"]  # its guess alone gives 1
    assert unseen_parameters(SET, np.array([1.1, 0.2, 1.0])) == ["C:a"]
    assert unseen_parameters(SET, np.array([0.1, np.nan, 6.0])) == ["G", "Q"]


def test_identified_is_a_third_of_the_value() -> None:
    """C and G by the standard deviation of their ln; Q, of 5 W, by its own."""
    assert identified(SET, np.array([0.3, 0.4, 1.6])) == {"C:a": True, "G": False, "Q": True}
    assert identified(SET, np.array([0.34, 0.1, 1.7])) == {"C:a": False, "G": True, "Q": False}


def test_a_ratio_that_alone_is_told_is_said() -> None:
    """C and G are each uncertain by a factor, their ratio is not: the weak direction is both as one."""
    spread, tight = 0.5**2, 1e-4
    covariance = np.diag([tight, tight, 1.0])
    covariance[:2, :2] += spread * np.ones((2, 2))
    said = weakest_direction(SET, covariance)
    assert said is not None and "C:a" in said and "G" in said and "Q" not in said
    assert weakest_direction(SET, 1e-4 * np.eye(3)) is None
    assert weakest_direction(SET, np.diag([4.0, 1e-4, 1e-4])) is None  # one alone is no combination


def test_parameters_that_nothing_tells_are_not_told_together() -> None:
    """Where the variances are those of two guesses, rounding alone mixes their directions."""
    covariance = np.diag([1.0, 1.0, 1.0])
    covariance[0, 1] = covariance[1, 0] = 1e-12
    assert weakest_direction(SET, covariance) is None
    assert not any("together" in line for line in words(SET, covariance))


def test_words_are_silent_where_all_is_seen() -> None:
    assert words(SET, 1e-4 * np.eye(3)) == []
    assert any("C:a" in line for line in words(SET, np.diag([4.0, 1e-4, 1e-4])))


def test_nothing_free_is_nothing_to_say() -> None:
    assert words(ParameterSet(()), np.zeros((0, 0))) == []


def test_the_strongest_correlations_come_first() -> None:
    """Against the cosines of the vectors that the covariance is made of."""
    c, g, q = np.array([1.0, 0.0, 0.02]), np.array([1.0, 0.02, 0.0]), np.array([-0.95, -0.3, 0.5])
    rows = np.stack([c, g, q])
    covariance = rows @ rows.T
    found = strong_correlations(SET, covariance, least=0.8)
    sizes = np.linalg.norm(rows, axis=1)
    expected = {
        ("C:a", "G"): c @ g / (sizes[0] * sizes[1]),
        ("G", "Q"): g @ q / (sizes[1] * sizes[2]),
        ("C:a", "Q"): c @ q / (sizes[0] * sizes[2]),
    }
    assert [tuple(row["parameters"]) for row in found] == sorted(expected, key=lambda pair: -abs(expected[pair]))
    for row in found:
        assert abs(row["correlation"] - expected[tuple(row["parameters"])]) < 1e-12
    assert strong_correlations(SET, covariance, least=0.99) == found[:1]
    assert strong_correlations(SET, np.eye(3)) == []


def test_a_node_that_no_chain_ties_to_a_sensor_is_said() -> None:
    data = conductive_spec(3, [(0, 1), (1, 2)])
    del data["nodes"][2]["sensor"], data["nodes"][1]["sensor"], data["channels"]["T1"], data["channels"]["T2"]
    assert unseen_nodes(load_spec(data)) == []  # a chain: both are seen through the first
    del data["conductors"][1]
    (said,) = unseen_nodes(load_spec(data))
    assert "no sensor sees node 'n2'" in said
    assert unseen_nodes(load_spec(data), [("n2", "n0")]) == []


def test_channels_at_rest_are_said() -> None:
    spec = load_spec(conductive_spec(2, [(0, 1)]))
    time_s = 60.0 * np.arange(20)
    record = record_of(time_s, T0=290.0, T1=290.0 + np.sin(time_s))
    (said,) = resting_channels(spec, [record])
    assert said.startswith("channel 'T0' never changes") and "stuck" in said
    assert resting_channels(spec, [record, record_of(time_s, T0=291.0, T1=290.0)]) == []


@pytest.mark.parametrize(
    ("powers_W", "said"),
    [
        ({"P0": [0.0, 0.0], "P1": [0.0, 0.0]}, "all power channels (P0, P1) are zero throughout"),
        ({"P0": [0.0, np.nan], "P1": [np.nan, 0.0]}, "all power channels (P0, P1) are zero throughout"),
        ({"P0": [0.0, 0.0], "P1": [0.0, 1.0]}, ""),
        ({"P0": [0.0, 0.0]}, ""),
    ],
    ids=["zero", "zero where it was read", "one heats", "one comes from elsewhere"],
)
def test_powers_that_are_all_zero_are_said(powers_W: dict[str, list[float]], said: str) -> None:
    data = conductive_spec(2, [(0, 1)])
    data["channels"] |= {name: {"kind": "power", "unit": "W"} for name in ("P0", "P1")}
    data["loads"] = [{"channel": name, "node": node} for name, node in (("P0", "n0"), ("P1", "n1"))]
    record = record_of(np.array([0.0, 60.0]), **{name: np.array(column) for name, column in powers_W.items()})
    told = nothing_is_heated(load_spec(data), [record])
    assert len(told) == bool(said) and all(line.startswith(said) for line in told)
    assert nothing_is_heated(load_spec(conductive_spec(2, [(0, 1)])), [record]) == []
    assert resting_channels(load_spec(data), [record])[: len(told)] == told
    data["channels"]["P1"] = {"kind": "auxiliary"}  # an angle, say: at zero its table may hold any heat
    data["loads"][1]["table"] = {"knots": [-1.0, 0.0, 1.0]}
    assert nothing_is_heated(load_spec(data), [record]) == []


BOUNDED = positive("C:b", "J/K", 100.0, bounds=(50.0, 200.0))


@pytest.mark.parametrize(
    ("value", "std", "said"),
    [
        (199.9, 0.1, ["C:b ends at its bound of 200 J/K; the data pull above it: widen it if it is not known"]),
        (50.1, 5.0, ["C:b ends at its bound of 50 J/K; the data pull below it: widen it if it is not known"]),
        (150.0, 0.1, []),
        (100.0, 5.0, ["the data do not determine C:b; it stays near its guess"]),
    ],
)
def test_a_bound_that_the_data_pull_beyond_is_told(value: float, std: float, said: list[str]) -> None:
    """The guess is the middle of the interval in ln: 1 % from an end is 6 standard deviations of its prior away, two thirds 1."""
    assert words(ParameterSet((BOUNDED.at(value),)), np.array([[std**2]]), {"C:b": 100.0}) == said


def test_bounds_that_leave_no_room_hold_what_the_data_do_not_tell() -> None:
    tight = positive("C:b", "J/K", 100.0, bounds=(90.0, 110.0))
    said = words(ParameterSet((tight,)), np.array([[25.0]]), {"C:b": 100.0})
    assert said == [
        "the data do not determine C:b; its bounds of 90 to 110 J/K hold it: widen them if they are not known"
    ]


def test_a_guess_near_its_bound_is_not_pulled_there() -> None:
    near = positive("C:b", "J/K", 198.0, bounds=(50.0, 200.0))
    assert words(ParameterSet((near,)), np.array([[0.01]]), {"C:b": 198.0}) == []


@pytest.mark.parametrize("value_K", [0.0, 3.0, 250.0, 367.5])
@pytest.mark.parametrize(
    ("std_K", "told", "unseen"), [(5.0, True, False), (20.0, False, False), (46.0, False, True), (87.8, False, True)]
)
def test_a_temperature_is_told_where_its_prior_is_narrowed_down(
    value_K: float, std_K: float, told: bool, unseen: bool
) -> None:
    """Of a prior of 50 K, a third is 17 K and nine tenths are 45 K, wherever on the scale the temperature lies."""
    sink = ParameterSet((absolute_temperature("T:sink", value_K, prior_std_K=50.0),))
    assert identified(sink, np.array([std_K])) == {"T:sink": told}
    assert unseen_parameters(sink, np.array([std_K])) == ["T:sink"] * unseen


@pytest.mark.parametrize(
    ("transform", "value", "prior_std", "size"),
    [
        (Shifted(1.7e9, 600.0), 1.70001e9, 20.0, 1.0),  # an instant in Unix seconds, looked for every 600 s
        (Shifted(0.0, 1.0), 293.0, 10.0, 1.0),  # a switching point
        (Bounded(250.0, 320.0), 273.0, 20.0, 20.0),  # a melting point within what was visited
        (Bounded(270.0, 280.0), 273.0, 20.0, 10.0),
        (Bounded(0.0, 1.0), 0.0, None, 1.0),  # a share, which may be nothing
        (Bounded(-250.0), -6.0, 50.0, 6.0),  # a bias, whose zero is no bias
        (Bounded(-0.01, 0.02), 0.005, None, 0.005),  # a slope
        (Bounded(0.0), 0.5, None, 0.5),  # a factor
    ],
)
def test_what_has_no_natural_zero_is_measured_by_its_prior_or_interval(
    transform: Transform, value: float, prior_std: float | None, size: float
) -> None:
    only = ParameterSet((Parameter("x", "", value, transform, prior_std),))
    for share, told, unseen in ((0.3, True, False), (0.4, False, False), (1.01, False, True)):
        assert identified(only, np.array([share * size])) == {"x": told}
        assert unseen_parameters(only, np.array([share * size])) == ["x"] * unseen


@pytest.mark.parametrize(("std", "said"), [(3.0, "by a factor 69.6 as one"), (25.0, "by any factor as one")])
def test_a_direction_that_nothing_holds_has_no_factor(std: float, said: str) -> None:
    """The sum of both logarithms has 3 standard deviations of one along its direction: e^(3 sqrt 2)."""
    together = std**2 * np.array([[1.0, 1.0], [1.0, 1.0]]) + 1e-6 * np.eye(2)
    both = ParameterSet((SET.parameters[0], SET.parameters[2]))
    told = weakest_direction(both, together)
    assert told is not None and told.endswith(said)


@pytest.mark.parametrize(
    ("mode", "told"),
    [
        (np.linspace(0.0, 10.0, 101), True),  # continuous: only what lies at an end is at a level
        (np.repeat([0.0, 10.0], 50), False),
        (np.concatenate([np.repeat([0.0, 10.0], 50), [2.0, 5.0, 8.0]]), False),  # a slew
    ],
)
def test_a_continuous_channel_has_no_levels(mode: np.ndarray, told: bool) -> None:
    data = conductive_spec(1, [], channels={"mode": {"kind": "auxiliary", "levels": True}})
    data["loads"] = [{"channel": "mode", "node": "n0", "table": {}}]
    network = build_network(load_spec(data), table_knots={("mode", "n0"): (0.0, 10.0)})
    said = blurred_levels(network, [record_of(np.arange(float(mode.size)), mode=mode)])
    assert [line.startswith("channel 'mode' is declared with levels, but 94% of its samples") for line in said] == [
        True
    ] * told
