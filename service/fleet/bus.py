"""The bus of a fleet: one thread with one connection that renews leases, passes hints on, hears them, and looks for changes.

A hint says that something of some twins changed. It is sent after the commit, and only makes others look earlier: all of them
look every ``LOOK_S`` at what the database says, and everything is right if every hint is lost.
"""

import logging
import os
import socket
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from typing import Any

import psycopg

from service.fleet.ownership import BEAT_S, Leases
from service.instants import keep_to
from service.store import ownership
from service.store.ownership import LEASE_S, Changed
from service.store.postgres.engine import Speaking, connect

log = logging.getLogger("service.fleet")

CHANNEL = "thermal_twin"
LOOK_S = 1.0
TURN_S = 0.05
"""So often hints are passed on, and leases and looks are thought of."""
RETRY_S = 0.5
MOST_HINTED = 500
"""A hint names at most so many twins: a notification holds 8000 bytes."""


Heard = Callable[[Sequence[Changed], bool], None]


def _unheard(changed: Sequence[Changed], whole: bool) -> None:
    """Hear nothing."""


class Bus:
    """Keeps this process in touch with the others."""

    def __init__(self, url: str, leases: Leases, beat: bool = True) -> None:
        """Begin later; without ``beat`` the process owns no twins."""
        self.name = f"{socket.gethostname()}:{os.getpid()}:{uuid.uuid4().hex[:6]}"
        self._url, self._leases, self._beat = url, leases, beat
        self._heard: Heard = _unheard
        self._hints: set[int] = set()
        self._hinted: set[int] = set()
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="bus", daemon=True)

    def start(self, heard: Heard) -> None:
        """Begin; ``heard`` is called in the bus's thread with changes, and whether those are of all twins."""
        self._heard = heard
        self._thread.start()

    def hint(self, twin: int) -> None:
        """Let others know soon that something of a twin was committed; from any thread, never waits."""
        with self._lock:
            self._hints.add(twin)

    def close(self) -> None:
        """Leave the fleet."""
        self._stop.set()
        self._thread.join(10.0)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                with connect(self._url) as driver:
                    driver.execute(f"LISTEN {CHANNEL}")  # type: ignore[call-overload]
                    self._attend(driver)
            except Exception as error:  # the next attempt may be a better one; leases lapse meanwhile
                if not self._stop.is_set():
                    log.warning("out of touch with the database", extra={"reason": type(error).__name__})
                self._stop.wait(RETRY_S)

    def _attend(self, driver: "psycopg.Connection[Any]") -> None:
        """Take turns until the end, or until the connection fails."""
        connection = Speaking(driver)
        ownership.attend(connection)
        beat_s = look_s = 0.0
        while not self._stop.is_set():
            if self._beat and time.monotonic() >= beat_s:
                beat_s = time.monotonic() + BEAT_S
                self._renew(driver, connection)
                look_s = 0.0 if self._leases.changed() else look_s
            if time.monotonic() >= look_s:
                look_s = time.monotonic() + LOOK_S
                self._hinted.clear()
                self._heard(ownership.changes(connection), True)
            self._pass_on(connection)
            for note in driver.notifies(timeout=TURN_S, stop_after=1):
                sender, _, twins = note.payload.partition("|")
                if sender != self.name:
                    self._hinted.update(int(twin) for twin in twins.split(",") if twin)
            if self._hinted:
                twins_now, self._hinted = sorted(self._hinted), set()
                self._heard(ownership.changes(connection, twins_now), False)
        if self._beat:
            with driver.transaction():
                ownership.give_back(connection, self.name)

    def _renew(self, driver: "psycopg.Connection[Any]", connection: Speaking) -> None:
        asked_s, asked_ns = time.monotonic(), time.time_ns()
        with driver.transaction():
            holding = ownership.renew(connection, self.name, round(1e6 * LEASE_S))
        if holding.clock_us is not None:
            keep_to(holding.clock_us, asked_ns, time.time_ns())
        self._leases.hold(holding, asked_s)

    def _pass_on(self, connection: Speaking) -> None:
        with self._lock:
            hints, self._hints = sorted(self._hints), set()
        for first in range(0, len(hints), MOST_HINTED):
            named = ",".join(map(str, hints[first : first + MOST_HINTED]))
            connection.execute("SELECT pg_notify(?, ?)", (CHANNEL, f"{self.name}|{named}"))
