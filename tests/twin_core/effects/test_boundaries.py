"""Effects on boundaries: closed forms of what nodes feel of them, exact derivatives, and what a fit and a filter make of them."""

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.analytic import SIGMA
from tests.helpers import central_difference, every_term_network, model_of, points, record_of
from twin_core.assimilate import assimilate
from twin_core.calibrate.problem import build_segment
from twin_core.calibrate.second_order import fit_network
from twin_core.effects import REGISTRY, Effect, effect_from_json, effect_to_json
from twin_core.effects.base import Survey, touched_nodes
from twin_core.effects.heat import effect_heat_W
from twin_core.errors import ModelError
from twin_core.flows import heat_flows
from twin_core.network.dynamics import evaluate_balance
from twin_core.network.model import Network, build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.response import sensitivities
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

CAPACITY, LEAK, AREA_M2 = 4.0e3, 0.8, 0.12
DATA = {
    "twin": "room",
    "boundaries": {"room": {"channel": "T_room"}, "space": {"value_K": 3.0}, "sink": {"guess_K": 250.0}},
    "channels": {
        "T": {"kind": "temperature", "unit": "K"},
        "T_room": {"kind": "temperature", "unit": "K"},
        "Q": {"kind": "power", "unit": "W"},
    },
    "nodes": [{"id": "n", "sensor": "T", "capacity_J_per_K": {"guess": CAPACITY}}],
    "conductors": [{"between": ["n", "room"], "conductance_W_per_K": {"guess": LEAK}}],
    "radiators": [
        {"node": "n", "emissivity": 0.4, "area_m2": 0.3, "sink": "room"},
        {"node": "n", "emissivity": 0.4, "area_m2": 0.02, "sink": "space"},
    ],
    "loads": [{"channel": "Q", "node": "n"}],
}
OFFSET = REGISTRY["boundary_offset"]({"boundary": "room"}, {"b_K": -3.0})
LAG = REGISTRY["boundary_lag"]({"boundary": "room"}, {"tau_s": 2000.0})
MIX = REGISTRY["boundary_mix"]({"boundary": "room"}, {"alpha": 0.3, "T_w_K": 288.0})
COLD = REGISTRY["boundary_offset"]({"boundary": "space"}, {"b_K": 120.0})
CONVECTION = REGISTRY["nonlinear_convection"]({"node": "n", "boundary": "room"}, {"k": 0.2, "p": 1.25})
START_K = 300.0


def room_K(time_s: np.ndarray) -> np.ndarray:
    return 290.0 + 4.0 * np.sin(time_s / 1500.0)


def telemetry(dt_s: float = 20.0, end_s: float = 12000.0) -> Record:
    time_s = np.arange(0.0, end_s + dt_s, dt_s)
    return record_of(time_s, T=START_K, T_room=room_K(time_s), Q=12.0)


def network_of(*effects: Effect) -> Network:
    return build_network(load_spec(DATA), effects)


def start_of(network: Network) -> np.ndarray:
    return np.array([START_K] + [room_K(np.zeros(1))[0]] * (len(network.nodes) - 1))


def states(network: Network, record: Record, values: np.ndarray | None = None) -> np.ndarray:
    forcing = build_forcing(network, record, 20.0)
    at = network.parameters.values if values is None else values
    return rollout(network, at, start_of(network), forcing).at_samples(forcing.sample_step)


def expected_K(sink: object, time_s: np.ndarray, space_K: float = 3.0) -> np.ndarray:
    """Integrate the node with a sink(t, lagged room) by SciPy; the lagged room is integrated with it."""

    def rate(t: float, x: np.ndarray) -> list[float]:
        given = float(room_K(np.array([t]))[0])
        seen = sink(given, x[1])  # type: ignore[operator]
        heat = 12.0 + LEAK * (seen - x[0]) + SIGMA * AREA_M2 * (seen**4 - x[0] ** 4)
        heat += SIGMA * 0.008 * (space_K**4 - x[0] ** 4)
        return [heat / CAPACITY, (given - x[1]) / 2000.0]

    start = [START_K, float(room_K(np.zeros(1))[0])]
    found = solve_ivp(rate, (0.0, time_s[-1]), start, t_eval=time_s, rtol=1e-10, atol=1e-10)
    return np.asarray(found.y[0])


