"""Decoys have the spectrum of their originals and nothing else, and the bound is what the binomial law says."""

import numpy as np
import pytest
from scipy.stats import binom

from benchmarks.decoys import (
    PREFIX,
    candidates,
    decoys_named,
    tasks_of,
    twin_of,
    upper_bound,
    with_decoys,
)
from benchmarks.loop_cases import Task
from benchmarks.measured_splits import Prepared


@pytest.mark.parametrize("n", [400, 401])
def test_phases_are_random_and_the_spectrum_stays(n: int) -> None:
    rng = np.random.default_rng(0)
    column = np.cumsum(rng.normal(size=n))
    twin = twin_of(column, rng, levels=False)
    np.testing.assert_allclose(np.abs(np.fft.rfft(twin)), np.abs(np.fft.rfft(column)), rtol=1e-6, atol=1e-6)
    assert (twin.mean(), twin.std()) == pytest.approx((column.mean(), column.std()))
    assert abs(np.corrcoef(np.diff(twin), np.diff(column))[0, 1]) < 0.2


def test_a_switch_stays_a_switch() -> None:
    rng = np.random.default_rng(1)
    column = np.repeat(rng.choice([0.0, 1.0, 2.0], 20), 25)
    column[::7] = np.nan
    twin = twin_of(column, rng, levels=True)
    held = column.copy()
    for k in np.flatnonzero(np.isnan(held)):
        held[k] = held[k - 1] if k else column[1]
    shifts = [k for k in range(held.size) if np.array_equal(np.roll(held, k), twin)]
    assert shifts and 50 <= shifts[0] <= 450


def test_every_driving_channel_has_a_twin_and_the_record_stays_as_it_was() -> None:
    case = Task("clean", None, 7003).build()
    plain = Prepared(case.spec, [case.record], holdout=0.3)
    names = candidates(case.spec, plain.records)
    assert {"mode", "T_room"} < set(names) and not set(names) & set(case.spec.sensors)
    widened = with_decoys(plain, 3)
    assert {n for n in widened.spec.channels if n.startswith(PREFIX)} == {PREFIX + n for n in names}
    for name, column in case.record.values.items():
        assert widened.records[0].values[name] is column
    again = with_decoys(plain, 3)
    assert np.array_equal(again.records[0].values[f"{PREFIX}mode"], widened.records[0].values[f"{PREFIX}mode"])


def test_a_named_decoy_is_counted() -> None:
    findings = [
        {"effect": "constant_heat_load", "where": {"node": "a"}},
        {"effect": "channel_heat_load", "where": {"node": "a", "channel": f"{PREFIX}mode"}},
    ]
    assert decoys_named(findings) == [f"channel_heat_load({PREFIX}mode)"]


@pytest.mark.parametrize(("k", "n"), [(0, 300), (3, 300), (1, 9)])
def test_the_bound_is_the_share_at_which_so_few_are_seen_once_in_twenty(k: int, n: int) -> None:
    assert binom.cdf(k, n, upper_bound(k, n)) == pytest.approx(0.05)
    assert upper_bound(n, n) == 1.0


def test_the_suite_has_as_many_tasks_as_asked_for() -> None:
    tasks = tasks_of(["clean", "network"], 30, 7000)
    assert [sum(t.group == g for t in tasks) for g in ("clean", "network")] == [30, 30]
    assert len({t.name for t in tasks}) == 60
