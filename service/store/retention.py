"""What has had its day is removed, a little at a time, so that nobody waits for it: each operation here is a short write.

Every operation returns how many rows it removed; 0: there is nothing left to do.
"""

from dataclasses import asdict, dataclass

import orjson

from service.store import models, segments
from service.store.connection import Connection
from service.store.errors import Conflicting, Missing

ROWS = 8
"""So many chunks, of up to some megabytes each, are removed in one write."""
EVENTS = 20_000
"""Messages that are kept per twin: a reader that lags further behind is told to have missed them."""
_US_PER_DAY = 86_400_000_000


@dataclass(frozen=True)
class Retention:
    """How long what belongs to a twin is kept; None: for ever.

    Days count back from the twin's newest sample. ``models`` and ``jobs`` are numbers: of the newest versions beside the active
    one and its parent, and of ended jobs of each kind.
    """

    samples_days: float | None = None
    residuals_days: float | None = None
    models: int | None = None
    jobs: int | None = None

    @classmethod
    def of(cls, text: str) -> "Retention":
        """Return what a text from the store says."""
        return cls(**orjson.loads(text))

    @property
    def text(self) -> str:
        """The same for the store."""
        return orjson.dumps({name: value for name, value in asdict(self).items() if value is not None}).decode()

    def changes(self, former: "Retention") -> str:
        """Return what another one stands in for, such as ``samples_days 30 -> 1``."""
        pairs = ((name, was, asdict(self)[name]) for name, was in asdict(former).items())
        return (
            ", ".join(f"{name} {_said(was)} -> {_said(now)}" for name, was, now in pairs if was != now) or "as before"
        )


def _said(bound: float | None) -> str:
    return "all" if bound is None else f"{bound:g}"


def get(connection: Connection, twin: int) -> Retention:
    """Return the retention of a twin."""
    return Retention.of(connection.execute("SELECT retention FROM twin WHERE id = ?", (twin,)).fetchone()[0])


def put(connection: Connection, twin: int, retention: Retention) -> Retention:
    """Settle the retention of a twin; return the former one."""
    former = get(connection, twin)
    connection.execute("UPDATE twin SET retention = ? WHERE id = ?", (retention.text, twin))
    return former


def sweep_gone(connection: Connection) -> int:
    """Remove a part of a twin that was deleted; the twin itself goes last."""
    row = connection.execute("SELECT id FROM twin WHERE gone_us IS NOT NULL LIMIT 1").fetchone()
    if row is None:
        return 0
    for table, most in (("chunk", ROWS), ("residual", ROWS), ("aside", ROWS)):
        query = f"DELETE FROM {table} WHERE id IN (SELECT id FROM {table} WHERE twin = ? LIMIT ?)"
        removed = connection.execute(query, (row[0], most)).rowcount
        if removed:
            return removed
    for table, key in (("checkpoint", "time_us"), ("event", "seq")):
        query = f"DELETE FROM {table} WHERE twin = ? AND {key} IN (SELECT {key} FROM {table} WHERE twin = ? LIMIT 200)"
        removed = connection.execute(query, (row[0], row[0])).rowcount
        if removed:
            return removed
    connection.execute("DELETE FROM twin WHERE id = ?", row)
    connection.execute("DELETE FROM chunk WHERE twin = ?", row)  # what came while its head was waited for
    return 1


def due(connection: Connection) -> list[int]:
    """Return the twins of which ``sweep_old`` may find something to remove: a look that a reader can take."""
    query = """SELECT twin.id FROM twin JOIN head ON head.twin = twin.id WHERE twin.retention <> '{}'
               OR EXISTS (SELECT 1 FROM event WHERE event.twin = twin.id AND event.seq < head.seq - ?)
               OR EXISTS (SELECT 1 FROM residual WHERE residual.twin = twin.id AND residual.version <> coalesce(
                  (SELECT version FROM activation WHERE activation.twin = twin.id ORDER BY id DESC LIMIT 1), 0))
               ORDER BY twin.id"""
    return [twin for (twin,) in connection.execute(query, (EVENTS,))]


def sweep_old(connection: Connection, twin: int) -> int:
    """Remove a part of what a twin keeps no longer, and of the messages that nobody can resume from."""
    query = (
        """SELECT twin.retention, head.last_us, head.seq FROM twin JOIN head ON head.twin = twin.id WHERE twin.id = ?"""
    )
    row = connection.execute(query, (twin,)).fetchone()
    if row is None:
        return 0
    text, last_us, seq = row
    removed = connection.execute(
        """DELETE FROM event WHERE twin = ? AND seq IN
           (SELECT seq FROM event WHERE twin = ? AND seq < ? ORDER BY seq LIMIT 500)""",
        (twin, twin, seq - EVENTS),
    ).rowcount
    kept = Retention.of(text)
    if not removed and last_us is not None:
        removed = _old_samples(connection, twin, kept, last_us) or _old_residuals(connection, twin, kept, last_us)
    removed = removed or _old_jobs(connection, twin, kept) or _old_models(connection, twin, kept)
    return removed or _dear_residuals(connection, twin)


def _old_samples(connection: Connection, twin: int, kept: Retention, last_us: int) -> int:
    if kept.samples_days is None:
        return 0
    before_us = last_us - round(kept.samples_days * _US_PER_DAY)
    query = "SELECT id, first_us, n FROM chunk WHERE twin = ? AND last_us < ? ORDER BY last_us LIMIT ?"
    rows = connection.execute(query, (twin, before_us, ROWS)).fetchall()
    if rows:
        segments.remove(connection, [row[:2] for row in rows])
        connection.execute(
            """UPDATE head SET samples = CASE WHEN samples > ? THEN samples - ? ELSE 0 END,
               first_us = (SELECT min(first_us) FROM chunk WHERE chunk.twin = head.twin) WHERE twin = ?""",
            (*[sum(row[2] for row in rows)] * 2, twin),
        )
    return len(rows)


