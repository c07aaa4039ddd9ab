"""The hold-out: where it is cut, what it scores, and that a prediction over it is never corrected."""

import numpy as np
import pytest

from tests.analytic import linear_states
from tests.helpers import conductive_spec, model_of, record_of
from twin_core.calibrate.result import CalibratedModel
from twin_core.errors import ModelError, TelemetryError
from twin_core.holdout import HeldOut, predict, split_burn_in, split_fraction
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

CAPACITY_J_PER_K, WALL_W_PER_K, ROOM_K, NOISE_K = 4.0e3, 2.0, 280.0, 0.05


def steady(n_times: int, start_s: float = 0.0, name: str = "record") -> Record:
    time_s = start_s + 60.0 * np.arange(n_times)
    return Record(time_s, {"T0": np.full(n_times, 290.0), "Q": np.zeros(n_times)}, None, name)


def test_the_last_share_of_the_time_span_is_kept_back() -> None:
    train, held = split_fraction([steady(101)], 0.3)
    assert [part.time_s[-1] for part in train] == [70 * 60.0]
    (only,) = held
    assert (
        only.lead.time_s[-1] == only.scored.time_s[0] == 70 * 60.0
    )  # the start of the rollout is the lead's last sample
    assert only.scored.time_s[-1] == 100 * 60.0
    np.testing.assert_array_equal(only.lead.time_s, train[0].time_s)


def test_the_share_is_of_time_not_of_samples() -> None:
    """Dense samples at the end do not push the cut: 30 % of the span is 30 % of the span."""
    time_s = np.concatenate([np.arange(0.0, 700.0, 20.0), np.arange(700.0, 1001.0, 1.0)])
    record = record_of(time_s, T0=290.0, Q=0.0)
    train, held = split_fraction([record], 0.3)
    assert train[0].time_s[-1] == 700.0
    assert held[0].scored.time_s[-1] == 1000.0


def test_several_segments_are_split_by_their_summed_spans() -> None:
    parts = [steady(41, 0.0, "one"), steady(41, 1e6, "two"), steady(41, 2e6, "three")]
    train, held = split_fraction(parts, 0.5)
    assert [part.name for part in train] == ["one", "two"]
    assert train[1].time_s[-1] == 1e6 + 20 * 60.0
    assert [part.scored.name for part in held] == ["two", "three"]
    assert held[1].scored.time_s[0] > 2e6  # a whole segment tells its own start by a burn-in


def test_a_cut_between_segments_leaves_both_whole() -> None:
    train, held = split_fraction([steady(61), steady(61, 1e6)], 0.5)
    assert [part.time_s.size for part in train] == [61]
    assert len(held) == 1
    assert held[0].scored.time_s[-1] == 1e6 + 60 * 60.0


@pytest.mark.parametrize(("fraction", "n_train"), [(0.61, 1), (0.65, 1), (0.52, 1), (0.4, 2), (0.25, 2)])
def test_a_segment_is_not_cut_where_a_part_would_be_too_short(fraction: float, n_train: int) -> None:
    """Passes over a station: 30 readings each, of which a few would tell no start, or nothing."""
    passes = [steady(30, 1e6 * i, str(i)) for i in range(3)]
    if fraction == 0.52:  # before the last readings of the first one end
        passes = [steady(30, 0.0, "0"), steady(31, 1e6, "1")]
    train, held = split_fraction(passes, fraction)
    assert len(train) == n_train and held
    assert all(part.time_s.size >= 10 for part in train)
    assert all(part.scored.time_s.size >= 3 for part in held)


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.1, 1.5, np.nan])
def test_a_share_out_of_range_is_refused(fraction: float) -> None:
    with pytest.raises(TelemetryError, match="holdout: must be between 0 and 1"):
        split_fraction([steady(100)], fraction)


@pytest.mark.parametrize(("n_times", "fraction"), [(12, 0.5), (100, 0.01), (100, 0.95), (3, 0.3), (1, 0.3)])
def test_too_few_samples_are_refused(n_times: int, fraction: float) -> None:
    with pytest.raises(TelemetryError, match="hold"):
        split_fraction([steady(n_times)], fraction)


def test_single_samples_in_files_of_their_own_are_refused() -> None:
    with pytest.raises(
        TelemetryError, match=r"cannot be split by a hold-out of 0\.3; choose another one, or put single"
    ):
        split_fraction([steady(1, 60.0 * k, str(k)) for k in range(13)], 0.3)


def test_a_burn_in_of_some_seconds() -> None:
    held = split_burn_in(steady(101), 600.0)
    assert held.lead.time_s[-1] == held.scored.time_s[0] == 600.0
    assert held.scored.time_s.size == 91


def test_a_burn_in_by_default_is_a_twentieth_and_ten_samples_at_least() -> None:
    assert split_burn_in(steady(1001), None).lead.time_s[-1] == 50 * 60.0
    assert split_burn_in(steady(40), None).lead.time_s.size == 10


def test_no_burn_in_starts_from_the_first_sample() -> None:
    held = split_burn_in(steady(20), 0.0)
    assert held.lead.time_s.tolist() == [0.0]
    assert held.scored.time_s.size == 20


