"""Moving a store to another database and back: nothing is lost, and secrets are told to nobody."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.store import appending, events, models, samples, twins
from service.store.batch import Batch
from service.store.connection import Connection
from service.store.database import Database
from service.store.errors import StoreError
from service.store.transfer import TABLES, transfer

SPEC: dict[str, Any] = {"twin": "t", "channels": {"a": {}, "b": {}}}


def fill(connection: Connection) -> None:
    twins.register(connection, "t", SPEC)
    generator = np.random.default_rng(1)
    for first in range(0, 3000, 600):
        values = generator.normal(size=(2, 600))
        values[0, 7] = np.nan
        appending.append(connection, 1, Batch(np.arange(first, first + 600) * 10**6, values, np.arange(600)))
    events.append(connection, 1, 5, [("job", {"text": "ä\n'quoted' ?%s"})])
    models.add(connection, 1, "manual", {"epoch_us": 0, "train": {}}, {"spec": SPEC})
    models.activate(connection, 1, 1, "requested")


def test_there_and_back_again(tmp_path: Path, postgres: str) -> None:
    first, last = tmp_path / "first.sqlite3", tmp_path / "last.sqlite3"
    database = Database(first)
    database.submit(fill).result()
    expected = database.engine.read(lambda c: samples.select(c, 1, 2, [0, 1]))
    database.close()
    there = transfer(first, postgres)
    assert {one.table: one.rows for one in there}["chunk"] == 5
    assert transfer(postgres, last) == there and [one.table for one in there] == list(TABLES)
    for place in (postgres, last):
        database = Database(place)
        found = database.engine.read(lambda c: samples.select(c, 1, 2, [0, 1]))
        np.testing.assert_array_equal(found.values, expected.values)
        made, is_new = database.submit(twins.register, "another", {**SPEC, "twin": "another"}).result()
        assert is_new and made.key == 2  # numbers go on behind what was copied
        database.close()
    with pytest.raises(StoreError, match="not empty"):
        transfer(first, postgres)


def test_a_password_is_never_told(tmp_path: Path) -> None:
    secret = "hunter2-x"
    for url in (
        f"postgresql://twin:{secret}@127.0.0.1:1/none",
        f"postgresql://127.0.0.1:1/none?user=twin&password={secret}",
        f"postgresql://twin:{secret}@127.0.0.1:{secret}/none",
        f"postgresql://twin:ab@{secret}@127.0.0.1:1/none",
        f"postgresql://twin:ab@{secret}#x@127.0.0.1:1/none",
    ):
        with pytest.raises(StoreError) as told:
            Database(url)
        assert secret not in str(told.value) and "TWIN_DATABASE_URL" in str(told.value)