def _old_residuals(connection: Connection, twin: int, kept: Retention, last_us: int) -> int:
    days = min((d for d in (kept.samples_days, kept.residuals_days) if d is not None), default=None)
    if days is None:
        return 0
    before_us = last_us - round(days * _US_PER_DAY)
    query = "DELETE FROM residual WHERE id IN (SELECT id FROM residual WHERE twin = ? AND last_us < ? LIMIT ?)"
    removed = connection.execute(query, (twin, before_us, ROWS)).rowcount
    if not removed:
        query = """DELETE FROM checkpoint WHERE twin = ? AND (version, time_us) IN
                   (SELECT version, time_us FROM checkpoint WHERE twin = ? AND time_us < ? LIMIT 100)"""
        removed = connection.execute(query, (twin, twin, before_us)).rowcount
    return removed


def forget_derived(connection: Connection, twin: int) -> int:
    """Remove a part of what models derived from the archive of a twin, so that it is assimilated anew."""
    for table in ("checkpoint", "floor"):
        connection.execute(f"DELETE FROM {table} WHERE twin = ?", (twin,))
    query = "DELETE FROM residual WHERE id IN (SELECT id FROM residual WHERE twin = ? LIMIT ?)"
    return connection.execute(query, (twin, ROWS)).rowcount


def _old_jobs(connection: Connection, twin: int, kept: Retention) -> int:
    if kept.jobs is None:
        return 0
    removed = 0
    for kind in ("calibration", "diagnosis"):
        removed += connection.execute(
            """DELETE FROM job WHERE number IN (SELECT number FROM job WHERE twin = ? AND kind = ?
               AND state NOT IN ('queued', 'running') ORDER BY number DESC LIMIT 1000000 OFFSET ?)""",
            (twin, kind, kept.jobs),
        ).rowcount
    return removed


def _old_models(connection: Connection, twin: int, kept: Retention) -> int:
    """Remove one version that is neither active nor the parent of one that stays."""
    if kept.models is None:
        return 0
    query = "SELECT version, summary FROM model WHERE twin = ? ORDER BY version DESC"
    rows = [(version, _parent(text)) for version, text in connection.execute(query, (twin,))]
    active = models.active_version(connection, twin)
    stay = {active, *[version for version, _ in rows if version != active][: kept.models]}
    stay |= {parent for version, parent in rows if version in stay}
    gone = [version for version, _ in rows if version not in stay]
    if gone:
        remove_model(connection, twin, gone[-1])
    return len(gone[-1:])


def _parent(summary: str) -> int | None:
    found: int | None = orjson.loads(summary).get("provenance", {}).get("parent")
    return found


def remove_model(connection: Connection, twin: int, version: int) -> None:
    """Remove a version with all that was derived by it; its residuals go bit by bit, since their model is no more."""
    for table in ("checkpoint", "anomaly", "floor"):
        connection.execute(f"DELETE FROM {table} WHERE twin = ? AND version = ?", (twin, version))
    connection.execute("DELETE FROM model WHERE twin = ? AND version = ?", (twin, version))


def delete_model(connection: Connection, twin: int, version: int) -> None:
    """Remove a version; Missing if there is none, Conflicting if it is active."""
    if connection.execute("SELECT 1 FROM model WHERE twin = ? AND version = ?", (twin, version)).fetchone() is None:
        raise Missing(f"version: there is no model version {version}")
    if version == models.active_version(connection, twin):
        raise Conflicting(f"version {version} is active; activate another one first")
    remove_model(connection, twin, version)


def _dear_residuals(connection: Connection, twin: int) -> int:
    """Remove residuals whose model is gone; then, as long as residuals take more room than the archive, those of versions
    that are not active, the version first that was active longest ago."""
    orphaned = """DELETE FROM residual WHERE id IN (SELECT id FROM residual WHERE twin = ? AND version NOT IN
                  (SELECT version FROM model WHERE model.twin = residual.twin) LIMIT ?)"""
    removed = connection.execute(orphaned, (twin, ROWS)).rowcount
    if removed:
        return removed
    size = "SELECT coalesce(sum(length(value) + 8 * n), 0) FROM {} WHERE twin = ?"
    versions = connection.execute(
        "SELECT DISTINCT version FROM residual WHERE twin = ? AND version != ?",
        (twin, models.active_version(connection, twin) or 0),
    ).fetchall()
    if not versions or (
        connection.execute(size.format("residual"), (twin,)).fetchone()[0]
        <= connection.execute(size.format("chunk"), (twin,)).fetchone()[0]
    ):
        return 0
    lasts = dict(connection.execute("SELECT version, max(id) FROM activation WHERE twin = ? GROUP BY 1", (twin,)))
    oldest = min((version for (version,) in versions), key=lambda version: (lasts.get(version, 0), version))
    connection.execute("DELETE FROM checkpoint WHERE twin = ? AND version = ?", (twin, oldest))
    query = "DELETE FROM residual WHERE id IN (SELECT id FROM residual WHERE twin = ? AND version = ? LIMIT ?)"
    return connection.execute(query, (twin, oldest, ROWS)).rowcount
