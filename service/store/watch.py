"""What an alarm asks of each twin: when its last sample was taken, and how many anomalies are open."""

import sqlite3
from dataclasses import dataclass


@dataclass(frozen=True)
class Vitals:
    """One twin at a glance; ``last_us`` is None while its archive is empty."""

    twin: str
    last_us: int | None
    open_anomalies: int


def select(connection: sqlite3.Connection) -> list[Vitals]:
    """Return the vitals of every twin."""
    rows = connection.execute(
        """SELECT twin.name, head.last_us,
                  (SELECT count(*) FROM anomaly WHERE anomaly.twin = twin.id AND anomaly.stop_us IS NULL)
           FROM twin JOIN head ON head.twin = twin.id"""
    )
    return [Vitals(*row) for row in rows]
