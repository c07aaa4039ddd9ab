"""What an alarm asks of each twin: when its last sample was taken, and what is open."""

from dataclasses import dataclass

from service.instants import now_us
from service.store.connection import Connection


@dataclass(frozen=True)
class Vitals:
    """One twin at a glance; ``last_us`` is None while its archive is empty. Alarms that are shelved do not count."""

    twin: str
    last_us: int | None
    open_anomalies: int
    yellow: int
    red: int


def select(connection: Connection) -> list[Vitals]:
    """Return the vitals of every twin."""
    rows = connection.execute(
        """SELECT twin.name, head.last_us,
                  (SELECT count(*) FROM anomaly WHERE anomaly.twin = twin.id AND anomaly.stop_us IS NULL),
                  (SELECT count(*) FROM alarm WHERE colour = 'yellow' AND alarm.twin = twin.id AND stop_us IS NULL
                   AND coalesce(shelved_until_us, 0) <= ?),
                  (SELECT count(*) FROM alarm WHERE colour = 'red' AND alarm.twin = twin.id AND stop_us IS NULL
                   AND coalesce(shelved_until_us, 0) <= ?)
           FROM twin JOIN head ON head.twin = twin.id""",
        (now_us(), now_us()),
    )
    return [Vitals(*row) for row in rows]
