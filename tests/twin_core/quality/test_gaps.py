"""A gap in which an input went its own way ends a segment; one in which it is known does not."""

import numpy as np
import pytest

from tests.helpers import conductive_spec, record_of
from twin_core._typing import FloatArray
from twin_core.calibrate import calibrate
from twin_core.closed_loop import close_loop
from twin_core.network.spec_io import load_spec
from twin_core.quality.gaps import cut_where_inputs_are_unknown
from twin_core.telemetry import LEAST_PART, Record

STEP_S, PERIOD = 60.0, 40
AT = np.arange(400)
SWITCHED = np.where(np.random.default_rng(1).random(40) < 0.5, 20.0, 0.0).repeat(10)
"""A heater that may change every ten samples: held for five of them, its value tells no more than half of its variance."""


def with_gap(begin: int, lasting: int, **channels: FloatArray | float) -> Record:
    whole = record_of(STEP_S * AT, **channels)
    return whole.take((begin > AT) | (begin + lasting <= AT))


@pytest.mark.parametrize(
    ("channel", "begin", "lasting", "n_parts"),
    [
        (SWITCHED, 150, 60, 2),
        (SWITCHED, 150, 9, 1),
        (SWITCHED, LEAST_PART, 60, 2),
        (SWITCHED, LEAST_PART - 1, 60, 1),
        (SWITCHED, 401 - LEAST_PART - 60, 60, 1),
        (np.full(400, 20.0), 150, 60, 1),
        (np.where(AT < 250, 20.0, 0.0), 150, 60, 1),
        (np.sin(2.0 * np.pi * AT / PERIOD), 150, PERIOD, 2),
        (np.sin(2.0 * np.pi * AT / 3000.0), 150, 60, 1),
        (np.where(AT < 100, np.nan, SWITCHED), 200, 60, 2),
        (np.full(400, np.nan), 150, 60, 1),
    ],
    ids=[
        "switched",
        "a few rows",
        "as short as a part may be",
        "too short a part before",
        "too short a part after",
        "constant",
        "switched once",
        "an orbit",
        "slow",
        "missing at first",
        "never there",
    ],
)
def test_a_record_is_cut_where_an_input_is_unknown(channel: FloatArray, begin: int, lasting: int, n_parts: int) -> None:
    record = with_gap(begin, lasting, Q=channel, T=290.0)
    parts = cut_where_inputs_are_unknown([record], {"Q", "elsewhere"})
    assert len(parts) == n_parts
    np.testing.assert_array_equal(np.concatenate([part.time_s for part in parts]), record.time_s)
    np.testing.assert_array_equal(np.concatenate([part.values["Q"] for part in parts]), record.values["Q"])
    assert [bool(part.notices) for part in parts] == [False, True][:n_parts]
    assert cut_where_inputs_are_unknown([record], set()) == [record]


def test_parts_are_told_where_they_begin() -> None:
    (_, part) = cut_where_inputs_are_unknown([with_gap(150, 60, Q=SWITCHED)], {"Q"})
    (notice,) = part.notices
    assert "8940.0 to 12600.0" in notice and "Q changes faster" in notice


def test_a_record_of_many_gaps_is_looked_at_once() -> None:
    """The variogram of an input is told once, not for each of its gaps."""
    at = np.arange(200_000)
    record = record_of(STEP_S * at, Q=np.where(at % 7 < 3, 20.0, 0.0)).take(at % 60 < 40)
    parts = cut_where_inputs_are_unknown([record], {"Q"})
    assert len(parts) == 3334 and sum(part.time_s.size for part in parts) == record.time_s.size


def heated(lasting: int) -> Record:
    """Return a node of 3000 J/K that loses 2 W/K to 280 K under a switched heater, without the rows of a gap."""
    decay, temperature_K = np.exp(-2.0 * STEP_S / 3000.0), np.empty(400)
    temperature_K[0] = 285.0
    for i in range(399):
        steady_K = 280.0 + SWITCHED[i] / 2.0
        temperature_K[i + 1] = steady_K + (temperature_K[i] - steady_K) * decay
    noise_K = np.random.default_rng(2).normal(0.0, 0.02, 400)
    return with_gap(150, lasting, T0=temperature_K + noise_K, Q=SWITCHED)


def test_a_heater_that_went_on_switching_in_a_gap_does_not_spoil_the_fit() -> None:
    """Held for an hour, its last value once made a capacity ten thousand times too large, and two wrong names."""
    spec = load_spec(
        conductive_spec(
            1,
            [],
            channels={"Q": {"kind": "power", "unit": "W"}},
            boundaries={"room": {"value_K": 280.0}},
            conductors=[{"between": ["n0", "room"], "conductance_W_per_K": {"guess": 1.0}}],
            loads=[{"channel": "Q", "node": "n0"}],
        )
    )
    model = calibrate(spec, [heated(63)])
    assert model.summary["train"]["segments"] == 2
    assert model.summary["rmse_K"] < 0.025
    assert any("segment of its own" in notice for notice in model.summary["notices"])
    report = close_loop(spec, [heated(63)]).report
    assert report["findings"] == [] and any("segment of its own" in notice for notice in report["notices"])
