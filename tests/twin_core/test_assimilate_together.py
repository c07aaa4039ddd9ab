"""The filter of many twins against the filter of one, which knows nothing of it."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from tests.helpers import conductive_spec, model_of, record_of
from twin_core.assimilate import Assimilation, assimilate, together
from twin_core.assimilate.together import Member, Question, assimilate_together
from twin_core.calibrate.result import CalibratedModel
from twin_core.effects import REGISTRY
from twin_core.errors import TelemetryError
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

N_NODES = 5
INPUTS = ("Q", "pitch", "T_wall")
EDGES = [(k, (k + 1) % N_NODES) for k in range(N_NODES)]


def radiating(seed: int) -> CalibratedModel:
    """Return a sibling with radiation outwards and inside, an unknown and a measured sink, a table and a node nobody reads."""
    rng = np.random.default_rng(seed)
    data = conductive_spec(
        N_NODES,
        EDGES,
        channels={
            "Q": {"kind": "power", "unit": "W"},
            "pitch": {"kind": "auxiliary", "unit": "deg"},
            "T_wall": {"kind": "temperature", "unit": "K"},
        },
        boundaries={"space": {"value_K": 2.7}, "sink": {"guess_K": 260.0}, "wall": {"channel": "T_wall"}},
        radiators=[
            {"node": "n0", "emissivity": 0.8, "area_m2": 0.2, "sink": "space"},
            {"node": "n4", "emissivity": 0.7, "area_m2": 0.3, "sink": "wall"},
        ],
        radiation=[{"between": ["n1", "n3"], "area_m2": {"guess": 0.2}}],
        loads=[
            {"channel": "Q", "node": "n0", "gain": {"guess": 1.0}},
            {"channel": "pitch", "node": "n2", "table": {"knots": [0.0, 90.0, 180.0]}},
        ],
        twin=f"sat-{seed}",
    )
    data["conductors"].append({"between": ["n3", "sink"], "conductance_W_per_K": {"guess": 0.5}})
    del data["nodes"][2]["sensor"], data["channels"]["T2"]
    spec = load_spec(data)
    names = [f"C:n{k}" for k in range(N_NODES)] + [f"G:n{a}|n{b}" for a, b in EDGES]
    values = dict(
        zip(names, rng.uniform(2e3, 6e3, N_NODES).tolist() + rng.uniform(1, 4, N_NODES).tolist(), strict=True)
    )
    return model_of(spec, values | {"T:sink": rng.uniform(240, 270)}, misfit_K=0.2, max_step_s=40.0)


def conductive(seed: int) -> CalibratedModel:
    """Return one of a design whose balance is linear; all of the same numbers."""
    spec = load_spec(conductive_spec(N_NODES, EDGES, twin=f"sat-{seed}"))
    return model_of(spec, {f"C:n{k}": 3e3 + 500 * k for k in range(N_NODES)}, misfit_K=0.2)


def with_effect(name: str, where: dict[str, str], **values: float) -> Callable[[int], CalibratedModel]:
    """Return the maker of a conductive model with one effect more."""

    def make(seed: int) -> CalibratedModel:
        data = conductive_spec(N_NODES, EDGES, twin=f"sat-{seed}", boundaries={"space": {"value_K": 2.7}})
        data["nodes"][0]["capacity_J_per_K"] = {"guess": 4e3 + seed}
        return model_of(load_spec(data), {}, effects=[REGISTRY[name](where, values)], misfit_K=0.2)

    return make


def telemetry(model: CalibratedModel, seed: int, n_times: int) -> Record:
    """Return readings at irregular instants, some of them missing, and inputs that hold or move in between."""
    rng = np.random.default_rng(100 + seed)
    time_s = np.cumsum(rng.uniform(5.0, 130.0, n_times)) + 1e6 * seed
    channels = {
        s: 288.0 + 4.0 * rng.normal() + np.cumsum(rng.normal(0.0, 0.4, n_times)) for s in model.spec.sensors
    } | {"Q": rng.uniform(0.0, 80.0, n_times), "pitch": rng.uniform(0.0, 180.0, n_times)}
    channels["T_wall"] = 280.0 + rng.normal(size=n_times)
    for name, column in channels.items():
        column[1:-1][rng.random(n_times - 2) < 0.3] = np.nan
        if name not in INPUTS:
            column[n_times // 2] = np.nan  # a sample without any reading
    return record_of(time_s, **{name: column for name, column in channels.items() if name in model.spec.channels})


def cut(record: Record, stops: Sequence[int]) -> list[Record]:
    """Return stretches that each begin with the last sample of the one before, and with the inputs that hold there."""
    held = dict.fromkeys(INPUTS, np.nan)
    stretches = []
    for first, stop in zip([0, *stops[:-1]], stops, strict=True):
        stretch = record.take(np.arange(max(first - 1, 0), stop))
        for name in held.keys() & stretch.values.keys():
            column = stretch.values[name]
            column[0] = held[name] if np.isnan(column[0]) else column[0]
            held[name] = column[np.isfinite(column)][-1]
        stretches.append(stretch)
    return stretches


def assert_same(found: Assimilation | Exception, expected: Assimilation) -> None:
    assert isinstance(found, Assimilation), found
    assert (found.sensors, found.nodes) == (expected.sensors, expected.nodes)
    np.testing.assert_array_equal(found.time_s, expected.time_s)
    for name in ("innovation_K", "mean_K", "covariance_K2", "innovation_std_K", "nis"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-9, atol=1e-9, err_msg=name)


@pytest.mark.parametrize(
    ("make", "is_alone"),
    [
        (radiating, False),
        (conductive, False),
        (with_effect("radiation_to_sink", {"node": "n1", "sink": "space"}, R_m2=0.3), False),
        (with_effect("constant_heat_load", {"node": "n1"}, Q_W=3.0), False),
        (with_effect("nonlinear_convection", {"node": "n1", "boundary": "space"}, k=1e-3, p=1.3), True),
    ],
)
def test_each_twin_is_filtered_as_if_it_were_alone(
    make: Callable[[int], CalibratedModel], is_alone: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    models = [make(seed) for seed in range(6)]
    records = [telemetry(model, seed, 40) for seed, model in enumerate(models)]
    stretches = [cut(r, [2, 3 + k % 2, 8, 9, 25 + 2 * k, 40]) for k, r in enumerate(records)]
    single = [[assimilate(m, s[0])] for m, s in zip(models, stretches, strict=True)]
    for model, own, done in zip(models, stretches, single, strict=True):
        for stretch in own[1:]:
            done.append(assimilate(model, stretch, done[-1].state))
    alone = []
    monkeypatch.setattr(together, "assimilate", lambda *question: alone.append(1) or assimilate(*question))
    members = [Member.of(model) for model in models]
    states = [None] * len(models)
    for number in range(6):
        questions = [Question(m, s[number], state) for m, s, state in zip(members, stretches, states, strict=True)]
        found = assimilate_together(questions)
        for k, one in enumerate(found):
            assert_same(one, single[k][number])
        states = [one.state for one in found]  # type: ignore[union-attr]
    assert len(alone) == 6 * (6 if is_alone else 1)  # the first samples, from which a state is found


def test_gains_are_computed_once_where_network_sampling_and_mask_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    models = [conductive(seed) for seed in range(8)]
    time_s = np.arange(3) * 30.0
    records = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        columns = {s: 290.0 + rng.normal(size=3) for s in models[0].spec.sensors}
        if seed >= 5:
            columns["T1"][1] = np.nan
        records.append(record_of(time_s, **columns))
    states = [assimilate(models[0], records[0].take(np.arange(1))).state] * 8
    leaders = []
    real = together.run
    monkeypatch.setattr(together, "run", lambda lanes, *rest: leaders.append(lanes.twin.size) or real(lanes, *rest))
    found = assimilate_together([Question(Member.of(m), r, s) for m, r, s in zip(models, records, states, strict=True)])
    assert leaders == [2]
    for model, record, state, one in zip(models, records, states, found, strict=True):
        assert_same(one, assimilate(model, record, state))


def test_one_twin_that_cannot_be_filtered_leaves_the_others_alone() -> None:
    models = [radiating(seed) for seed in range(3)]
    records = [telemetry(model, seed, 6) for seed, model in enumerate(models)]
    states = [assimilate(m, r.take(np.arange(3))).state for m, r in zip(models, records, strict=True)]
    rest = [r.take(np.arange(2, 6)) for r in records]
    rest[1] = Record(rest[1].time_s, {name: c for name, c in rest[1].values.items() if name != "Q"})
    found = assimilate_together([Question(Member.of(m), r, s) for m, r, s in zip(models, rest, states, strict=True)])
    assert isinstance(found[1], TelemetryError) and "'Q'" in str(found[1])
    for k in (0, 2):
        assert_same(found[k], assimilate(models[k], rest[k], states[k]))


def test_long_gaps_foreign_states_and_far_temperatures_are_left_to_the_filter_of_one() -> None:
    model = radiating(0)
    record = telemetry(model, 0, 12)
    state = assimilate(model, record.take(np.arange(3))).state
    gap = Record(np.where(np.arange(12) > 6, record.time_s + 1e8, record.time_s), record.values).take(np.arange(2, 12))
    foreign = state | {"nodes": ["another"]}
    hot = state | {"mean_K": [4_000.0] * N_NODES}
    member = Member.of(model)
    whole = record.take(np.arange(2, 12))
    questions = [Question(member, gap, state), Question(member, whole, foreign), Question(member, whole, hot)]
    for question, found in zip(questions, assimilate_together(questions), strict=True):
        assert_same(found, assimilate(model, question.record, question.state))
