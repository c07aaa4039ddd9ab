"""The archive against a dictionary, through many batches in any order, compaction included."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from service.store import appending, events, residuals, samples, segments, twins
from service.store.batch import Batch
from service.store.connection import Connection
from service.store.database import open_engine
from service.store.residuals import Residuals
from tests.service.postgres import STORES, place_of

SPEC = {"twin": "t", "channels": {"a": {}, "b": {}}}


@pytest.fixture(params=STORES)
def connection(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Connection]:
    engine = open_engine(place_of(request, tmp_path))
    session = engine.session()
    twins.register(session.connection, "t", SPEC)
    yield session.connection
    session.close()
    engine.close()


def test_many_batches_in_any_order(connection: Connection) -> None:
    generator = np.random.default_rng(0)
    order = generator.permutation(4000)
    position, numbers = 0, []
    while position < order.size:
        part = order[position : position + int(generator.integers(1, 80))]
        position += part.size
        batch = Batch(part.astype(np.int64) * 1000, np.stack([part * 1.0, -part * 1.0]))
        receipt = appending.append(connection, 1, batch)
        assert receipt.stored.all()
        numbers += range(receipt.first_seq, receipt.first_seq + part.size)
    assert numbers == list(range(1, 4001))
    found = samples.select(connection, 1, 2, [1])
    np.testing.assert_array_equal(found.time_us, np.arange(4000) * 1000)
    np.testing.assert_array_equal(found.values, -np.arange(4000.0)[None, :])
    part = samples.select(connection, 1, 2, [0, 1], 5000, 9000)
    assert part.values[0].tolist() == [5, 6, 7, 8]
    chunks = connection.execute("SELECT count(*) FROM chunk").fetchone()[0]
    assert chunks < segments.MOST_SMALL_CHUNKS + 40  # a chunk per batch would be about a hundred
    seqs, replayed = samples.since_seq(connection, 1, 2, 3990)
    assert seqs.tolist() == list(range(3991, 4001))
    assert replayed.time_us.tolist() == (order[-10:] * 1000).tolist()
    again = appending.append(connection, 1, Batch(found.time_us, np.stack([found.values[0] * -1, found.values[0]])))
    assert again.counts == [0, 4000, 0, 0]


def test_compaction_does_not_span_idle_time(connection: Connection) -> None:
    year_us = 365 * 86_400 * 10**6
    for number in range(segments.MOST_SMALL_CHUNKS):
        instant = (number % 2) * year_us + number * 10**6
        appending.append(connection, 1, Batch(np.array([instant]), np.zeros((2, 1))))
    spans = connection.execute("SELECT last_us - first_us FROM chunk").fetchall()
    assert len(spans) == 2 and max(spans)[0] < year_us // 1000


def test_numbers_are_shared_with_events(connection: Connection) -> None:
    one = Batch(np.array([5]), np.zeros((2, 1)))
    assert appending.append(connection, 1, one).first_seq == 1
    assert [e.seq for e in events.append(connection, 1, 0, [("job", {}), ("model", {})])] == [2, 3]
    assert appending.append(connection, 1, Batch(np.array([6]), np.zeros((2, 1)))).first_seq == 4


def test_blocks_cover_everything_once(connection: Connection) -> None:
    for start in range(0, 20_000, 1000):
        time_us = np.arange(start, start + 1000, dtype=np.int64)
        appending.append(connection, 1, Batch(time_us, np.zeros((2, 1000))))
    seen, position = 1, 0
    while True:
        stop = samples.block_stop(connection, 1, position, 5000)
        found = samples.select(connection, 1, 2, [0], position, stop)
        if found.time_us.size == 1:
            break
        assert found.time_us[0] == position
        seen += found.time_us.size - 1
        position = int(found.time_us[-1])
    assert seen == 20_000


def wave(first: int, count: int) -> Batch:
    """Return noise with one spike, so that every stretch has extremes of its own."""
    generator = np.random.default_rng(first)
    values = generator.normal(size=(2, count))
    values[0, count // 3], values[1, count // 2] = 50.0 + first / 1e6, -50.0 - first / 1e6
    return Batch((first + np.arange(count, dtype=np.int64)) * 1000, values)


def test_an_overview_holds_every_extreme(connection: Connection) -> None:
    for first in (0, 20_000, 40_000, 60_000):
        appending.append(connection, 1, wave(first, 15_000))
    late = Batch(np.array([62_000_500, 62_001_500]), np.array([[99.0, -99.0], [np.nan, 0.0]]))
    appending.append(connection, 1, late)
    for start, stop, rows in ((None, None, [0, 1]), (5_000_000, 72_000_000, [1]), (61_000_000, 64_000_000, [0])):
        whole = samples.select(connection, 1, 2, rows, start, stop)
        found, count = samples.overview(connection, 1, 2, rows, start, stop, 40)
        assert count == whole.time_us.size
        assert (np.diff(found.time_us) > 0).all()
        np.testing.assert_array_equal(np.nanmax(found.values, axis=1), np.nanmax(whole.values, axis=1))
        np.testing.assert_array_equal(np.nanmin(found.values, axis=1), np.nanmin(whole.values, axis=1))
        assert np.isin(found.time_us, whole.time_us).all()
        assert found.time_us[[0, -1]].tolist() == whole.time_us[[0, -1]].tolist()
    assert (
        samples.overview(connection, 1, 2, [0, 1], None, None, 40)[0].time_us.size < 60_000 / 3
    )  # the chunk that others overlap is read whole
    everything, count = samples.overview(connection, 1, 2, [0, 1], None, None, 100_000)
    assert everything.time_us.size == count == 60_002


def residual_stretch(first: int, count: int) -> Residuals:
    time_us = (first + np.arange(count, dtype=np.int64)) * 1000
    noise = np.random.default_rng(first).normal(size=(5, count))
    return Residuals(time_us // 1000 + 1, time_us, noise[:2], noise[2:4] ** 2, noise[4] ** 2, 1)


def test_residuals_one_by_one_are_gathered_and_outlined(connection: Connection) -> None:
    stretches = [residual_stretch(0, 5000), *(residual_stretch(5000 + k, 1) for k in range(700))]
    connection.execute("BEGIN")
    for stretch in stretches:
        residuals.append(connection, 1, stretch)
    connection.execute("COMMIT")
    assert connection.execute("SELECT count(*) FROM residual").fetchone()[0] < 80
    whole = residuals.select(connection, 1, 1, 2)
    np.testing.assert_array_equal(whole.time_us, np.arange(5700) * 1000)
    np.testing.assert_allclose(whole.nis, np.concatenate([s.nis for s in stretches]), rtol=1e-7)  # single precision
    found, count = residuals.overview(connection, 1, 1, 2, None, None, 20)
    assert count == 5700 and found.time_us.size < 1500
    assert found.nis.max() == whole.nis.max() and found.innovation_K.min() == whole.innovation_K.min()
    assert [s.seq[-1] for s in residuals.since_seq(connection, 1, 2, 5690)] and residuals.since_seq(
        connection, 1, 2, 5700
    ) == []
    residuals.forget(connection, 1, 1, 2, 5_100_000, 5_600_000)
    kept = residuals.select(connection, 1, 1, 2)
    np.testing.assert_array_equal(kept.time_us, [*range(0, 5_101_000, 1000), *range(5_600_000, 5_700_000, 1000)])
    residuals.forget(connection, 1, 1, 2, 5_100_000, 2**62)
    assert residuals.select(connection, 1, 1, 2).time_us.size == 5101


def test_what_came_since_is_read_newest_first_and_only_as_far_as_wanted(connection: Connection) -> None:
    """A million samples may have come since the last look, of which the newest dozen are wanted."""
    for k in range(5):
        time_us = 1000 * k + np.arange(600)
        appending.append(connection, 1, Batch(time_us, np.stack([time_us * 1.0, time_us * 1.0])))
    asked: list[int] = []

    def is_wanted(last_us: int) -> bool:
        asked.append(last_us)
        return len(asked) < 3

    found = samples.newest_first(connection, 1, 2, 600, is_wanted)
    assert [batch.time_us[0] for batch in found] == [4000, 3000]
    assert asked == [4599, 3599, 2599]
    everything = samples.newest_first(connection, 1, 2, 600, lambda _: True)
    assert [batch.time_us[0] for batch in everything] == [4000, 3000, 2000, 1000]
