"""Jobs: what was asked for, how far it got, what came of it."""

from dataclasses import dataclass
from typing import Any

import orjson

from service.instants import format_instant, now_us
from service.store.connection import Connection
from service.store.errors import Missing, TwinGone

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


def begin(connection: Connection, job: str) -> None:
    """Mark a queued job as running."""
    query = "UPDATE job SET state = 'running', started_us = ?, message = 'starting' WHERE id = ? AND state = 'queued'"
    connection.execute(query, (now_us(), job))


def report(connection: Connection, job: str, progress: float, message: str) -> None:
    """Note how far a running job is; progress never goes back."""
    connection.execute(
        """UPDATE job SET progress = CASE WHEN progress > ? THEN progress ELSE ? END, message = ?
           WHERE id = ? AND state = 'running'""",
        (progress, progress, message, job),
    )


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
