"""Merging against a plain dictionary that takes samples one by one."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.store.merge import ACCEPTED, CONFLICT, DUPLICATE, collapse, merge

N_CHANNELS = 3
value = st.sampled_from([np.nan, 0.0, 1.0, 2.0])
sample = st.tuples(st.integers(0, 5), st.lists(value, min_size=N_CHANNELS, max_size=N_CHANNELS))


def one_by_one(known: dict[int, list[float]], samples: list[tuple[int, list[float]]]) -> list[int]:
    """The rule as it is told to clients: the first value stays."""
    fates = []
    for instant, row in samples:
        here = known.get(instant)
        if here is None:
            known[instant] = list(row)
            fates.append(ACCEPTED)
            continue
        pairs = list(zip(here, row, strict=True))
        if any(a == a and b == b and a != b for a, b in pairs):
            fates.append(CONFLICT)
        elif any(a != a and b == b for a, b in pairs):
            known[instant] = [b if a != a else a for a, b in pairs]
            fates.append(ACCEPTED)
        else:
            fates.append(DUPLICATE)
    return fates


def arrays(samples: list[tuple[int, list[float]]]) -> tuple[np.ndarray, np.ndarray]:
    values = np.array([row for _, row in samples], dtype=float).reshape(-1, N_CHANNELS).T
    return np.array([instant for instant, _ in samples], dtype=np.int64), values


@settings(max_examples=300, deadline=None)
@given(st.lists(sample, max_size=4), st.lists(sample, min_size=1, max_size=25))
def test_same_fates_as_one_by_one(before: list, arriving: list) -> None:
    known: dict[int, list[float]] = {}
    one_by_one(known, before)
    stored = arrays(list(known.items()))
    n_before = len(known)
    fates = one_by_one(known, arriving)
    time_us, values = arrays(arriving)
    merged = merge(*stored, time_us, values)
    assert merged.status.tolist() == fates
    assert merged.n_instants == len(known) - n_before
    kept = merged.status == ACCEPTED
    final = collapse(np.concatenate([stored[0], time_us[kept]]), np.concatenate([stored[1], values[:, kept]], axis=1))
    assert final[0].tolist() == sorted(known)
    np.testing.assert_array_equal(final[1].T, np.array([known[t] for t in sorted(known)]).reshape(-1, N_CHANNELS))


@pytest.mark.parametrize("repeats", [1, 50_000])
def test_one_instant_many_times_is_quick_and_right(repeats: int) -> None:
    time_us, values = np.zeros(repeats, dtype=np.int64), np.ones((1, repeats))
    merged = merge(np.empty(0, dtype=np.int64), np.empty((1, 0)), time_us, values)
    assert (merged.status == ACCEPTED).sum() == 1
    assert (merged.status == DUPLICATE).sum() == repeats - 1
