"""Jobs: what was asked for, how far it got, what came of it."""

from dataclasses import dataclass
from typing import Any

import orjson

from service.instants import format_instant, now_us
from service.store.connection import Connection
from service.store.errors import LeaseLost, Missing, TwinGone

KEPT = 200
"""Jobs of one kind that are kept per twin; older ones are forgotten."""


@dataclass(frozen=True)
class JobRow:
    """One job."""

    id: str
    twin: int
    kind: str
    state: str
    progress: float
    message: str
    request: str
    created_us: int
    started_us: int | None
    finished_us: int | None
    result: str | None

    def wire(self) -> dict[str, Any]:
        """Return the job as clients see it."""
        return {
            "id": self.id,
            "kind": self.kind,
            "state": self.state,
            "progress": round(self.progress, 4),
            "message": self.message,
            "created": format_instant(self.created_us),
            "started": None if self.started_us is None else format_instant(self.started_us),
            "finished": None if self.finished_us is None else format_instant(self.finished_us),
            "result": None if self.result is None else orjson.loads(self.result),
        }


_SELECT = """SELECT id, twin, kind, state, progress, message, request, created_us, started_us, finished_us, result
             FROM job """


def create(connection: Connection, twin: int, job: str, kind: str, request: dict[str, Any]) -> JobRow:
    """Queue a job."""
    made = connection.execute(
        """INSERT INTO job (id, twin, kind, state, request, created_us, message)
           SELECT ?, id, ?, 'queued', ?, ?, ? FROM twin WHERE id = ? AND gone_us IS NULL""",
        (job, kind, orjson.dumps(request).decode(), now_us(), "waiting for a free worker", twin),
    )
    if made.rowcount == 0:
        raise TwinGone(f"twin {twin} is gone")
    connection.execute(
        """DELETE FROM job WHERE twin = ? AND kind = ? AND state NOT IN ('queued', 'running') AND number <=
           (SELECT max(number) FROM job) - ?""",
        (twin, kind, KEPT),
    )
    return get(connection, twin, kind, job)


def get(connection: Connection, twin: int, kind: str, job: str) -> JobRow:
    """Return one job; Missing if the twin has none of that id and kind."""
    row = connection.execute(_SELECT + "WHERE id = ? AND twin = ? AND kind = ?", (job, twin, kind)).fetchone()
    if row is None:
        raise Missing(f"no {kind} '{job}'")
    return JobRow(*row)


def select(connection: Connection, twin: int, kind: str) -> list[JobRow]:
    """Return the jobs of one kind, the newest first."""
    query = _SELECT + "WHERE twin = ? AND kind = ? ORDER BY number DESC"
    return [JobRow(*row) for row in connection.execute(query, (twin, kind))]


def asked_since_activation(connection: Connection, twin: int, kind: str) -> bool:
    """Return whether a job of one kind was asked for since the active model became that."""
    query = """SELECT EXISTS (SELECT 1 FROM job WHERE twin = ? AND kind = ? AND created_us >=
               (SELECT at_us FROM activation WHERE twin = ? ORDER BY id DESC LIMIT 1))"""
    return bool(connection.execute(query, (twin, kind, twin)).fetchone()[0])


def waiting(connection: Connection, twin: int) -> int:
    """Return how many jobs of a twin have not ended."""
    query = "SELECT count(*) FROM job WHERE twin = ? AND state IN ('queued', 'running')"
    return int(connection.execute(query, (twin,)).fetchone()[0])


@dataclass(frozen=True)
class Claim:
    """A job in the hands of a worker.

    Attributes
    ----------
    attempt
        The token without which nothing of it is written: greater than any before.
    tries
        How many workers had it, this one included, without those that gave it back.
    """

    job: str
    twin: int
    kind: str
    request: dict[str, Any]
    attempt: int
    tries: int


def claim(connection: Connection, worker: str, lease_us: int, *, is_shared: bool) -> Claim | None:
    """Take the oldest job that waits, or whose worker has not been heard of for ``lease_us``; None if there is none.

    Parameters
    ----------
    is_shared
        Whether others claim at the same time: each then passes over what another one is about to take.
    """
    row = connection.execute(
        f"""UPDATE job SET state = 'running', worker = ?, attempt = attempt + 1, beat_us = clock_us(), message = 'starting',
            started_us = coalesce(started_us, ?) WHERE number = (SELECT number FROM job WHERE state = 'queued'
            OR (state = 'running' AND worker != ? AND beat_us < clock_us() - ?)
            ORDER BY number LIMIT 1 {"FOR UPDATE SKIP LOCKED" if is_shared else ""})
            RETURNING id, twin, kind, request, attempt, attempt - returned""",
        (worker, now_us(), worker, lease_us),
    ).fetchone()
    if row is None:
        return None
    job, twin, kind, request, attempt, tries = row
    return Claim(job, twin, kind, orjson.loads(request), attempt, tries)


