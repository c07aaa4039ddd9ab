"""What tests with products of a control room share."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

from replay.bridges.config import YamcsConfig
from service.client import TwinClient
from tests.ground.yamcs import MISSING, Yamcs
from tests.service.conftest import SPEC
from tests.service.server import FAKE, Server

CONFIG = {
    "twin": "benchsat",
    "parameters": {"T_px": "/SAT/thermal/T_px", "T_tank": "/SAT/thermal/T_tank", "Q_px": "/SAT/eps/Q_px"},
    "backfill": {"start": "2026-01-01T00:00:00Z"},
}
LIMITED = {
    **SPEC,
    "channels": {**SPEC["channels"], "T_px": {**SPEC["channels"]["T_px"], "limits": {"red": [250, 320]}}},
}


def mission() -> str:
    """Return the XTCE of a mission: T_px in °C, with limits, T_tank in °C, Q_px in mW; a voltage."""
    from yamcs.pymdb import DataSource, FloatParameter, Subsystem, System, ThresholdAlarm

    system = System("SAT")
    thermal, eps = Subsystem(system, "thermal"), Subsystem(system, "eps")
    ranges = ThresholdAlarm(
        watch_high=35.0, warning_low=-10.0, warning_high=40.0, critical_low=-20.0, critical_high=50.0
    )
    ground = DataSource.GROUND
    FloatParameter(thermal, "T_px", bits=64, units="degC", alarm=ranges, data_source=ground)
    FloatParameter(thermal, "T_tank", bits=64, units="degC", data_source=ground)
    FloatParameter(eps, "Q_px", bits=64, units="mW", data_source=ground)
    FloatParameter(eps, "V_bus", bits=64, units="V", data_source=ground)
    FloatParameter(eps, "raw", bits=64, data_source=ground)
    return str(system.dumps())


@pytest.fixture
def config() -> YamcsConfig:
    return YamcsConfig.model_validate(CONFIG)


@pytest.fixture
def config_file(tmp_path: Path) -> Path:
    path = tmp_path / "bridge.yaml"
    path.write_text(yaml.safe_dump(CONFIG))
    return path


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Server]:
    """A service whose workbench answers at once, with the twin ``benchsat``."""
    folder = tmp_path / "service"
    folder.mkdir()
    with Server(folder, command=FAKE) as running:
        running.client().register(LIMITED)
        yield running


@pytest.fixture
def client(service: Server) -> TwinClient:
    return service.client()


@pytest.fixture
def make_yamcs(tmp_path: Path, client: TwinClient, config: YamcsConfig) -> Iterator[Callable[..., Yamcs]]:
    """Return a function that starts a server with the mission's database and that of the bridge."""
    if MISSING is not None:
        pytest.skip(MISSING)
    from replay.bridges.yamcs_mdb import write_xtce

    started: list[Yamcs] = []

    def make(*, guarded: bool = False) -> Yamcs:
        mdb = {"mission.xml": mission(), "twin.xml": write_xtce(config, client.twin("benchsat"))}
        started.append(Yamcs(tmp_path / f"yamcs{len(started)}", mdb, guarded=guarded))
        return started[-1].start()

    yield make
    for server in started:
        server.__exit__()


@pytest.fixture
def yamcs(make_yamcs: Callable[..., Yamcs]) -> Yamcs:
    return make_yamcs()
