"""A heat over a smooth curve: SciPy integrates one block that an angle heats, the number of knots is left to the evidence."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from tests.helpers import survey_of as survey_of_points
from twin_core.calibrate.second_order import fit_network
from twin_core.calibrate.summary import to_model
from twin_core.discover.screen import survey_of
from twin_core.discover.shortlist import refined
from twin_core.discover.trial import Trial, try_effects
from twin_core.effects import effect_from_json, effect_to_json
from twin_core.effects.channel_heat_load import ChannelHeatLoad
from twin_core.effects.proportional_heater import ProportionalHeater
from twin_core.errors import ModelError, SpecError
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.network.terms import Along
from twin_core.report.build import parameters_json
from twin_core.telemetry import Record

CAPACITY, LOSS, WALL_K, NOISE_K, STEP_S, N_TIMES = 900.0, 1.5, 270.0, 0.02, 60.0, 1500
SPEC = load_spec(
    {
        "twin": "t",
        "boundaries": {"wall": {"value_K": WALL_K}},
        "channels": {
            "T_a": {"kind": "temperature", "unit": "K", "noise_std": NOISE_K},
            "Q": {"kind": "power", "unit": "W"},
            "angle": {"kind": "auxiliary", "unit": "deg", "interpolation": "linear"},
        },
        "nodes": [{"id": "a", "sensor": "T_a", "capacity_J_per_K": {"guess": 1000.0}}],
        "conductors": [{"between": ["a", "wall"], "conductance_W_per_K": {"guess": 1.2}}],
        "loads": [{"channel": "Q", "node": "a"}],
    }
)
PLACE = {"node": "a", "channel": "angle"}


def bump(angle: np.ndarray | float) -> np.ndarray:
    return np.asarray(25.0 * np.exp(-(((np.asarray(angle) - 100.0) / 22.0) ** 2)))


def line(angle: np.ndarray | float) -> np.ndarray:
    return np.asarray(0.15 * np.asarray(angle))


CURVES = {"bump": bump, "line": line}


@cache
def found(curve: str) -> tuple[ChannelHeatLoad, dict]:
    """Return the table that the evidence prefers, fitted, and its rows in a report."""
    rng = np.random.default_rng(4)
    time_s = STEP_S * np.arange(N_TIMES)
    angle = 90.0 + 85.0 * np.sin(2.0 * np.pi * time_s / 13_700.0) * np.cos(2.0 * np.pi * time_s / 61_000.0)
    power = 30.0 * (np.arange(N_TIMES) // 37 % 2)

    def rate(t: float, x: np.ndarray) -> list[float]:
        heat = power[min(int(t / STEP_S), N_TIMES - 1)] + float(CURVES[curve](np.interp(t, time_s, angle)))
        return [(heat + LOSS * (WALL_K - x[0])) / CAPACITY]

    solved = solve_ivp(rate, (0.0, time_s[-1]), [285.0], t_eval=time_s, max_step=STEP_S / 2, rtol=1e-7, atol=1e-7)
    values = {"T_a": solved.y[0] + NOISE_K * rng.normal(size=N_TIMES), "Q": power, "angle": angle}
    fit, calibration = fit_network(SPEC, [Record(time_s, values)])
    base = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
    start = next(iter(ChannelHeatLoad.starts(PLACE, survey_of(fit))))
    (chosen,) = refined(fit, [start])
    trial = try_effects(base, [chosen], n_passes=15)
    model = to_model(trial.calibration(), trial.present_effects)
    (effect,) = model.effects
    assert isinstance(effect, ChannelHeatLoad)
    return effect, parameters_json(effect, {p["name"]: p["std"] for p in model.summary["parameters"]})


def test_a_bump_gets_the_knots_that_it_needs_and_a_line_no_more_than_that() -> None:
    assert len(found("bump")[0].settings["knots"]) >= 9
    assert len(found("line")[0].settings["knots"]) <= 4


@pytest.mark.parametrize("curve", sorted(CURVES))
def test_the_bands_hold_the_curve_at_the_knots(curve: str) -> None:
    """Nine in ten knots are expected inside 90 % bands; of these few fewer than six in ten would be found once in fifty times."""
    effect, rows = found(curve)
    mean, std = (np.array(rows["values_W"][key]) for key in ("mean", "std"))
    truth = CURVES[curve](np.array(effect.settings["knots"]))
    assert (np.abs(mean - truth) < 1.645 * std).mean() >= 0.6
    assert np.abs(mean - truth).max() < 4.0 * std.max()


def test_the_error_of_straight_lines_is_that_of_the_best_ones() -> None:
    """Least squares by hat functions over a parabola: off by h² f'' / 12 at the inner knots."""
    knots = np.linspace(0.0, 12.0, 13)
    x = np.linspace(0.0, 12.0, 24_001)
    hats = np.maximum(1.0 - np.abs(x[:, None] - knots), 0.0)
    values = np.linalg.lstsq(hats, 3.0 * x**2, rcond=None)[0]
    table = ChannelHeatLoad(
        PLACE, {f"values_W[{i}]": v for i, v in enumerate(values)}, {"knots": tuple(knots), "levels": False}
    )
    told = np.array([spec.resolution for spec in table.parameter_specs()])
    off = np.abs(values - 3.0 * knots**2)
    np.testing.assert_allclose(told[4:-4], off[4:-4], rtol=0.02)
    assert [
        q.resolution for q in ChannelHeatLoad(PLACE, {}, {"knots": (0.0, 1.0, 2.0), "levels": True}).parameter_specs()
    ] == [0] * 3


def test_beyond_its_knots_a_curve_says_so() -> None:
    values = {"values_W[0]": 0.0, "values_W[1]": 4.0, "values_W[2]": 8.0}
    table = ChannelHeatLoad(PLACE, values, {"knots": (10.0, 20.0, 30.0), "levels": False})
    network = build_network(SPEC)
    along = Along(
        np.arange(4.0),
        np.full((4, 1), 280.0),
        np.full((4, 1), WALL_K),
        {"angle": np.array([5.0, 10.0, 25.0, 33.0])},
        np.ones(4),
    )
    beyond = table.beyond(network.layout, along)
    assert beyond is not None and beyond.outside.tolist() == [True, False, False, True]
    np.testing.assert_allclose(beyond.std_W, [0.4 * 5.0, 0.0, 0.0, 0.4 * 3.0])
    assert beyond.visited == "angle 10 to 30"
    levels = ChannelHeatLoad(PLACE, values, {"knots": (10.0, 20.0, 30.0), "levels": True})
    assert levels.beyond(network.layout, along) is None


@given(
    values=st.lists(st.floats(-50.0, 50.0), min_size=4, max_size=4),
    angle=st.lists(st.floats(0.0, 180.0), min_size=5, max_size=40),
    levels=st.booleans(),
)
def test_about_no_mean_a_table_brings_in_nothing_over_its_record(
    values: list[float], angle: list[float], levels: bool
) -> None:
    """Whatever its values are; centred, each is the heat that flows there, and the heat stays as it was."""
    settings = {"knots": (0.0, 60.0, 120.0, 180.0), "levels": levels}
    table = ChannelHeatLoad(PLACE, {f"values_W[{i}]": v for i, v in enumerate(values)}, settings)
    network, n = build_network(SPEC), len(angle)
    inputs = {"angle": np.array(angle), "Q": np.zeros(n)}
    along = Along(np.arange(float(n)), np.full((n, 1), 280.0), np.full((n, 1), WALL_K), inputs, np.ones(n))
    survey = survey_of_points(network, along)
    (form,) = table.simplified(survey)
    assert form.n_free == 3 and not list(form.simplified(survey))
    heats = []
    for one in (table, form, form.centred(survey)):
        (term,) = one.addition(network.layout).terms
        heats.append(term.evaluate(along, np.array([p.value for p in one.parameters()])).heat_W[:, 0])
    whole, alone, centred = heats
    np.testing.assert_allclose(alone, whole - whole.mean(), atol=1e-9)
    np.testing.assert_allclose(centred, alone, atol=1e-9)
    told = np.array([form.centred(survey).values[f"values_W[{i}]"] for i in range(4)])
    assert abs(np.dot(form.settings["visits"], told)) < 1e-9
    assert table.centred(survey) == table


def test_what_a_file_holds_wrongly_is_told_by_its_field() -> None:
    table = ChannelHeatLoad(PLACE, {"values_W[0]": 1.0, "values_W[1]": 2.0}, {"knots": (0.0, 9.0), "levels": False})
    data = effect_to_json(table)
    with pytest.raises(SpecError, match=r"settings\.held: 'values_W\[7\]' is none of its values"):
        effect_from_json({**data, "settings": {**data["settings"], "held": ["values_W[7]"]}}, 0)
    wrong = replace(table, settings={**table.settings, "visits": (1.0,)})
    with pytest.raises(ModelError, match=r"settings\.visits must hold 2 shares"):
        wrong.addition(build_network(SPEC).layout)


def test_a_limit_that_was_never_reached_is_unbounded_above() -> None:
    effect = ProportionalHeater({"node": "a"}, {"k_W_per_K": 2.0, "T_set_K": 290.0, "Q_W": 40.0})
    stds = {f"{effect.label}.k_W_per_K": 0.1, f"{effect.label}.T_set_K": 0.2}
    open_ = parameters_json(effect, stds | {f"{effect.label}.Q_W": 120.0})
    assert open_["Q_W"] == {"mean": 40.0, "std": 120.0, "unbounded_above": True}
    assert "unbounded_above" not in parameters_json(effect, stds | {f"{effect.label}.Q_W": 12.0})["Q_W"]
    assert "unbounded_above" not in open_["k_W_per_K"]