@pytest.mark.parametrize("burn_in_s", [20 * 60.0, 18.5 * 60.0, 1e9])
def test_a_burn_in_that_leaves_nothing_is_refused(burn_in_s: float) -> None:
    with pytest.raises(
        TelemetryError, match=r"record: a burn-in of \d+ of its 20 samples leaves fewer than two to score"
    ):
        split_burn_in(steady(20), burn_in_s)


def wall_spec(**more: object) -> dict:
    return conductive_spec(
        1,
        [],
        channels={"Q": {"kind": "power", "unit": "W"}},
        loads=[{"channel": "Q", "node": "n0"}],
        boundaries={"room": {"value_K": ROOM_K}},
        **more,
    ) | {"conductors": [{"between": ["n0", "room"], "conductance_W_per_K": {"guess": 1.0}}]}


def wall_model(**more: object) -> CalibratedModel:
    values = {"C:n0": CAPACITY_J_PER_K, "G:n0|room": WALL_W_PER_K}
    return model_of(load_spec(wall_spec(**more)), values, noise_K=NOISE_K, max_step_s=10.0)


def wall_record(n_times: int, seed: int = 0) -> tuple[Record, np.ndarray]:
    """Return telemetry of a node behind a wall, and its true temperature by the matrix exponential."""
    rng = np.random.default_rng(seed)
    time_s, heat = 60.0 * np.arange(n_times), np.repeat(rng.choice([0.0, 80.0], n_times // 10 + 1), 10)[:n_times]
    drive = (heat[:, None] + WALL_W_PER_K * ROOM_K) / CAPACITY_J_PER_K
    truth = linear_states(np.array([[-WALL_W_PER_K / CAPACITY_J_PER_K]]), drive, np.array([300.0]), time_s)[:, 0]
    return record_of(time_s, T0=truth + rng.normal(0.0, NOISE_K, n_times), Q=heat), truth


def test_a_true_model_predicts_the_truth() -> None:
    record, truth = wall_record(300)
    _, (held,) = split_fraction([record], 0.4)
    found = predict(wall_model(), held)
    np.testing.assert_array_equal(found.time_s, held.scored.time_s[1:])
    np.testing.assert_array_equal(found.measured_K[:, 0], held.scored.values["T0"][1:])
    # The start is filtered from 180 noisy readings of a node with a memory of 33 of them: known to a quarter of the noise.
    np.testing.assert_allclose(found.predicted_K[:, 0], truth[-found.time_s.size :], atol=NOISE_K)


def test_the_prediction_is_never_corrected() -> None:
    """Readings of the hold-out may be anything: the prediction over it is the same."""
    record, _ = wall_record(200)
    _, (held,) = split_fraction([record], 0.4)
    wild = held.scored.values["T0"].copy()
    wild[1:] = np.random.default_rng(5).uniform(0.0, 1000.0, wild.size - 1)
    spoilt = HeldOut(held.lead, Record(held.scored.time_s, {**held.scored.values, "T0": wild}))
    np.testing.assert_array_equal(predict(wall_model(), spoilt).predicted_K, predict(wall_model(), held).predicted_K)


def test_a_prediction_without_a_solution_is_refused_not_scored_in_part() -> None:
    record, _ = wall_record(200)
    _, (held,) = split_fraction([record], 0.4)
    drained = held.scored.values["Q"].copy()
    drained[40:] = -1e9  # no temperature above absolute zero balances it
    impossible = HeldOut(held.lead, Record(held.scored.time_s, {**held.scored.values, "Q": drained}))
    with pytest.raises(ModelError, match="no solution over the hold-out"):
        predict(wall_model(), impossible)
    held_on, possible = predict(wall_model(), impossible, holding=True), predict(wall_model(), held)
    np.testing.assert_allclose(
        held_on.predicted_K[:39], possible.predicted_K[:39]
    )  # the input ramps to its fall from 39 on
    assert (held_on.predicted_K[40:] == held_on.predicted_K[40]).all()
    assert any("no solution over the hold-out beyond" in notice for notice in held_on.notices)


def test_the_start_sample_and_excluded_intervals_are_not_scored() -> None:
    record, _ = wall_record(200)
    _, (held,) = split_fraction([record], 0.4)
    first = float(held.scored.time_s[10])
    model = wall_model(exclude=[{"start": first, "stop": first + 600.0, "reason": "maneuver"}])
    found = predict(model, held)
    inside = (found.time_s >= first) & (found.time_s < first + 600.0)
    assert np.isnan(found.measured_K[inside]).all()
    assert np.isfinite(found.measured_K[~inside]).all()
    assert np.isfinite(found.predicted_K).all()
    assert held.scored.time_s[0] not in found.time_s


def test_a_hold_out_can_start_from_one_sample() -> None:
    record, truth = wall_record(120)
    found = predict(wall_model(), split_burn_in(record, 0.0))
    assert abs(found.predicted_K[0, 0] - truth[1]) < 4.0 * NOISE_K
    np.testing.assert_allclose(found.predicted_K[-1, 0], truth[-1], atol=NOISE_K)
