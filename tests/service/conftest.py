"""A service in memory's place: one temporary file per test, driven through its real routes."""

import contextlib
import os
import sqlite3
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import psycopg
import pytest

from service.app import create_app
from service.live import engine, forecasts
from service.settings import read_settings
from tests.service.harness import AppClient
from tests.service.postgres import NoPostgres, fresh_database, own_server

SPEC: dict[str, Any] = {
    "twin": "benchsat",
    "boundaries": {"space": {"value_K": 2.7}},
    "channels": {
        "T_px": {"kind": "temperature", "unit": "K", "noise_std": 0.1},
        "T_tank": {"kind": "temperature", "unit": "degC"},
        "Q_px": {"kind": "power", "unit": "W"},
    },
    "nodes": [
        {"id": "px", "sensor": "T_px", "capacity_J_per_K": {"guess": 4e5}},
        {"id": "tank", "sensor": "T_tank", "capacity_J_per_K": {"value": 9e4}},
    ],
    "conductors": [{"between": ["px", "tank"], "conductance_W_per_K": {"guess": 5.0}}],
    "radiators": [{"node": "px", "emissivity": 0.8, "area_m2": 2.0, "sink": "space"}],
    "loads": [{"channel": "Q_px", "node": "px"}],
}

STORE, NAMED = (os.environ.get(name) for name in ("TWIN_TEST_STORE", "TWIN_TEST_POSTGRES_URL"))
"""Read before tests empty the environment of what is the service's."""
SETTLE_S = 60.0
"""What is asked for is waited for as long: on a busy machine a worker process takes more than ten seconds to start."""
MakeClient = Callable[..., AppClient]
Sql = Callable[[str], list[tuple[Any, ...]]]


@pytest.fixture
def spec() -> dict[str, Any]:
    return dict(SPEC)


class StandingWorkers:
    """Worker processes that outlive the services of single tests: each takes a second to start."""

    def __init__(self, workers: int) -> None:
        """Start nothing yet."""
        self._workers = workers
        self._environment: dict[str, str] = {}
        self._pool: ProcessPoolExecutor | None = None

    def submit(self, function: Callable[..., Any], *args: Any) -> Future[Any]:
        """Run a function in one of them; those that died, or know another environment, are replaced."""
        environment = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}
        if environment != self._environment:
            self.end()
            self._environment = environment
        try:
            self._pool = self._pool or START(self._workers)
            return self._pool.submit(function, *args)
        except BrokenProcessPool:
            self._pool = None
            raise

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Stay: a service ends."""

    def end(self) -> None:
        """End the processes."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None


START = engine._start


@pytest.fixture(scope="session")
def standing_workers() -> Iterator[StandingWorkers]:
    workers = StandingWorkers(engine.WORKERS)
    yield workers
    workers.end()


@pytest.fixture(scope="session")
def postgres_url() -> Iterator[str]:
    """A PostgreSQL server: the one that is named, or one of our own."""
    if NAMED:
        yield NAMED
        return
    with contextlib.ExitStack() as stack:
        try:
            server = stack.enter_context(own_server())
        except NoPostgres as reason:
            if STORE == "postgres":  # who asks for it wants to know
                raise
            pytest.skip(str(reason))
        yield server.url


@pytest.fixture
def postgres(postgres_url: str) -> Iterator[str]:
    """An empty PostgreSQL database."""
    with fresh_database(postgres_url) as url:
        yield url


@pytest.fixture
def database_url(tmp_path: Path, request: pytest.FixtureRequest) -> str:
    """An empty database: a SQLite file, or PostgreSQL where ``TWIN_TEST_STORE`` says so."""
    if STORE == "postgres":
        return str(request.getfixturevalue("postgres"))
    return f"sqlite:///{tmp_path / 'twin.sqlite3'}"


@pytest.fixture
def sql(database_url: str) -> Sql:
    """Return what asks the test's database past the service, one transaction for each statement."""

    def ask(statement: str) -> list[tuple[Any, ...]]:
        if not database_url.startswith("sqlite"):
            with psycopg.connect(database_url, autocommit=True) as connection:
                cursor = connection.execute(statement)  # type: ignore[call-overload]
                return cursor.fetchall() if cursor.description else []
        path = database_url.removeprefix("sqlite:///")
        with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as connection:
            return connection.execute(statement).fetchall()

    return ask


@pytest.fixture
def make_client(
    database_url: str, monkeypatch: pytest.MonkeyPatch, standing_workers: StandingWorkers
) -> Iterator[MakeClient]:
    """Return a function that starts a service on the test's database; all are stopped at the end."""
    monkeypatch.setattr(engine, "_start", lambda workers: START(1) if workers == 1 else standing_workers)
    monkeypatch.setattr(forecasts, "SETTLE_S", SETTLE_S)
    opened: list[AppClient] = []

    def make(workbench: Any = None, **settings: Any) -> AppClient:
        url = database_url
        client = AppClient(create_app(read_settings(**{"database_url": url, **settings}), workbench=workbench))
        opened.append(client)
        return client

    yield make
    for client in opened:
        client.close()


@pytest.fixture
def client(make_client: MakeClient) -> AppClient:
    return make_client()


@pytest.fixture
def registered(client: AppClient) -> AppClient:
    """A service that knows the twin ``benchsat``."""
    assert client.post("/v1/twins", json=SPEC).status_code == 201
    return client