@pytest.mark.parametrize(
    ("effects", "sink"),
    [
        ([OFFSET], lambda given, lagged: given - 3.0),
        ([LAG], lambda given, lagged: lagged),
        ([MIX], lambda given, lagged: 0.3 * given + 0.7 * 288.0),
        ([MIX, LAG], lambda given, lagged: 0.3 * lagged + 0.7 * 288.0),
        ([OFFSET, LAG], lambda given, lagged: lagged - 3.0),
        ([OFFSET, MIX], lambda given, lagged: 0.3 * (given - 3.0) + 0.7 * 288.0),
    ],
    ids=lambda x: "+".join(e.name for e in x) if isinstance(x, list) else "",
)
def test_conductor_and_radiator_see_the_changed_sink(effects: list[Effect], sink: object) -> None:
    record = telemetry()
    found = states(network_of(*effects), record)[:, 0]
    np.testing.assert_allclose(found, expected_K(sink, record.time_s), atol=2e-3)
    assert np.abs(found - states(network_of(), record)[:, 0]).max() > 0.3


def test_a_known_constant_may_be_offset() -> None:
    record = telemetry()
    found = states(network_of(COLD), record)[:, 0]
    np.testing.assert_allclose(found, expected_K(lambda given, lagged: given, record.time_s, 123.0), atol=2e-3)


def test_the_lag_of_a_step_is_an_exponential() -> None:
    network = network_of(LAG)
    record = telemetry()
    step = np.where(record.time_s > 0.0, 295.0, 290.0)
    held = record_of(record.time_s, T=START_K, T_room=step, Q=12.0)
    lagged = states(network, held)[:, 1]
    np.testing.assert_allclose(
        lagged, 295.0 - 5.0 * np.exp(-record.time_s / 2000.0), atol=0.03
    )  # the ramp of one sample


EVERY = [[OFFSET], [LAG], [MIX], [COLD], [OFFSET, LAG, MIX], [CONVECTION, MIX, LAG]]


@pytest.mark.parametrize("effects", EVERY, ids=lambda es: "+".join(e.name for e in es))
def test_sensitivities_are_exact(effects: Sequence[Effect]) -> None:
    network, record = network_of(*effects), telemetry(200.0)
    forcing = build_forcing(network, record, 100.0)
    parameters, n = network.parameters, len(network.nodes)
    path = rollout(network, parameters.values, start_of(network), forcing)
    columns = np.hstack([np.zeros((n, parameters.free.size)), np.eye(n)])
    blocks = sensitivities(network, parameters.values, forcing, path, columns, np.arange(1))
    found = np.concatenate([block for _, block in blocks])[:, 0]

    def read(free: np.ndarray, start: np.ndarray) -> np.ndarray:
        moved = rollout(network, parameters.to_values(free), start, forcing)
        return moved.at_samples(forcing.sample_step)[:, 0]

    for k in range(parameters.free.size + n):
        own = np.arange(parameters.free.size + n) == k

        def along(x: float, own: np.ndarray = own) -> np.ndarray:
            point = np.concatenate([parameters.free, start_of(network)]) + x * own
            return read(point[: parameters.free.size], point[parameters.free.size :])

        expected = central_difference(along, 0.0, 1e-3)
        scale = max(float(np.abs(expected).max()), 1e-6)
        np.testing.assert_allclose(found[:, k], expected, atol=2e-5 * scale, err_msg=f"column {k}")


@pytest.mark.parametrize("effects", EVERY, ids=lambda es: "+".join(e.name for e in es))
def test_the_jacobian_is_exact(effects: Sequence[Effect]) -> None:
    network = network_of(*effects)
    along = points(every_term_network(), 5)
    n = len(network.nodes)
    along = replace(
        along, temperatures_K=280.0 + 10.0 * np.random.default_rng(1).normal(size=(5, n)), inputs={"Q": np.full(5, 3.0)}
    )
    balance = evaluate_balance(network, network.parameters.values, along)
    for node in range(n):

        def heat(x: float, node: int = node) -> np.ndarray:
            moved = along.temperatures_K + x * (np.arange(n) == node)
            return evaluate_balance(network, network.parameters.values, replace(along, temperatures_K=moved)).heat_W

        expected = central_difference(heat, 0.0, 0.1) / balance.own_J_per_K
        np.testing.assert_allclose(balance.flow.dense()[:, :, node], expected, rtol=1e-7, atol=1e-12)


