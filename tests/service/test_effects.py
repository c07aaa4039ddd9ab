"""Effects of the user's own in the service: a model that holds one is activated and forecasts where its plug-in is given."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.louver import AREA_M2, PLUGIN, RANGE_K, SHUT_K, SPEC, telemetry
from tests.service.server import Server
from twin_core.effects import REGISTRY, load_effects
from twin_core.network.spec_io import load_spec

pytestmark = [pytest.mark.e2e, pytest.mark.usefixtures("plugins_forgotten")]
EPOCH_S = 1_772_323_200.0


def model() -> dict[str, Any]:
    """Return the model file of a louver."""
    from tests.helpers import model_of

    load_effects([PLUGIN])
    values = {"R_m2": AREA_M2, "T_shut_K": SHUT_K, "T_range_K": RANGE_K}
    louver = REGISTRY["louver"]({"node": "panel", "sink": "space"}, values)
    known = {"C:box": 6.0e3, "C:panel": 9.0e3, "G:box|panel": 4.0}
    return model_of(load_spec(SPEC), known, effects=[louver], std=0.01).to_json()


def fed(server: Server) -> Any:
    client = server.client()
    client.register(SPEC)
    columns = telemetry(60)
    times = (EPOCH_S + columns.pop("time_s")).tolist()
    client.ingest("louvered", times, {name: column.tolist() for name, column in columns.items()})
    return client


def test_a_model_with_an_effect_of_ones_own_forecasts(tmp_path: Path) -> None:
    with Server(tmp_path, effects=str(PLUGIN)) as server:
        client = fed(server)
        made = httpx.post(f"{server.url}/v1/twins/louvered/models", json=model(), timeout=60.0)
        assert made.status_code == 201, made.text
        active = client.activate("louvered", made.json()["version"])
        assert [effect["effect"] for effect in active.effects] == ["louver"]
        ahead = client.forecast("louvered", 600.0, step_s=60.0)
        assert 250.0 < ahead.values["T_panel"]["mean"][-1] < 320.0


def test_without_its_plugin_the_model_is_refused_and_says_which_to_give(tmp_path: Path) -> None:
    with Server(tmp_path) as server:
        fed(server)
        refused = httpx.post(f"{server.url}/v1/twins/louvered/models", json=model(), timeout=60.0)
    assert refused.status_code == 422
    assert "unknown effect 'louver', which comes from a plug-in; " in refused.text
    assert "TWIN_EFFECTS=louver.py" in refused.text


def test_a_plugin_that_is_wrong_stops_the_start(tmp_path: Path) -> None:
    broken = tmp_path / "broken.py"
    broken.write_text("import nowhere_to_be_found\n")
    command = [sys.executable, "-m", "service"]
    environment = {**os.environ, "TWIN_EFFECTS": str(broken), "TWIN_PORT": "0"}
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert (
        done.stderr
        == f"error: {broken}:1: ModuleNotFoundError: No module named 'nowhere_to_be_found'; correct the file\n"
    )
