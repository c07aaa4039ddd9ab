"""Model versions: immutable, with their provenance, and the log of which one was active when."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import orjson

from service.instants import format_instant, now_us, parse_instant
from service.store.connection import Connection
from service.store.errors import Missing
from twin_core.telemetry import GAP_STEPS

MOST_SIBLINGS = 50
"""More of them tell hardly more of their family."""


@dataclass(frozen=True)
class ModelRow:
    """One version without its document."""

    version: int
    created_us: int
    source: str
    summary: str
    active: bool

    def wire(self) -> dict[str, Any]:
        """Return the version as clients see it."""
        return {
            "version": self.version,
            "active": self.active,
            "created": format_instant(self.created_us),
            "source": self.source,
            **orjson.loads(self.summary),
        }


@dataclass(frozen=True)
class Active:
    """The active model: its version and everything needed to run it."""

    version: int
    summary: dict[str, Any]
    document: str

    @property
    def epoch_us(self) -> int:
        """Where the model's time axis begins."""
        return int(self.summary["epoch_us"])

    @property
    def train_stop_us(self) -> int | None:
        """Last instant of the data that it was fitted to, if it says so."""
        stop = self.summary["train"].get("stop")
        return parse_instant(stop, "train.stop") if isinstance(stop, str) else None

    @cached_property
    def parsed_step_s(self) -> float:
        """Longest time step of its rollouts."""
        return float(self.parsed()["max_step_s"])

    @cached_property
    def specification(self) -> dict[str, Any]:
        """The specification that it was made from."""
        return dict(self.parsed()["spec"])

    @property
    def longest_gap_us(self) -> float:
        """Beyond a longer interval the assimilation starts anew."""
        return 1e6 * GAP_STEPS * self.parsed_step_s

    def parsed(self) -> dict[str, Any]:
        """Return the document as data."""
        return dict(orjson.loads(self.document))


_SELECT = """
    SELECT version, created_us, source, summary,
           version = (SELECT version FROM activation WHERE activation.twin = model.twin ORDER BY id DESC LIMIT 1)
    FROM model WHERE twin = ?
"""


def add(connection: Connection, twin: int, source: str, summary: dict[str, Any], document: dict[str, Any]) -> int:
    """Store a new version and return its number."""
    row = connection.execute("SELECT coalesce(max(version), 0) + 1 FROM model WHERE twin = ?", (twin,)).fetchone()
    connection.execute(
        "INSERT INTO model (twin, version, created_us, source, summary, document) VALUES (?, ?, ?, ?, ?, ?)",
        (twin, row[0], now_us(), source, orjson.dumps(summary).decode(), orjson.dumps(document).decode()),
    )
    return int(row[0])


def activate(connection: Connection, twin: int, version: int, reason: str) -> None:
    """Make a version the active one; Missing if there is none of that number."""
    get(connection, twin, version)
    connection.execute(
        "INSERT INTO activation (twin, version, at_us, reason) VALUES (?, ?, ?, ?)", (twin, version, now_us(), reason)
    )


def select(connection: Connection, twin: int) -> list[ModelRow]:
    """Return every version, the oldest first."""
    return [_row(row) for row in connection.execute(_SELECT + "ORDER BY version", (twin,))]


def get(connection: Connection, twin: int, version: int) -> ModelRow:
    """Return one version; Missing if there is none of that number."""
    row = connection.execute(_SELECT + "AND version = ?", (twin, version)).fetchone()
    if row is None:
        raise Missing(
            f"version: there is no model version {version}", [("version", f"there is no model version {version}")]
        )
    return _row(row)


def _row(row: tuple[Any, ...]) -> ModelRow:
    version, created_us, source, summary, active = row
    return ModelRow(version, created_us, source, summary, bool(active))


def document(connection: Connection, twin: int, version: int) -> dict[str, Any]:
    """Return the model itself; Missing if there is none of that number."""
    get(connection, twin, version)
    query = "SELECT document FROM model WHERE twin = ? AND version = ?"
    return dict(orjson.loads(connection.execute(query, (twin, version)).fetchone()[0]))


def activations(connection: Connection, twin: int) -> list[dict[str, Any]]:
    """Return the log of activations, the newest first."""
    query = "SELECT version, at_us, reason FROM activation WHERE twin = ? ORDER BY id DESC LIMIT 100"
    return [
        {"version": version, "time": format_instant(at_us), "reason": reason}
        for version, at_us, reason in connection.execute(query, (twin,))
    ]


def active(connection: Connection, twin: int) -> Active | None:
    """Return the active model, or None before the first activation."""
    row = connection.execute(
        """SELECT model.version, model.summary, model.document FROM activation
           JOIN model ON model.twin = activation.twin AND model.version = activation.version
           WHERE activation.twin = ? ORDER BY activation.id DESC LIMIT 1""",
        (twin,),
    ).fetchone()
    return None if row is None else Active(row[0], orjson.loads(row[1]), row[2])


def active_version(connection: Connection, twin: int) -> int | None:
    """Return the version of the active model, or None before the first activation."""
    query = "SELECT version FROM activation WHERE twin = ? ORDER BY id DESC LIMIT 1"
    row = connection.execute(query, (twin,)).fetchone()
    return None if row is None else int(row[0])


def first_us(connection: Connection, twin: int) -> int:
    """Return the first instant of a twin's archive, where the time axis of a new model begins; 0 if it is empty."""
    row = connection.execute("SELECT first_us FROM head WHERE twin = ?", (twin,)).fetchone()
    return int(row[0] or 0)


def siblings(connection: Connection, family: str, but: str) -> dict[str, dict[str, Any]]:
    """Return the active models of the other twins of a family, by the twin's name; at most ``MOST_SIBLINGS``, the newest."""
    query = """SELECT twin.name, twin.specification, model.document
               FROM twin JOIN activation ON activation.id = (SELECT max(id) FROM activation WHERE activation.twin = twin.id)
               JOIN model ON model.twin = twin.id AND model.version = activation.version
               WHERE twin.gone_us IS NULL AND twin.name <> ? AND twin.specification LIKE ? ORDER BY model.created_us DESC"""
    named = f'%"family":{orjson.dumps(family).decode()}%'  # few are parsed that are of another one
    found: dict[str, dict[str, Any]] = {}
    for name, specification, document in connection.execute(query, (but, named)):
        if len(found) < MOST_SIBLINGS and orjson.loads(specification).get("family") == family:
            found[name] = orjson.loads(document)
    return found
