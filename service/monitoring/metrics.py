"""Prometheus metrics of one application, in a registry of its own so that applications do not share numbers."""

import asyncio
from collections.abc import Iterable, Sequence

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    GCCollector,
    Histogram,
    PlatformCollector,
    ProcessCollector,
    generate_latest,
)

from service.store import fleet
from service.store.connection import Connection
from service.store.database import Database
from service.store.fleet import Glance

DATABASE_S = 3.0
"""A scrape waits no longer for the database: Prometheus itself gives up after 10 s unless told otherwise."""
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"


def _answers(connection: Connection) -> Sequence[Glance]:
    connection.execute("SELECT 1").fetchone()
    return ()


class Metrics:
    """What the service counts."""

    def __init__(self) -> None:
        """Create every metric at zero."""
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "twin_http_requests", "Requests answered.", ("method", "route", "status"), registry=self.registry
        )
        self.duration_s = Histogram(
            "twin_http_request_duration_seconds",
            "Time to answer, by route.",
            ("route",),
            registry=self.registry,
            buckets=(0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30),
        )
        self.samples = Counter(
            "twin_ingest_samples", "Samples by what became of them.", ("twin", "outcome"), registry=self.registry
        )
        self.backlog = Gauge("twin_store_backlog", "Operations that wait for the writer.", registry=self.registry)
        self.database_up = Gauge("twin_database_up", "Whether the database answers: 1 or 0.", registry=self.registry)
        self.readers = Gauge("twin_stream_readers", "Open streams.", registry=self.registry)
        self.dropped = Counter("twin_stream_dropped", "Messages that slow readers missed.", registry=self.registry)
        self.jobs = Counter("twin_jobs", "Jobs that ended.", ("kind", "state"), registry=self.registry)
        self.jobs_running = Gauge("twin_jobs_running", "Jobs that run now.", registry=self.registry)
        self.assimilated = Counter("twin_assimilated_samples", "Samples that updated a state.", registry=self.registry)
        self.skipped = Counter("twin_skipped_samples", "Samples that no state could take.", registry=self.registry)
        self.open_anomalies = Gauge(
            "twin_open_anomalies", "Anomalies that last still.", ("twin",), registry=self.registry
        )
        self.open_alarms = Gauge(
            "twin_open_alarms",
            "Limits that are exceeded, or forecast to be.",
            ("twin", "colour"),
            registry=self.registry,
        )
        self.last_sample_s = Gauge(
            "twin_last_sample_timestamp_seconds", "Unix time of the last sample.", ("twin",), registry=self.registry
        )
        for collector in (ProcessCollector, PlatformCollector, GCCollector):
            collector(registry=self.registry)

    async def look(self, database: Database, *, at_twins: bool = False) -> None:
        """Learn whether the database answers and, if wanted, how the twins are, which nobody knows while it does not."""
        self.backlog.set(database.backlog)
        seen: Sequence[Glance] = ()
        try:
            async with asyncio.timeout(DATABASE_S):
                seen = await database.read(fleet.glances if at_twins else _answers)
            self.database_up.set(1)
        except Exception as error:
            if not isinstance(error, TimeoutError) and not database.is_fault(error):
                raise
            self.database_up.set(0)
        self.show(seen)

    def show(self, twins: Iterable[Glance]) -> None:
        """Show the twins as they are now, and no longer those that are gone."""
        self.open_anomalies.clear()
        self.last_sample_s.clear()
        self.open_alarms.clear()
        for twin in twins:
            self.open_anomalies.labels(twin.name).set(twin.open_anomalies)
            self.open_alarms.labels(twin.name, "yellow").set(twin.yellow)
            self.open_alarms.labels(twin.name, "red").set(twin.red)
            if twin.last_us is not None:
                self.last_sample_s.labels(twin.name).set(twin.last_us / 1e6)

    def render(self) -> bytes:
        """Return everything in the text format of Prometheus."""
        return generate_latest(self.registry)
