"""Effects that are a heat flow: the heat by hand, and where they may stand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.analytic import SIGMA
from tests.helpers import every_term_network, points, survey_of
from twin_core.effects import REGISTRY, Effect
from twin_core.effects.nonlinear_convection import STEEPEST
from twin_core.errors import ModelError
from twin_core.network.terms import Along

ALONG = Along(
    time_s=np.arange(3.0),
    temperatures_K=np.array([[300.0, 280.0, 290.0], [310.0, 285.0, 260.0], [270.0, 285.0, 260.0]]),
    boundaries_K=np.array([[3.0, 295.0, 255.0]] * 3),
    inputs={
        "Q_a": np.array([0.0, 25.0, 100.0]),
        "H": np.array([50.0, 0.0, 10.0]),
        "Q_sun": np.array([10.0, 20.0, 30.0]),
        "pitch": np.array([45.0, 100.0, 140.0]),
        "mode": np.array([0.0, 2.0, 1.0]),
    },
    sun_factor=np.array([1.0, 0.9, 1.1]),
)


def heat_W(effect: Effect) -> np.ndarray:
    """Return the heat of an effect into the nodes a, b, c at the three points."""
    network = every_term_network([effect])
    named = network.parameters.as_dict()
    found = np.zeros((3, 3))
    for term in effect.addition(network.layout).terms:
        part = term.evaluate(ALONG, np.array([named[n] for n in (*(p.name for p in term.parameters), *term.borrows)]))
        found[:, list(part.nodes)] += part.heat_W
    return found


def test_radiation_to_sink() -> None:
    found = heat_W(REGISTRY["radiation_to_sink"]({"node": "b", "sink": "room"}, {"R_m2": 0.25}))
    expected = SIGMA * 0.25 * (295.0**4 - ALONG.temperatures_K[:, 1] ** 4)
    np.testing.assert_allclose(found, np.outer(expected, [0.0, 1.0, 0.0]))


def test_missing_conductor() -> None:
    found = heat_W(REGISTRY["missing_conductor"]({"nodes": ["c", "a"]}, {"G_W_per_K": 2.0}))
    np.testing.assert_allclose(found, 2.0 * np.outer([10.0, 50.0, 10.0], [-1.0, 0.0, 1.0]))


def test_radiative_exchange() -> None:
    found = heat_W(REGISTRY["radiative_exchange"]({"nodes": ["c", "a"]}, {"R_m2": 0.2}))
    expected = SIGMA * 0.2 * (ALONG.temperatures_K[:, 2] ** 4 - ALONG.temperatures_K[:, 0] ** 4)
    np.testing.assert_allclose(found, np.outer(expected, [1.0, 0.0, -1.0]))


@pytest.mark.parametrize("p", [0.5, 1.0, 1.25, 2.0])
def test_nonlinear_convection(p: float) -> None:
    found = heat_W(REGISTRY["nonlinear_convection"]({"node": "c", "boundary": "room"}, {"k": 0.4, "p": p}))
    np.testing.assert_allclose(found[:, 2], 0.4 * np.array([5.0, 35.0, 35.0]) ** p, rtol=5e-6)
    np.testing.assert_array_equal(found[:, :2], 0.0)


def test_no_convection_is_steeper_than_any_known() -> None:
    """What switches, as a fan does, took an exponent of 63 on a measured inverter, and ran away on the hold-out."""
    found = REGISTRY["nonlinear_convection"]({"node": "c", "boundary": "room"}, {"k": 0.4, "p": 1.25})
    transform = {spec.name: spec.transform for spec in found.parameter_specs()}["p"]
    assert transform.highest == pytest.approx(math.log(STEEPEST))
    for p in (1.0, 1.33, 3.0):
        assert transform.to_value(transform.to_free(p)) == pytest.approx(p)


def test_nonlinear_convection_is_odd_and_its_slope_bounded() -> None:
    term = REGISTRY["nonlinear_convection"]({"node": "a", "boundary": "room"}, {"k": 0.4, "p": 0.5})
    (part,) = term.addition(every_term_network([term]).layout).terms
    difference = np.array([-20.0, -1e-9, 0.0, 1e-9, 20.0])
    along = Along(
        np.arange(5.0), 295.0 - np.outer(difference, np.ones(3)), np.full((5, 3), 295.0), ALONG.inputs, np.ones(5)
    )
    heat = part.evaluate(along, np.array([0.4, 0.5]))
    np.testing.assert_allclose(heat.heat_W, -heat.heat_W[::-1], atol=1e-12)
    assert heat.heat_W[2, 0] == 0.0 and np.isfinite(heat.d_temperature).all()
    assert all(np.isfinite(entry.series).all() for entry in (*heat.d_values, *heat.d_boundaries))


def test_leak_to_boundary() -> None:
    found = heat_W(REGISTRY["leak_to_boundary"]({"node": "c", "boundary": "room"}, {"G_W_per_K": 0.5}))
    np.testing.assert_allclose(found[:, 2], [2.5, 17.5, 17.5])


def test_constant_heat_load() -> None:
    found = heat_W(REGISTRY["constant_heat_load"]({"node": "a"}, {"Q_W": -3.0}))
    np.testing.assert_allclose(found, np.outer(np.full(3, -3.0), [1.0, 0.0, 0.0]))


def test_channel_heat_load_by_levels() -> None:
    values = {f"values_W[{i}]": v for i, v in enumerate((1.0, 5.0, 9.0))}
    settings = {"knots": (0.0, 1.0, 2.0), "levels": True}
    found = heat_W(REGISTRY["channel_heat_load"]({"node": "c", "channel": "mode"}, values, settings))
    np.testing.assert_allclose(found[:, 2], [1.0, 9.0, 5.0])


def test_channel_heat_load_by_knots() -> None:
    values = {f"values_W[{i}]": v for i, v in enumerate((0.0, 10.0, 4.0))}
    settings = {"knots": (60.0, 100.0, 120.0), "levels": False}
    found = heat_W(REGISTRY["channel_heat_load"]({"node": "c", "channel": "pitch"}, values, settings))
    np.testing.assert_allclose(found[:, 2], [0.0, 10.0, 4.0])  # held beyond the outer knots


def test_channel_heat_load_by_levels_over_another_channel() -> None:
    """Each state interpolates between its own knots, the one without any has no heat, and sunlight falls with distance."""
    mode, pitch = np.array([0.0, 1.0, 1.0, 2.0, 2.4, 1.0]), np.array([60.0, 75.0, 100.0, 80.0, 30.0, 170.0])
    sun = np.linspace(1.0, 1.05, 6)
    knots, states = (60.0, 90.0, 120.0, 45.0, 135.0), (1.0, 1.0, 1.0, 2.0, 2.0)
    settings = {"knots": knots, "states": states, "across": "pitch", "levels": (0.0, 1.0, 2.0), "solar": True}
    values = {f"values_W[{i}]": v for i, v in enumerate((2.0, 8.0, 5.0, -9.0, 9.0))}
    effect = REGISTRY["channel_heat_load"]({"node": "c", "channel": "mode"}, values, settings)
    (term,) = effect.addition(every_term_network([effect]).layout).terms
    along = Along(np.arange(6.0), np.full((6, 3), 290.0), np.full((6, 3), 280.0), {"mode": mode, "pitch": pitch}, sun)
    found = term.evaluate(along, np.array(list(values.values())))
    expected = np.array([0.0, 5.0, 7.0, -2.0, -9.0, 5.0]) * sun
    np.testing.assert_allclose(found.heat_W[:, 0], expected, atol=1e-12)


@pytest.mark.parametrize(("limit_W", "expected"), [(1e3, [0.0, 0.0, 60.0]), (45.0, [0.0, 0.0, 45.0])])
def test_proportional_heater(limit_W: float, expected: list[float]) -> None:
    values = {"k_W_per_K": 3.0, "T_set_K": 290.0, "Q_W": limit_W}
    np.testing.assert_allclose(heat_W(REGISTRY["proportional_heater"]({"node": "a"}, values))[:, 0], expected)


def test_input_gain_follows_every_load_of_its_channel() -> None:
    found = heat_W(REGISTRY["input_gain"]({"channel": "Q_a"}, {"g": 0.7}))
    np.testing.assert_allclose(found, -0.3 * np.outer([0.0, 25.0, 100.0], [0.6, 0.0, 0.4]), atol=1e-12)


def test_input_gain_of_sunlight_follows_the_sun() -> None:
    found = heat_W(REGISTRY["input_gain"]({"channel": "Q_sun"}, {"g": 1.5}))
    np.testing.assert_allclose(found[:, 1], 0.5 * np.array([10.0, 18.0, 33.0]))


def test_input_power_law() -> None:
    found = heat_W(REGISTRY["input_power_law"]({"channel": "Q_a"}, {"n": 2.0}, {"reference": 50.0}))
    delivered = np.array([0.0, 25.0, 100.0]) ** 2 / 50.0
    np.testing.assert_allclose(found, np.outer(delivered - [0.0, 25.0, 100.0], [0.6, 0.0, 0.4]), atol=1e-9)


def test_an_input_power_law_whose_reference_is_to_be_found() -> None:
    found = heat_W(REGISTRY["input_power_law"]({"channel": "Q_a"}, {"n": 2.0, "reference": 80.0}))
    delivered = np.array([0.0, 25.0, 100.0]) ** 2 / 80.0
    np.testing.assert_allclose(found, np.outer(delivered - [0.0, 25.0, 100.0], [0.6, 0.0, 0.4]), atol=1e-9)


def test_input_power_law_of_a_percentage_keeps_its_gain() -> None:
    found = heat_W(REGISTRY["input_power_law"]({"channel": "H"}, {"n": 2.0}, {"reference": 100.0}))
    np.testing.assert_allclose(found[:, 2], 0.4 * (np.array([25.0, 0.0, 1.0]) - [50.0, 0.0, 10.0]), atol=1e-9)


LEARNED = {
    "degree": 2, "vanishing": False, "low_K": (275.0,), "high_K": (305.0,), "misfit_W": 0.0, "covariance_W2": (),
}  # fmt: skip


def test_learned_heat_flow_is_held_beyond_what_it_has_seen() -> None:
    values = {"coefficients[0]": 1.0, "coefficients[1]": 2.0, "coefficients[2]": 3.0}
    found = heat_W(REGISTRY["learned_heat_flow"]({"node": "a"}, values, LEARNED))[:, 0]
    x = np.array([2.0 / 3.0, 1.0, -1.0])
    np.testing.assert_allclose(found, 1.0 + 2.0 * x + 3.0 * x**2)


@pytest.mark.parametrize("vanishing", [False, True])
def test_learned_heat_flow_answers_to_node_and_boundary(vanishing: bool) -> None:
    """Heat and slopes against the polynomial written out; beyond the range neither temperature moves it."""
    low_K, high_K = ((-20.0, 290.0), (20.0, 300.0)) if vanishing else ((280.0, 290.0), (310.0, 300.0))
    settings = LEARNED | {"vanishing": vanishing, "low_K": low_K, "high_K": high_K}
    c = [0.5, 2.0, -3.0, 1.0, 0.7, -0.2][: 3 if vanishing else 6]
    values = {f"coefficients[{k}]": v for k, v in enumerate(c)}
    effect = REGISTRY["learned_heat_flow"]({"node": "a", "boundary": "room"}, values, settings)
    term = effect.addition(every_term_network([effect]).layout).terms[0]

    def by_hand(t: np.ndarray, b: np.ndarray) -> np.ndarray:
        if vanishing:
            x, z = np.clip(t - b, -20.0, 20.0) / 20.0, (np.clip(b, 290.0, 300.0) - 295.0) / 5.0
            return c[0] * x + c[1] * x**2 + c[2] * x * z
        x, z = (np.clip(t, 280.0, 310.0) - 295.0) / 15.0, (np.clip(b, 290.0, 300.0) - 295.0) / 5.0
        return c[0] + c[1] * x + c[2] * z + c[3] * x**2 + c[4] * x * z + c[5] * z**2

    t, b = np.array([300.0, 285.0, 330.0, 292.0]), np.array([295.0, 292.0, 294.0, 320.0])
    nodes, ends = np.tile(t[:, None], 3), np.tile(b[:, None], 3)
    part = term.evaluate(Along(np.arange(4.0), nodes, ends, {}, np.ones(4)), np.array(c))
    np.testing.assert_allclose(part.heat_W[:, 0], by_hand(t, b), rtol=1e-12)
    step = 1e-5
    by_t, by_b = by_hand(t + step, b) - by_hand(t - step, b), by_hand(t, b + step) - by_hand(t, b - step)
    np.testing.assert_allclose(part.d_temperature[:, 0, 0], by_t / (2 * step), atol=1e-7)
    assert [(e.item, e.node) for e in part.d_boundaries] == [(1, 0)]
    np.testing.assert_allclose(part.d_boundaries[0].series, by_b / (2 * step), atol=1e-7)


@pytest.mark.parametrize(
    ("where", "change", "message"),
    [
        ({"node": "a", "boundary": "room"}, {}, "low_K holds 1 temperatures, where has node, boundary"),
        ({"node": "a"}, {"low_K": (280.0, 1.0), "high_K": (290.0, 2.0)}, "low_K holds 2 temperatures, where has node"),
        ({"node": "a"}, {"low_K": 3.0}, "a setting is no number"),
        ({"node": "a"}, {"low_K": (310.0,)}, "low_K not above high_K"),
        ({"node": "a"}, {"degree": -1}, "degree must be at least 0"),
    ],
)
def test_learned_heat_flow_with_wrong_settings_is_refused(where: dict, change: dict, message: str) -> None:
    effect = REGISTRY["learned_heat_flow"](where, {"coefficients[0]": 0.0}, LEARNED | change)
    with pytest.raises(ModelError, match=message):
        effect.parameter_specs()


def test_learned_heat_flow_tries_a_boundary_only_where_it_has_moved() -> None:
    network = every_term_network()
    kind, along = REGISTRY["learned_heat_flow"], points(network, 60)
    still = replace(along, boundaries_K=np.full_like(along.boundaries_K, 290.0))
    where = {"node": "a", "boundary": "room"}
    assert [len(list(kind.starts(where, survey_of(network, a)))) for a in (along, still)] == [6, 0]
    assert len(list(kind.starts({"node": "a"}, survey_of(network, still)))) == 6


def places(name: str) -> list[dict]:
    return list(REGISTRY[name].places(every_term_network().layout))


def test_what_is_declared_is_no_place() -> None:
    pairs = [set(where["nodes"]) for where in places("missing_conductor")]
    assert pairs == [{"a", "c"}]
    leaks = [(where["node"], where["boundary"]) for where in places("leak_to_boundary")]
    assert ("c", "room") not in leaks and ("b", "sink") not in leaks and ("a", "room") in leaks
    tables = [(where["node"], where["channel"]) for where in places("channel_heat_load")]
    assert ("a", "pitch") not in tables and ("b", "mode") not in tables and ("c", "mode") in tables


def test_an_unknown_gain_is_calibrated_not_discovered() -> None:
    assert [where["channel"] for where in places("input_gain")] == ["Q_a", "Q_sun"]


def test_a_power_law_needs_several_levels() -> None:
    network = every_term_network()
    along = points(network, 20)
    for series, n_starts in (
        (np.full(20, 30.0), 0),
        (np.where(np.arange(20) % 2, 30.0, 0.0), 0),
        (np.where(np.arange(20) % 2, 30.0, 5.0), 3),
        (along.inputs["Q_a"], 3),
    ):
        inputs = {**along.inputs, "Q_a": series}
        survey = survey_of(
            network, Along(along.time_s, along.temperatures_K, along.boundaries_K, inputs, along.sun_factor)
        )
        assert len(list(REGISTRY["input_power_law"].starts({"channel": "Q_a"}, survey))) == n_starts
        in_percent = list(REGISTRY["input_power_law"].starts({"channel": "H"}, survey))
        assert [list(effect.values) for effect in in_percent] == [["n"]], "an unknown gain stands for the reference"


def test_a_table_rests_on_the_levels_of_its_channel() -> None:
    network = every_term_network()
    survey = survey_of(network, points(network, 30))
    by_level, over_pitch = REGISTRY["channel_heat_load"].starts({"node": "c", "channel": "mode"}, survey)
    assert by_level.settings == {"knots": (0.0, 1.0, 2.0), "levels": True}
    most = float(np.bincount(survey.along.inputs["mode"].astype(int)).argmax())
    assert (over_pitch.settings["across"], over_pitch.settings["solar"]) == ("pitch", True)
    assert set(over_pitch.settings["states"]) == {0.0, 1.0, 2.0} - {most}
    by_knots = next(iter(REGISTRY["channel_heat_load"].starts({"node": "c", "channel": "pitch"}, survey)))
    knots = by_knots.settings["knots"]
    assert not by_knots.settings["levels"]
    assert (knots[0], knots[-1]) == (survey.along.inputs["pitch"].min(), survey.along.inputs["pitch"].max())


def test_a_heater_that_starts_fits_its_reach() -> None:
    """The power limit that a start implies is its gain times how far below the set-point it saturates."""
    network = every_term_network()
    survey = survey_of(network, points(network, 60))
    for start in REGISTRY["proportional_heater"].starts({"node": "a"}, survey):
        moved = start.with_amplitudes(np.array([2.0]))
        assert moved is not None
        assert moved.values["Q_W"] == pytest.approx(2.0 * start.settings["reach_K"])
        assert math.isfinite(moved.values["T_set_K"])


def test_a_state_has_knots_only_where_it_has_been_more_than_once() -> None:
    """State 1 has been everywhere, state 2 at high pitch in one eighth of the record only."""
    network = every_term_network()
    along = points(network, 400)
    mode = np.where(np.arange(400) < 150, 0.0, along.inputs["mode"])
    before = np.arange(400) < 350
    pitch = np.where((mode == 2.0) & before, np.minimum(along.inputs["pitch"], 60.0), along.inputs["pitch"])
    survey = survey_of(network, replace(along, inputs={**along.inputs, "pitch": pitch, "mode": mode}))
    _, start = REGISTRY["channel_heat_load"].starts({"node": "a", "channel": "mode"}, survey)
    cells = list(zip(start.settings["states"], start.settings["knots"], strict=True))
    assert cells == [(1.0, 45.0), (1.0, 90.0), (1.0, 135.0), (2.0, 45.0)]