def beat(connection: Connection, worker: str) -> dict[str, tuple[int, bool]]:
    """Say that a worker lives; return what is in its hands: job -> (attempt, whether it shall be cancelled)."""
    query = "UPDATE job SET beat_us = clock_us() WHERE worker = ? AND state = 'running' RETURNING id, attempt, cancel"
    rows = connection.execute(query, (worker,)).fetchall()
    return {job: (attempt, bool(cancel)) for job, attempt, cancel in rows}


def ask_to_cancel(connection: Connection, job: str) -> None:
    """Let whoever does a job hear that it shall end."""
    connection.execute("UPDATE job SET cancel = 1 WHERE id = ? AND state = 'running'", (job,))


def hold(connection: Connection, held: Claim) -> None:
    """Make sure that a job is still in the same hands until the transaction ends; LeaseLost if it is not."""
    query = "UPDATE job SET beat_us = clock_us() WHERE id = ? AND attempt = ? AND state = 'running'"
    if connection.execute(query, (held.job, held.attempt)).rowcount == 0:
        raise LeaseLost(f"job {held.job} is in other hands, or has ended")


def report(connection: Connection, held: Claim, progress: float, message: str) -> None:
    """Note how far a running job is; progress never goes back. LeaseLost if it is in other hands."""
    hold(connection, held)
    connection.execute(
        "UPDATE job SET progress = CASE WHEN progress > ? THEN progress ELSE ? END, message = ? WHERE id = ?",
        (progress, progress, message, held.job),
    )


def end(connection: Connection, held: Claim, state: str, message: str) -> None:
    """End a job without a result; LeaseLost if it is in other hands."""
    hold(connection, held)
    finish(connection, held.job, state, message)


def put_back(connection: Connection, held: Claim) -> None:
    """Let a job wait for another worker; LeaseLost if it is in other hands already."""
    hold(connection, held)
    query = (
        "UPDATE job SET state = 'queued', message = 'waiting for a free worker', returned = returned + 1 WHERE id = ?"
    )
    connection.execute(query, (held.job,))


def finish_waiting(connection: Connection, job: str) -> None:
    """Cancel a job that nobody does yet."""
    query = """UPDATE job SET state = 'cancelled', message = 'cancelled', finished_us = ?
               WHERE id = ? AND state = 'queued'"""
    connection.execute(query, (now_us(), job))


def leave(connection: Connection, worker: str, *, is_shared: bool) -> None:
    """Let go of what a worker holds as it ends: others go on with it, or, where there are none, nothing waits any more."""
    if is_shared:
        query = "UPDATE job SET state = 'queued', returned = returned + 1 WHERE worker = ? AND state = 'running'"
        connection.execute(query, (worker,))
    else:
        query = """UPDATE job SET state = 'cancelled', message = 'cancelled', finished_us = ?
                   WHERE state IN ('queued', 'running')"""
        connection.execute(query, (now_us(),))


def finish(
    connection: Connection,
    job: str,
    state: str,
    message: str,
    result: dict[str, Any] | None = None,
    page: str | None = None,
) -> bool:
    """End a job; return False if it had ended already, which then stands."""
    text = None if result is None else orjson.dumps(result).decode()
    cursor = connection.execute(
        """UPDATE job SET state = ?, message = ?, result = ?, page = ?, finished_us = ?,
           progress = CASE WHEN ? = 'succeeded' THEN 1 ELSE progress END
           WHERE id = ? AND state IN ('queued', 'running')""",
        (state, message, text, page, now_us(), state, job),
    )
    return cursor.rowcount == 1


def page(connection: Connection, twin: int, kind: str, job: str) -> str | None:
    """Return the page that a job left."""
    get(connection, twin, kind, job)
    row = connection.execute("SELECT page FROM job WHERE id = ?", (job,)).fetchone()
    return None if row is None else row[0]


def fail_interrupted(connection: Connection) -> int:
    """Mark the jobs that a stopped service left behind as failed; return how many there were."""
    cursor = connection.execute(
        """UPDATE job SET state = 'failed', message = 'interrupted: the service stopped; start it again',
           finished_us = ? WHERE state IN ('queued', 'running')""",
        (now_us(),),
    )
    return cursor.rowcount
