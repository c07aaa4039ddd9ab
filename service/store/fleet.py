"""Every twin at a glance, by one look at the database however many there are."""

from collections import Counter
from dataclasses import dataclass
from typing import Any

import orjson

from service.instants import now_us
from service.store.anomalies import FAMILY
from service.store.connection import Connection

Json = dict[str, Any]


@dataclass(frozen=True)
class Vital:
    """The residual of a twin that stands out most at present, in K and in its predicted standard deviations."""

    time_us: int
    sensor: str
    residual_K: float
    deviations: float


@dataclass(frozen=True)
class Glance:
    """One twin: how far its archive reaches, which model follows it since when, and what is open.

    ``yellow`` and ``red`` count the open alarms, those of which ``yellow_ahead`` and ``red_ahead`` are forecast; ``ahead`` is
    what the one says that sets in first, None where none is open.
    """

    key: int
    name: str
    samples: int
    last_us: int | None
    version: int | None
    model_us: int | None
    open_anomalies: int
    yellow: int
    red: int
    yellow_ahead: int
    red_ahead: int
    vital: Vital | None
    ahead: Json | None


def note(connection: Connection, twin: int, version: int, vital: Vital | None) -> None:
    """Write down the worst of the newest residuals, unless a newer one of the same model is there."""
    if vital is None:
        return
    query = """INSERT INTO vital (twin, version, time_us, sensor, residual_K, deviations) VALUES (?, ?, ?, ?, ?, ?)
               ON CONFLICT (twin) DO UPDATE SET version = excluded.version, time_us = excluded.time_us,
               sensor = excluded.sensor, residual_K = excluded.residual_K, deviations = excluded.deviations
               WHERE excluded.time_us >= vital.time_us OR excluded.version <> vital.version"""
    connection.execute(query, (twin, version, vital.time_us, vital.sensor, vital.residual_K, vital.deviations))


def glances(connection: Connection) -> list[Glance]:
    """Return every twin, by name."""
    at_us = now_us()
    query = "SELECT twin, version, count(*) FROM anomaly WHERE stop_us IS NULL GROUP BY twin, version"
    anomalies = {(twin, version): n for twin, version, n in connection.execute(query)}
    alarms: dict[int, list[tuple[str, str, str, str]]] = {}
    query = """SELECT twin, origin, channel, colour, body FROM alarm
               WHERE stop_us IS NULL AND coalesce(shelved_until_us, 0) <= ? ORDER BY id"""
    for twin, *alarm in connection.execute(query, (at_us,)):
        alarms.setdefault(twin, []).append(tuple(alarm))  # type: ignore[arg-type]
    rows = connection.execute(
        """SELECT twin.id, twin.name, head.samples, head.last_us, model.version, model.created_us,
                  vital.time_us, vital.sensor, vital.residual_K, vital.deviations
           FROM twin JOIN head ON head.twin = twin.id
           LEFT JOIN (SELECT twin, max(id) AS id FROM activation GROUP BY twin) AS latest ON latest.twin = twin.id
           LEFT JOIN activation ON activation.id = latest.id
           LEFT JOIN model ON model.twin = activation.twin AND model.version = activation.version
           LEFT JOIN vital ON vital.twin = twin.id AND vital.version = model.version
           ORDER BY twin.name"""
    ).fetchall()
    found = []
    for key, name, samples, last_us, version, model_us, *vital in rows:
        own = alarms.get(key, [])
        of_colour = Counter(colour for _, _, colour, _ in own)
        ahead = Counter(colour for origin, _, colour, _ in own if origin == "forecast")
        counts = (of_colour["yellow"], of_colour["red"], ahead["yellow"], ahead["red"])
        worst = None if vital[0] is None else Vital(*vital)
        head = (key, name, samples, last_us, version, model_us)
        found.append(Glance(*head, anomalies.get((key, version), 0), *counts, worst, _first(own)))
    return found


def _first(alarms: list[tuple[str, str, str, str]]) -> Json | None:
    """Return the forecast alarm whose limit is expected to be reached first."""
    ahead = [
        {"channel": channel, "colour": colour} | orjson.loads(body)
        for origin, channel, colour, body in alarms
        if origin == "forecast"
    ]
    return min(ahead, key=lambda one: one.get("expected") or "9", default=None)


def marks(connection: Connection) -> dict[int, tuple[int, int]]:
    """Return of every twin the last number of its stream and how often stored samples of it were taken away."""
    return {twin: (seq, revision) for twin, seq, revision in connection.execute("SELECT twin, seq, revision FROM head")}


@dataclass(frozen=True)
class Duty:
    """What tells whether a twin is to be recalibrated: its samples, and the open anomalies of its active model."""

    samples: int
    open_ids: list[int]


def duties(connection: Connection) -> dict[int, Duty]:
    """Return the duty of every twin."""
    found = {twin: Duty(samples, []) for twin, samples in connection.execute("SELECT twin, samples FROM head")}
    query = """SELECT anomaly.twin, anomaly.id FROM anomaly
               WHERE stop_us IS NULL AND kind <> ? AND version = (SELECT version FROM activation
               WHERE activation.twin = anomaly.twin ORDER BY id DESC LIMIT 1) ORDER BY anomaly.id"""
    for twin, number in connection.execute(query, (FAMILY,)):
        if twin in found:
            found[twin].open_ids.append(number)
    return found
