"""Steps at an instant: against closed forms on both sides of the onset, and as a parameter that a fit can move."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.analytic import SIGMA, laplacian, linear_states, radiative_equilibrium_K
from tests.helpers import (
    at_named,
    central_difference,
    conductive_spec,
    every_term_network,
    points,
    record_of,
    survey_of,
)
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.second_order import fit_network
from twin_core.calibrate.summary import to_model
from twin_core.effects import REGISTRY, Effect, Survey, effect_from_json, effect_to_json
from twin_core.errors import ModelError, TelemetryError
from twin_core.forecast import forecast
from twin_core.network.model import Network, build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.response import sensitivities
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

CAPACITY = np.array([4.0e3, 9.0e3])
POWER = {"kind": "power", "unit": "W"}
ONSET_S, WIDTH_S = 6130.0, 60.0
CLOCK = {"begin_s": 0.0, "span_s": 12000.0, "width_s": WIDTH_S, "dated": False}


def declared(**more: object) -> dict:
    """Two nodes, a heater, a strap, and a leak to a room at 280 K."""
    data = conductive_spec(2, [(0, 1)], channels={"Q": POWER}, loads=[{"channel": "Q", "node": "n0", "weight": 1.0}])
    data["boundaries"] = {"room": {"value_K": 280.0}, "space": {"value_K": 3.0}}
    data["conductors"] += [{"between": ["room", "n1"], "conductance_W_per_K": {"guess": 0.8}}]
    return data | more


def step(name: str, where: dict, amount: float, **settings: object) -> Effect:
    kind = REGISTRY[name]
    amplitude = kind.amplitude.name  # type: ignore[attr-defined]
    return kind(where, {amplitude: amount, "time": ONSET_S}, CLOCK | settings)


def network_of(data: dict, *effects: Effect) -> Network:
    named = {"C:n0": CAPACITY[0], "C:n1": CAPACITY[1], "G:n0|n1": 3.0, "G:room|n1": 0.8}
    network = build_network(load_spec(data), effects)
    return at_named(network, {k: float(v) for k, v in named.items() if k in network.parameters.index})


def heated(dt_s: float = 60.0, power_W: float = 40.0) -> Record:
    return record_of(np.arange(0.0, 12000.0 + dt_s, dt_s), Q=power_W)


def states(network: Network, record: Record, start: np.ndarray, max_step_s: float = 20.0) -> np.ndarray:
    forcing = build_forcing(network, record, max_step_s)
    path = rollout(network, network.parameters.values, start, forcing)
    return path.at_samples(forcing.sample_step)


def switched(
    before: tuple[np.ndarray, np.ndarray], after: tuple[np.ndarray, np.ndarray], time_s: np.ndarray
) -> np.ndarray:
    """Return the exact states of dT/dt = A T + b with another A and b from the onset on."""
    start = np.array([290.0, 285.0])
    early, late = time_s[time_s < ONSET_S], time_s[time_s >= ONSET_S]
    (a, b), (c, d) = before, after
    first = linear_states(a, np.tile(b, (early.size + 1, 1)), start, np.append(early, ONSET_S))
    second = linear_states(c, np.tile(d, (late.size + 1, 1)), first[-1], np.append(ONSET_S, late))
    return np.vstack([first[:-1], second[1:]])


def rates(strap: float, leak: float, power_W: float) -> tuple[np.ndarray, np.ndarray]:
    matrix = -laplacian(2, [(0, 1)], [strap])
    matrix[1, 1] -= leak
    return matrix / CAPACITY[:, None], np.array([power_W, leak * 280.0]) / CAPACITY


@pytest.mark.parametrize(
    ("effect", "after"),
    [
        (step("input_step", {"channel": "Q"}, 0.0), rates(3.0, 0.8, 0.0)),
        (step("input_step", {"channel": "Q"}, 1.5), rates(3.0, 0.8, 60.0)),
        (step("conductance_step", {"nodes": ["n1", "n0"]}, 0.2), rates(0.6, 0.8, 40.0)),
        (step("conductance_step", {"nodes": ["n0", "n1"]}, 0.0), rates(0.0, 0.8, 40.0)),
        (step("conductance_step", {"nodes": ["n1", "room"]}, 3.0), rates(3.0, 2.4, 40.0)),
        (step("heat_load_step", {"node": "n0"}, -15.0), rates(3.0, 0.8, 25.0)),
    ],
    ids=lambda x: x.label if isinstance(x, Effect) else "",
)
def test_the_balance_changes_at_the_onset(effect: Effect, after: tuple[np.ndarray, np.ndarray]) -> None:
    record = heated()
    found = states(network_of(declared(), effect), record, np.array([290.0, 285.0]))
    expected = switched(rates(3.0, 0.8, 40.0), after, record.time_s)
    away = np.abs(record.time_s - ONSET_S) > WIDTH_S  # a ramp and a step differ while it lasts
    np.testing.assert_allclose(found[away], expected[away], atol=2e-3)
    assert np.abs(expected[-1] - states(network_of(declared()), record, expected[0])[-1]).max() > 0.5


def test_a_heat_that_ends_leaves_the_balance_as_it_was() -> None:
    effect = step("heat_load_step", {"node": "n0"}, 12.0)
    ending = replace(effect, values={**effect.values, "stop": 9000.0})
    assert [q.name for q in ending.parameter_specs()] == ["Q_W", "time", "stop"]
    again = effect_from_json(json.loads(json.dumps(effect_to_json(ending))))
    assert again == ending
    record, start = heated(), np.array([290.0, 285.0])
    found = states(network_of(declared(), again), record, start)
    middle = np.searchsorted(record.time_s, 9000.0)
    forever = states(network_of(declared(), effect), record, start)
    np.testing.assert_allclose(found[: middle - 1], forever[: middle - 1], atol=1e-9)
    expected = linear_states(
        rates(3.0, 0.8, 40.0)[0], np.tile(rates(3.0, 0.8, 40.0)[1], (51, 1)), found[middle + 1], record.time_s[:51]
    )
    np.testing.assert_allclose(found[middle + 1 : middle + 50], expected[:49], atol=2e-3)


def test_a_radiator_settles_where_its_new_emissivity_sheds_the_heat() -> None:
    data = declared(radiators=[{"node": "n0", "emissivity": 0.4, "area_m2": 0.3, "sink": "space"}], conductors=[])
    effect = step("emissivity_step", {"node": "n0", "sink": "space"}, 0.5)
    record = record_of(np.linspace(0.0, 4.0e5, 400), Q=40.0)
    found = states(network_of(data, effect), record, np.array([300.0, 285.0]), 1000.0)
    assert found[-1, 0] == pytest.approx(radiative_equilibrium_K(40.0, 0.5 * 0.4 * 0.3, 3.0), abs=1e-3)
    early = solve_ivp(
        lambda t, x: (40.0 + SIGMA * 0.12 * (3.0**4 - x**4)) / CAPACITY[0], (0.0, 5000.0), [300.0], rtol=1e-9
    )
    short = record_of(np.linspace(0.0, 5000.0, 200), Q=40.0)
    before = states(network_of(data, effect), short, np.array([300.0, 285.0]))
    assert before[-1, 0] == pytest.approx(float(early.y[0, -1]), abs=1e-4)


EVERY_STEP = [
    step("input_step", {"channel": "Q"}, 0.4),
    step("conductance_step", {"nodes": ["n0", "n1"]}, 2.0),
    step("conductance_step", {"nodes": ["room", "n1"]}, 0.3),
    step("emissivity_step", {"node": "n0", "sink": "space"}, 1.5),
    step("heat_load_step", {"node": "n1"}, 12.0),
]


@pytest.mark.parametrize("effect", EVERY_STEP, ids=lambda e: e.label)
def test_the_onset_has_an_exact_derivative(effect: Effect) -> None:
    """Steps of 20 s against a ramp of 60 s: the scheme sees every part of it, and the onset may lie anywhere."""
    assert_exact_derivative(effect, "time", ONSET_S + 7.0)


def test_the_end_of_a_heat_has_an_exact_derivative() -> None:
    effect = step("heat_load_step", {"node": "n0"}, 12.0)
    assert_exact_derivative(replace(effect, values={**effect.values, "stop": 9000.0}), "stop", 9007.0)


def assert_exact_derivative(effect: Effect, instant: str, onset: float) -> None:
    """``onset`` is such that no end of the ramp meets a stage of the scheme."""
    data = declared(radiators=[{"node": "n0", "emissivity": 0.4, "area_m2": 0.2, "sink": "space"}])
    network, start = network_of(data, effect), np.array([290.0, 285.0])
    forcing = build_forcing(network, heated(), 20.0)
    name = f"{effect.label}.{instant}"
    parameters = network.parameters.updated({name: onset})
    column = parameters.free_names.index(name)

    def read(time_s: float) -> np.ndarray:
        at = parameters.updated({name: time_s}).values
        return rollout(network, at, start, forcing).at_samples(forcing.sample_step)

    path = rollout(network, parameters.values, start, forcing)
    n_free = len(parameters.free_names)
    starts = np.hstack([np.zeros((2, n_free)), np.eye(2)])
    blocks = sensitivities(network, parameters.values, forcing, path, starts, np.arange(2))
    found = np.concatenate([block for _, block in blocks])[:, :, column] / parameters.slopes(parameters.free)[column]
    expected = central_difference(read, onset, 0.1)
    scale = float(np.abs(expected).max())
    assert scale > 1e-4
    np.testing.assert_allclose(found, expected, atol=1e-5 * scale)


def test_a_sensor_reads_its_bias_from_the_onset_on() -> None:
    network = network_of(declared(), step("sensor_bias", {"sensor": "T1"}, -1.5))
    (term,) = network.readings
    time_s = ONSET_S + np.array([-3000.0, -30.0, -15.0, 0.0, 30.0, 9000.0])
    reading = term.evaluate(time_s, np.array([-1.5, ONSET_S]))
    assert reading.sensor == 1
    np.testing.assert_allclose(reading.offset_K, -1.5 * np.array([0.0, 0.0, 0.25, 0.5, 1.0, 1.0]))
    for item, series in reading.d_values:

        def offset(x: float, item: int = item) -> np.ndarray:
            return term.evaluate(time_s[2:4], np.where(np.arange(2) == item, x, [-1.5, ONSET_S])).offset_K

        np.testing.assert_allclose(series[2:4], central_difference(offset, [-1.5, ONSET_S][item], 0.5), rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "where"),
    [
        ("conductance_step", {"nodes": ["n0", "room"]}),
        ("emissivity_step", {"node": "n1", "sink": "space"}),
        ("input_step", {"channel": "T0"}),
    ],
)
def test_what_is_not_declared_cannot_change(name: str, where: dict) -> None:
    with pytest.raises(ModelError, match=name):
        network_of(declared(), step(name, where, 0.5))


NS = 1_000_000_000
EPOCH_NS = 1_767_225_600 * NS
NOISE_K = 0.02


def telemetry(begin_s: float, end_s: float, epoch_s: float, dt_s: float = 60.0) -> Record:
    """Return what a spacecraft whose heater dies reads between two moments, in a file that counts from ``epoch_s``."""
    time_s = np.arange(0.0, 24000.0, dt_s)
    power = np.where(time_s % 2400.0 < 1200.0, 60.0, 20.0)
    alive = linear_states(*driven(power, 1.0), np.array([290.0, 285.0]), time_s)
    last = int(np.searchsorted(time_s, 2.0 * ONSET_S))
    late = linear_states(*driven(power[last:], 0.25), alive[last], time_s[last:])
    truth = np.vstack([alive[:last], late])
    keep = (time_s >= begin_s) & (time_s <= end_s)
    rng = np.random.default_rng(int(begin_s))
    read = truth[keep] + rng.normal(0.0, NOISE_K, (int(keep.sum()), 2))
    values = {"Q": power[keep], "T0": read[:, 0], "T1": read[:, 1]}
    return Record(time_s[keep] - epoch_s, values, EPOCH_NS + round(epoch_s) * NS)


def driven(power_W: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
    matrix, _ = rates(3.0, 0.8, 0.0)
    return matrix, np.stack([share * power_W, np.full(power_W.size, 0.8 * 280.0)], axis=1) / CAPACITY


@pytest.fixture(scope="module")
def fitted() -> CalibratedModel:
    """A model whose onset was calibrated from a start half an hour off, and stored."""
    clock = {**CLOCK, "begin_s": EPOCH_NS / 1e9, "span_s": 18000.0, "dated": True}
    start = REGISTRY["input_step"]({"channel": "Q"}, {"f": 0.5, "time": EPOCH_NS / 1e9 + 10500.0}, clock)
    _, calibration = fit_network(load_spec(declared()), [telemetry(0.0, 18000.0, 0.0)], [start])
    model = to_model(calibration, [start])
    return CalibratedModel.from_json(json.loads(json.dumps(model.to_json())))


def test_a_fit_moves_the_onset_to_its_instant(fitted: CalibratedModel) -> None:
    (effect,) = fitted.effects
    at_sample = 12300.0  # the first sample that the dead heater acts from
    assert effect.values["time"] - EPOCH_NS / 1e9 == pytest.approx(at_sample, abs=30.0)
    assert effect.values["f"] == pytest.approx(0.25, abs=0.01)
    told = {p["name"]: p for p in fitted.summary["parameters"]}[f"{effect.label}.time"]
    assert 0.0 < told["std"] < 30.0
    time = effect.presented(effect.parameter_specs()[1])
    assert isinstance(time, str) and time.startswith("2026-01-01T03:2")


@pytest.mark.parametrize(
    ("begin_s", "end_s", "epoch_s"), [(19000.0, 20400.0, 7.0e3), (9600.0, 11400.0, 3.0e4)], ids=["after", "across"]
)
def test_the_onset_is_the_same_instant_in_another_file(
    fitted: CalibratedModel, begin_s: float, end_s: float, epoch_s: float
) -> None:
    ahead = forecast(
        fitted,
        telemetry(begin_s, end_s, epoch_s),
        3000.0,
        step_s=60.0,
        plan=replace(telemetry(end_s, end_s + 3000.0, epoch_s)),
    )
    truth = telemetry(end_s + 60.0, end_s + 3000.0, epoch_s)
    np.testing.assert_allclose(ahead.time_s, truth.time_s)
    for column, sensor in enumerate(("T0", "T1")):
        np.testing.assert_allclose(ahead.mean_K[:, column], truth.values[sensor], atol=0.15)


def test_a_file_without_dates_is_refused_by_a_model_that_knows_a_date(fitted: CalibratedModel) -> None:
    bare = replace(telemetry(19000.0, 20400.0, 0.0), epoch_ns=None, name="bare.csv")
    with pytest.raises(TelemetryError, match=r"bare\.csv: the model knows when its effects set in as dates"):
        forecast(fitted, bare, 3000.0)


def switched_off(first: int, last: int) -> Survey:
    """Return points two minutes apart at which an input is off from one of them to another."""
    network = every_term_network()
    along = points(network, 60)
    power = np.where((np.arange(60) >= first) & (np.arange(60) <= last), 0.0, 40.0)
    return survey_of(network, replace(along, inputs={**along.inputs, "Q_a": power}))


@pytest.mark.parametrize(
    ("point", "centre", "blind"),
    [(20.0, 29.5, 19.0), (30.0, 29.5, 19.0), (38.4, 29.5, 19.0), (39.9, 29.5, 19.0), (45.0, 45.0, 0.0)],
)
def test_an_onset_while_the_input_is_off_lies_in_the_middle(point: float, centre: float, blind: float) -> None:
    """Whoever switches a heater off learns that it died when it is switched on again, and not when in between."""
    survey = switched_off(20, 39)
    start = next(iter(REGISTRY["input_step"].starts({"channel": "Q_a"}, survey)))
    found = start.with_values({"f": 0.0, "time": 120.0 * point}).centred(survey)
    assert found.values == {"f": 0.0, "time": pytest.approx(120.0 * centre)}
    onset = found.parameter_specs()[1]
    assert onset.resolution == pytest.approx(120.0 * blind / 12.0**0.5)
    assert onset.spread(3.0) == pytest.approx(np.hypot(3.0, onset.resolution))
    if blind:
        assert onset.spread(60 * 120.0) == onset.resolution  # a fit that tells nothing gives its prior back


def test_onsets_are_looked_for_all_over_the_record_but_not_in_its_gaps() -> None:
    network = every_term_network()
    survey = survey_of(network, points(network, 400))
    seen = np.concatenate([survey.sample_s[:100], survey.sample_s[300:]])
    times = [
        e.values["time"] for e in REGISTRY["sensor_bias"].starts({"sensor": "T_a"}, replace(survey, sample_s=seen))
    ]
    gap = (survey.sample_s[99], survey.sample_s[300] - 120.0)
    assert len(times) > 20 and times == sorted(times)
    assert not any(gap[0] < t < gap[1] for t in times)
    assert times[0] < 0.05 * survey.sample_s[-1] and times[-1] > 0.95 * survey.sample_s[-1]
    assert np.diff([t for t in times if t < gap[0]]).max() < 0.05 * survey.sample_s[-1]


def test_finer_onsets_lie_between_the_neighbours() -> None:
    network = every_term_network()
    survey = survey_of(network, points(network, 1000))
    coarse = list(REGISTRY["sensor_bias"].starts({"sensor": "T_a"}, survey))
    moved = coarse[7].with_values({"b_K": -0.4})
    finer = list(moved.refined(survey))
    times = np.array([effect.values["time"] for effect in finer])
    assert times.size > 20 and np.diff(times).max() < 0.1 * (times[-1] - times[0])
    assert coarse[6].values["time"] >= times[0] > coarse[5].values["time"]
    assert coarse[8].values["time"] <= times[-1] < coarse[9].values["time"]
    assert all(effect.values["b_K"] == -0.4 and effect.settings == moved.settings for effect in finer)
    for end in (coarse[0], coarse[-1]):
        assert all(0.0 < effect.values["time"] < survey.sample_s[-1] for effect in end.refined(survey))
