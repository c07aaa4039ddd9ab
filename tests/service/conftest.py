"""A service in memory's place: one temporary file per test, driven through its real routes."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from service.app import create_app
from service.settings import read_settings
from tests.service.harness import AppClient

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

MakeClient = Callable[..., AppClient]


@pytest.fixture
def spec() -> dict[str, Any]:
    return dict(SPEC)


@pytest.fixture
def make_client(tmp_path: Path) -> Iterator[MakeClient]:
    """Return a function that starts a service on the test's database; all are stopped at the end."""
    opened: list[AppClient] = []

    def make(workbench: Any = None, **settings: Any) -> AppClient:
        url = f"sqlite:///{tmp_path / 'twin.sqlite3'}"
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
