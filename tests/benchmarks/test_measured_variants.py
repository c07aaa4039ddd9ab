"""Variants of measured sets: each change leaves a declaration and a record, or is left out; what came of them is counted."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from benchmarks.measured_run import Result
from benchmarks.measured_splits import Prepared, Split, example
from benchmarks.measured_variants import CHANGES, Brought, table, variant
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
        told, given = variant(seed, [split], tmp_path)
        again, _ = variant(seed, [split], tmp_path)
        assert told == again
        assert told.startswith("set: record, ")
        assert given.holdout is not None and 0.2 <= given.holdout <= 0.6
        assert given.spec.sensors
        assert 60 <= given.records[0].time_s.size <= 1000


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
