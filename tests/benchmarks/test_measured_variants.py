"""Variants of measured sets: each change leaves a declaration and a record, or is left out; what came of them is counted."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from benchmarks.measured_run import Result
from benchmarks.measured_splits import Prepared, Split, example
from benchmarks.measured_variants import CHANGES, GUESS_DECADES, Brought, holes, table, variant, wrong_guesses
from twin_core.network.spec_io import dump_spec
from twin_core.telemetry import Record

EXAMPLES = ("three-block", "tclab", "daisy", "flexhouse", "dutch-home", "chandra-psmc")


def a_record(name: str) -> Record:
    time_s = 60.0 * np.arange(1000)
    values = {channel: 280.0 + np.sin(time_s / 900.0) for channel in example(name).channels}
    return Record(time_s, values, name="a/record.csv")


@pytest.mark.parametrize("name", EXAMPLES)
@pytest.mark.parametrize("change", [change for _, change in CHANGES], ids=lambda change: change.__name__)
def test_a_change_says_what_it_did(name: str, change: Callable[[np.random.Generator, Brought], str]) -> None:
    before, record = dump_spec(example(name)), a_record(name)
    own = Brought(dump_spec(example(name)), record)
    words = change(np.random.default_rng(3), own)
    assert bool(words) == (own.spec != before or own.record is not record)


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_variant_is_drawn_by_its_seed_and_is_a_declaration(name: str, tmp_path: Path) -> None:
    split = Split(
        name, "set", lambda folder: Prepared(example(name), [a_record(name)], holdout=0.3), lambda folder: "none"
    )
    for seed in range(20):
        told, given = variant(seed, split, tmp_path)
        words, again = variant(seed, split, tmp_path)
        assert told == words and told.startswith("set: record, ")
        assert given.spec == again.spec and given.holdout == again.holdout
        (record,), (same,) = given.records, again.records
        np.testing.assert_array_equal(record.time_s, same.time_s)
        for channel, column in record.values.items():
            np.testing.assert_array_equal(column, same.values[channel])
        assert given.holdout is not None and 0.2 <= given.holdout <= 0.6
        assert given.spec.sensors
        assert 60 <= record.time_s.size <= 1000


def test_one_reading_in_twenty_is_lost_and_guesses_stay_within_their_decades() -> None:
    own = Brought(dump_spec(example("three-block")), a_record("three-block"))
    holes(np.random.default_rng(0), own)
    lost = np.mean([np.isnan(own.record.values[sensor]).mean() for sensor in example("three-block").sensors])
    assert lost == pytest.approx(0.05, abs=0.02)
    wrong_guesses(np.random.default_rng(0), own)
    before = dump_spec(example("three-block"))
    ratios = [
        node["capacity_J_per_K"]["guess"] / given["capacity_J_per_K"]["guess"]
        for node, given in zip(own.spec["nodes"], before["nodes"], strict=True)
    ]
    assert all(10.0**-GUESS_DECADES <= ratio <= 10.0**GUESS_DECADES for ratio in ratios)
    assert len(set(ratios)) == len(ratios)


def test_a_table_counts_what_came_of_it() -> None:
    results = {
        1: Result("set: a", "c", 60.0, error="TelemetryError: nothing can be scored", seconds=1.0),
        2: Result("set: b", "c", 60.0, error="LinAlgError", seconds=1.0),
        3: Result("set: c", "c", 60.0, error="no answer after 120 s: ended", hung=True, seconds=120.0),
        4: Result("set: d", "c", 60.0, verdict="effect_added", before_K=1.0, after_K=1.2, seconds=9.0),
        5: Result("set: e", "c", 60.0, verdict="unexplained", before_K=1.0, after_K=1.0, seconds=9.0),
    }
    told = table(results)
    for what in ("crashed", "hung", "refused in one line", "a finding", "worse after"):
        assert f"| {what} | 1 of 5 |" in told
    assert "**1.200**" in told