def test_the_heats_of_effects_and_of_the_declared_network_add_up() -> None:
    effects = [CONVECTION, MIX, LAG, COLD]
    network = network_of(*effects)
    record = telemetry()
    forcing = build_forcing(network, record, 20.0)
    stages = np.full((2 * forcing.n_steps, 2), 293.0)
    along = forcing.along(
        stages, np.nan_to_num(forcing.boundaries_flat_K(0, forcing.n_steps), nan=250.0), 0, forcing.n_steps
    )
    declared = evaluate_balance(network_of(), network_of().parameters.values, _only_declared(along)).heat_W
    total = evaluate_balance(network, network.parameters.values, along).heat_W
    brought = np.sum([effect_heat_W(e, network, along) for e in effects], axis=0)
    np.testing.assert_allclose(declared[:, 0] + brought[:, 0], total[:, 0], atol=1e-9)
    assert all(np.abs(effect_heat_W(e, network, along)[:, 0]).max() > 1e-3 for e in effects)


def _only_declared(along):  # type: ignore[no-untyped-def]
    return replace(along, temperatures_K=along.temperatures_K[:, :1])


def test_flows_tell_the_heat_that_the_change_brings() -> None:
    model = model_of(load_spec(DATA), {}, effects=[MIX])
    record = telemetry()
    flows = heat_flows(model, record, assimilate(model, record).state)
    (effect,) = flows["effects"]
    node = next(n for n in flows["nodes"] if n["id"] == "n")
    links = sum(x["heat_W"] if x["ends"][1] == "n" else -x["heat_W"] for x in flows["links"])
    loads = sum(x["heat_W"] for x in flows["loads"])
    assert node["heat_W"] == pytest.approx(links + loads + effect["heat_W"]["n"], abs=1e-9)


def test_a_filter_carries_the_lag_on() -> None:
    """Filtered in two pieces, the second from the state of the first, it is as if it had been one."""
    model = model_of(load_spec(DATA), {}, effects=[LAG], noise_K=0.01)
    record = telemetry()
    truth = states(network_of(LAG), record)
    record.values["T"][:] = truth[:, 0]
    half = record.time_s.size // 2
    early = assimilate(model, record.take(np.arange(half + 1)))
    late = assimilate(model, record.take(np.arange(half, record.time_s.size)), early.state)
    assert early.mean_K[1] == pytest.approx(truth[half, 1], abs=0.05)
    assert late.mean_K[1] == pytest.approx(truth[-1, 1], abs=0.05)


def test_the_lag_starts_at_the_first_value_of_each_record() -> None:
    record = telemetry(60.0)
    record.values["T_room"][:3] = np.nan
    segment = build_segment(network_of(LAG), record, 60.0)
    assert segment.start_prior_K[1] == pytest.approx(record.values["T_room"][3])
    assert segment.start_std_K[1] < 0.01


NOISE_K = 0.02


@pytest.mark.parametrize("truth", [OFFSET, LAG, MIX], ids=lambda e: e.name)
def test_a_fit_finds_the_change(truth: Effect) -> None:
    """The linear screen's own estimate starts the fit, as the search does; powers switch, so that the leak is told."""
    time_s = np.arange(0.0, 40000.0, 60.0)
    power = np.where(time_s % 9000.0 < 4000.0, 40.0, 5.0)
    data = DATA | {"radiators": DATA["radiators"][1:]}  # type: ignore[index]
    bare = record_of(time_s, T=START_K, T_room=room_K(time_s), Q=power)
    network = build_network(load_spec(data), [truth])
    forcing = build_forcing(network, bare, 60.0)
    path = rollout(network, network.parameters.values, start_of(network), forcing).at_samples(forcing.sample_step)
    noise = np.random.default_rng(3).normal(0.0, NOISE_K, time_s.size)
    record = record_of(time_s, T=path[:, 0] + noise, T_room=room_K(time_s), Q=power)
    begin = {"b_K": 0.5, "tau_s": 600.0, "alpha": 0.8, "T_w_K": 291.0}
    start = truth.with_values({name: begin[name] for name in truth.values})
    _, calibration = fit_network(load_spec(data), [record], [start])
    found = calibration.network.parameters.as_dict()
    tolerance = {"b_K": 0.1, "tau_s": 60.0, "alpha": 0.02, "T_w_K": 0.2}
    for name, value in truth.values.items():
        assert found[f"{truth.label}.{name}"] == pytest.approx(value, abs=tolerance[name])


def test_a_share_may_end_on_its_bound() -> None:
    spec = MIX.parameter_specs()[0]
    assert [spec.transform.to_value(x) for x in (-0.5, 0.0, 0.4, 1.0, 1.5)] == [0.0, 0.0, 0.4, 1.0, 1.0]
    assert (spec.transform.lowest, spec.transform.highest) == (0.0, 1.0)


