"""Telemetry as forcing: what every stage of every step sees, told from the samples by hand."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from tests.helpers import record_of
from twin_core.errors import TelemetryError
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import Forcing, build_forcing
from twin_core.telemetry import Record

TIME_S = np.array([0.0, 60.0, 90.0, 240.0])
NS_PER_S = 1_000_000_000


def declared() -> dict:
    return {
        "twin": "t",
        "boundaries": {"room": {"channel": "T_room"}, "sink": {"guess_K": 200.0}},
        "channels": {
            "T": {"kind": "temperature", "unit": "K"},
            "T_room": {"kind": "temperature", "unit": "K"},
            "Q": {"kind": "power", "unit": "W"},
            "L": {"kind": "power", "unit": "W", "interpolation": "linear"},
            "mode": {"kind": "auxiliary", "levels": True},
            "pitch": {"kind": "auxiliary"},
        },
        "nodes": [{"id": "a", "sensor": "T"}],
        "loads": [{"channel": "Q", "node": "a"}, {"channel": "L", "node": "a"}],
    }


def samples(**more: np.ndarray) -> Record:
    ramp = np.array([1.0, 2.0, 4.0, 8.0])
    return record_of(
        TIME_S, **{"T": 290.0, "T_room": 280.0 + ramp, "Q": ramp, "L": ramp, "mode": ramp, "pitch": ramp} | more
    )


def build(record: Record, max_step_s: float = np.inf, data: dict | None = None) -> Forcing:
    return build_forcing(build_network(load_spec(data or declared())), record, max_step_s)


def test_every_sample_ends_a_step() -> None:
    forcing = build(samples())
    np.testing.assert_array_equal(forcing.step_s, [60.0, 30.0, 150.0])
    np.testing.assert_array_equal(forcing.sample_step, [0, 1, 2, 3])
    np.testing.assert_allclose(forcing.stage_time_s[:, 0], TIME_S[:-1])
    np.testing.assert_allclose(forcing.stage_time_s[:, 1], TIME_S[1:])


def test_long_intervals_are_divided_evenly() -> None:
    forcing = build(samples(), max_step_s=50.0)
    np.testing.assert_allclose(forcing.step_s, [30.0, 30.0, 30.0, 50.0, 50.0, 50.0])
    np.testing.assert_array_equal(forcing.sample_step, [0, 2, 3, 6])
    assert forcing.n_steps == 6


def test_more_steps_than_memory_holds_are_refused() -> None:
    with pytest.raises(TelemetryError, match=r"2\.4e\+11 steps of at most 1e-09 s"):
        build(samples(), max_step_s=1e-9)


def test_power_and_levels_hold_from_their_sample_to_the_next() -> None:
    forcing = build(samples(), max_step_s=50.0)
    expected = np.repeat([1.0, 1.0, 2.0, 4.0, 4.0, 4.0], 2).reshape(6, 2)
    np.testing.assert_array_equal(forcing.inputs["Q"], expected)
    np.testing.assert_array_equal(forcing.inputs["mode"], expected)


def test_the_rest_is_interpolated() -> None:
    forcing = build(samples(), max_step_s=50.0)
    expected = np.interp(forcing.stage_time_s, TIME_S, [1.0, 2.0, 4.0, 8.0])
    np.testing.assert_allclose(forcing.inputs["L"], expected)
    np.testing.assert_allclose(forcing.inputs["pitch"], expected)
    np.testing.assert_allclose(forcing.boundaries_K[:, :, 0], 280.0 + expected)


def test_an_unknown_boundary_is_left_open() -> None:
    assert np.isnan(build(samples()).boundaries_K[:, :, 1]).all()


def test_missing_samples_hold_the_last_or_are_bridged() -> None:
    holes = np.array([np.nan, 2.0, np.nan, 8.0])
    forcing = build(samples(Q=holes, L=holes))
    np.testing.assert_array_equal(forcing.inputs["Q"][:, 1], [2.0, 2.0, 2.0])  # before the first sample its value
    bridged = np.interp(TIME_S[1:], [60.0, 240.0], [2.0, 8.0])
    np.testing.assert_allclose(forcing.inputs["L"][:, 1], bridged)


def test_a_single_sample_makes_no_step() -> None:
    one = record_of(np.array([7.0]), T=290.0, T_room=280.0, Q=1.0, L=1.0)
    forcing = build(one)
    assert (forcing.n_steps, forcing.start_s) == (0, 7.0)
    np.testing.assert_array_equal(forcing.sample_step, [0])


@pytest.mark.parametrize("channel", ["Q", "T_room"])
def test_a_missing_channel_is_named(channel: str) -> None:
    record = samples()
    lacking = Record(record.time_s, {k: v for k, v in record.values.items() if k != channel}, name="orbit.csv")
    with pytest.raises(TelemetryError, match=rf"orbit\.csv: channel '{channel}' is missing"):
        build(lacking)


def test_an_empty_input_is_named() -> None:
    with pytest.raises(TelemetryError, match="channel 'Q' has no samples; the model needs it"):
        build(samples(Q=np.full(4, np.nan)))


def test_an_unused_channel_may_be_absent() -> None:
    record = samples()
    fewer = Record(record.time_s, {k: v for k, v in record.values.items() if k not in ("mode", "pitch")})
    assert set(build(fewer).inputs) == {"Q", "L"}


def test_the_sun_weakens_with_the_square_of_its_distance() -> None:
    data = copy.deepcopy(declared())
    data["loads"][0]["solar"] = True
    values = dict(samples().values)
    for day, distance_au in (("2024-01-03", 0.98331), ("2024-07-05", 1.01673)):  # perihelion and aphelion (USNO)
        epoch_ns = int(np.datetime64(day).astype("datetime64[s]").astype(np.int64)) * NS_PER_S
        factor = build(Record(TIME_S, values, epoch_ns), data=data).sun_factor
        np.testing.assert_allclose(factor, distance_au**-2.0, rtol=2e-4)


def test_a_solar_load_without_dates_is_refused() -> None:
    data = copy.deepcopy(declared())
    data["loads"][0]["solar"] = True
    with pytest.raises(TelemetryError, match="a solar load needs dates"):
        build(samples(), data=data)


def test_without_a_solar_load_the_sun_does_not_matter() -> None:
    np.testing.assert_array_equal(build(samples()).sun_factor, 1.0)


def test_terms_see_the_same_instant_in_records_of_other_epochs() -> None:
    zero = np.zeros((6, 1))
    own = build(samples()).along(zero, np.zeros((6, 2)), 0, 3)
    late = build(Record(TIME_S, samples().values, 1_767_225_600 * NS_PER_S)).along(zero, np.zeros((6, 2)), 0, 3)
    early = Record(TIME_S + 3600.0, samples().values, (1_767_225_600 - 3600) * NS_PER_S)
    np.testing.assert_array_equal(late.time_s, build(early).along(zero, np.zeros((6, 2)), 0, 3).time_s)
    np.testing.assert_allclose(late.time_s - own.time_s, 1_767_225_600.0, atol=1e-6)


@pytest.mark.parametrize(("dated", "message"), [(True, "counts seconds"), (False, "carries dates")])
def test_a_network_that_knows_instants_refuses_another_clock(dated: bool, message: str) -> None:
    network = replace(build_network(load_spec(declared())), dated=dated)
    own, other = None if dated else 0, 0 if dated else None
    with pytest.raises(TelemetryError, match=message):
        build_forcing(network, Record(TIME_S, samples().values, own), np.inf)
    assert build_forcing(network, Record(TIME_S, samples().values, other), np.inf).n_steps == 3
