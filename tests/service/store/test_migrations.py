"""A file of an earlier release is brought up to date where it stands."""

import contextlib
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import psycopg
import pytest

from service.store import jobs, schema
from service.store.database import Database
from service.store.postgres import migrations
from tests.service.conftest import SPEC

TWIN = "/v1/twins/benchsat"


@pytest.fixture
def old_file(tmp_path: Path) -> Path:
    """A file from before receive times, deletions and limits, with twenty samples in one chunk."""
    path = tmp_path / "twin.sqlite3"
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("CREATE TABLE migration (name TEXT PRIMARY KEY, at TEXT DEFAULT CURRENT_TIMESTAMP)")
    for name, script in schema.STEPS[: [name for name, _ in schema.STEPS].index("clocks")]:
        connection.executescript(script)
        connection.execute("INSERT INTO migration (name) VALUES (?)", (name,))
    text = orjson.dumps(SPEC).decode()
    connection.execute("INSERT INTO twin (name, specification, created_us) VALUES ('benchsat', ?, 0)", (text,))
    connection.execute("INSERT INTO head VALUES (1, 20, 20, 0, 19000000, 1, 20)")
    time_us, values = np.arange(20, dtype="<i8") * 1_000_000, np.full((3, 20), 290.0)
    values[1:] = 15.0
    connection.execute(
        "INSERT INTO chunk (twin, n, first_us, last_us, last_seq, seq, time, value) VALUES (1, 20, 0, 19000000, 20, ?, ?, ?)",
        (np.arange(1, 21, dtype="<i8").tobytes(), time_us.tobytes(), values.tobytes()),
    )
    connection.close()
    return path


def test_an_old_archive_is_read_written_deleted_and_compacted(old_file: Path, make_client: Any) -> None:
    client = make_client(database_url=f"sqlite:///{old_file}")
    detail = client.get(TWIN).json()
    assert (detail["samples"], detail["quarantined"], detail["telemetry"]["T_px"]["state"]) == (20, 0, "stale")
    made = client.request("DELETE", f"{TWIN}/telemetry", params={"start": 5, "stop": 8}).json()
    assert made["samples"] == 3
    client.post(f"{TWIN}/telemetry/deletions/{made['id']}/undo")
    for k in range(20, 120):  # enough small chunks to be compacted with those of before
        body = {"time": [k], "values": {"T_px": [290.0], "T_tank": [15.0], "Q_px": [15.0]}}
        assert client.post(f"{TWIN}/telemetry", json=body).json()["accepted"] == 1
    archive = client.get(f"{TWIN}/telemetry").json()
    assert archive["samples"] == len(set(archive["time"])) == 120
    assert archive["values"]["T_px"] == [290.0] * 120
    client.close()
    with sqlite3.connect(old_file) as connection:
        assert connection.execute("SELECT count(*) FROM chunk").fetchone()[0] < 64


def test_both_databases_have_the_same_columns(tmp_path: Path, postgres: str) -> None:
    """SQLite files lived through all steps, PostgreSQL began with the fleet and has tables of its own for it."""
    kinds = {"INTEGER": "whole", "bigint": "whole", "integer": "whole", "REAL": "real", "double precision": "real"}
    kinds |= {"TEXT": "text", "text": "text", "BLOB": "bytes", "bytea": "bytes"}
    path = tmp_path / "new.sqlite3"
    Database(path).close()
    with contextlib.closing(sqlite3.connect(path)) as file:
        ours = {
            (table, name.lower(), kinds[kind], bool(required or key))  # as PostgreSQL folds what is not quoted
            for (table,) in file.execute(
                "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'"
            )
            for _, name, kind, required, _, key in file.execute(f"PRAGMA table_info({table})")
            if table != "migration"
        }
    Database(postgres).close()
    query = """SELECT table_name, column_name, data_type, is_nullable = 'NO' FROM information_schema.columns
               WHERE table_schema = current_schema() AND table_name <> 'migration'
               AND table_name NOT IN (SELECT relname FROM pg_class WHERE relispartition)"""
    with psycopg.connect(postgres) as server:
        theirs = {(table, name, kinds[kind], required) for table, name, kind, required in server.execute(query)}
    of_fleet = {row for row in theirs if row[0] in ("member", "slot", "tenure") or row[:2] == ("head", "epoch")}
    assert of_fleet and ours == theirs - of_fleet


def test_an_old_server_goes_on_where_it_stood(postgres: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A job that an earlier release began is gone on with, under a number of its own."""
    with monkeypatch.context() as earlier:
        earlier.setattr(migrations, "STEPS", migrations.STEPS[:3])
        Database(postgres).close()
    with psycopg.connect(postgres, autocommit=True) as server:
        assert server.execute("SELECT name FROM migration ORDER BY 1").fetchall() == [
            ("base",),
            ("fleet",),
            ("vitals",),
        ]
        server.execute("INSERT INTO twin (name, specification, created_us) VALUES ('t', '{}', 0)")
        columns = "id, twin, kind, state, request, created_us, attempt"
        server.execute(f"INSERT INTO job ({columns}) VALUES ('j', 1, 'calibration', 'queued', '{{}}', 0, 2)")
    database = Database(postgres)
    held = database.submit(jobs.claim, "w", 1, is_shared=True).result(30)
    database.close()
    assert held is not None and (held.attempt, held.tries) == (3, 3)