def test_screening_hears_everything_that_reads_the_boundary() -> None:
    """d heat / d offset of the declared conductor and radiator, and of a convection that was found before."""
    network = network_of(CONVECTION)
    record = telemetry()
    forcing = build_forcing(network, record, 20.0)
    boundaries = np.nan_to_num(forcing.boundaries_flat_K(0, forcing.n_steps), nan=250.0)
    along = forcing.along(np.full((2 * forcing.n_steps, 1), 300.0), boundaries, 0, forcing.n_steps)
    survey = replace(_survey(network, along), terms=network.terms)
    start = next(iter(REGISTRY["boundary_offset"].starts({"boundary": "room"}, survey)))
    (column,) = start.unit_heats(survey)
    found = np.sum([series for _, series in column], axis=0)

    def heat(b_K: float) -> np.ndarray:
        moved = network_of(CONVECTION, OFFSET.with_values({"b_K": b_K}))
        return evaluate_balance(moved, moved.parameters.values, along).heat_W[:, 0]

    np.testing.assert_allclose(found, central_difference(heat, 0.0, 0.05), rtol=1e-6)


def _survey(network, along):  # type: ignore[no-untyped-def]
    edges, named = (0, along.time_s.size), network.parameters.as_dict()
    return Survey(
        network.layout, along, np.zeros_like(along.temperatures_K), np.ones(1), {}, edges, named, along.time_s
    )


def test_the_response_at_an_assumed_lag_is_that_of_the_lag() -> None:
    network = network_of()
    record = telemetry()
    forcing = build_forcing(network, record, 20.0)
    boundaries = np.nan_to_num(forcing.boundaries_flat_K(0, forcing.n_steps), nan=250.0)
    along = forcing.along(np.full((2 * forcing.n_steps, 1), 300.0), boundaries, 0, forcing.n_steps)
    survey = _survey(build_network(load_spec(DATA | {"radiators": []})), along)
    starts = list(REGISTRY["boundary_lag"].starts({"boundary": "room"}, survey))
    taus = np.array([start.settings["start_s"] for start in starts])
    assert taus[0] < 100.0 and taus[-1] > 10000.0
    for start in starts:
        ((column,),) = start.unit_heats(survey)
        tau, (time_s, first, back) = (
            start.settings["start_s"],
            np.unique(along.time_s, return_index=True, return_inverse=True),
        )
        room = boundaries[first, 0]

        def rate(
            t: float, r: np.ndarray, tau: float = tau, at: np.ndarray = time_s, room: np.ndarray = room
        ) -> np.ndarray:
            return (np.interp(t, at, room) - r) / tau

        span = (time_s[0], time_s[-1])
        lagged = solve_ivp(rate, span, room[:1], t_eval=time_s, rtol=1e-9, atol=1e-9, max_step=20.0).y[0]
        follows = lagged[back]
        np.testing.assert_allclose(tau * column[1], LEAK * (follows - boundaries[:, 0]), atol=1e-5)


def test_places() -> None:
    layout = network_of().layout
    rooms = {
        kind: [w["boundary"] for w in REGISTRY[kind].places(layout)] for kind in ("boundary_offset", "boundary_lag")
    }
    assert rooms == {"boundary_offset": ["room", "space"], "boundary_lag": ["room"]}
    assert [w["boundary"] for w in REGISTRY["boundary_mix"].places(layout)] == ["room"]
    assert touched_nodes(MIX, layout) == ["n"]
    assert touched_nodes(COLD, layout) == ["n"]


@pytest.mark.parametrize(
    ("name", "boundary", "values", "match"),
    [
        ("boundary_lag", "space", {"tau_s": 10.0}, "only boundary_offset"),
        ("boundary_mix", "space", {"alpha": 0.5, "T_w_K": 200.0}, "only boundary_offset"),
        ("boundary_offset", "sink", {"b_K": 1.0}, "unknown constant"),
        ("boundary_offset", "attic", {"b_K": 1.0}, "unknown boundary 'attic'"),
    ],
)
def test_what_cannot_change_is_refused(name: str, boundary: str, values: dict, match: str) -> None:
    with pytest.raises(ModelError, match=match):
        network_of(REGISTRY[name]({"boundary": boundary}, values))


def test_by_hand_it_needs_no_settings() -> None:
    for effect in (OFFSET, LAG, MIX):
        assert effect_from_json(json.loads(json.dumps(effect_to_json(effect)))) == effect
