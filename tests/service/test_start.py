"""What a start costs: no heavy import, neither for the server nor for its clients."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.service.server import Server

HEAVY = ("torch", "numba", "scipy", "pandas", "skfem", "sympy")


@pytest.mark.parametrize("module", ["service.server", "service.client", "replay.player", "replay.mcap_io"])
def test_nothing_heavy_is_imported(module: str) -> None:
    code = f"import sys, {module}; print([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("module", ["service.client", "replay.player", "replay.mcap_io"])
def test_clients_pull_in_no_server(module: str) -> None:
    code = f"import sys, {module}; print([m for m in ('fastapi', 'uvicorn', 'service.app') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_openapi_describes_every_answer(client) -> None:
    document = client.get("/openapi.json").json()
    assert document["openapi"].startswith("3.")
    body = document["paths"]["/v1/twins/{twin}/telemetry"]["post"]["requestBody"]["content"]
    assert set(body) == {"application/json", "application/x-ndjson"}
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            assert operation.get("summary"), (path, method)
    assert client.get("/docs").status_code == 200
    assert document["components"]["securitySchemes"]["key"]["scheme"] == "bearer"


def test_the_dashboard_is_served_whole(client) -> None:
    page = client.get("/")
    assert page.status_code == 200 and "default-src 'self'" in page.headers["content-security-policy"]
    for asset in ("style.css", "js/app.js", "js/network.js", "icon.svg", "uplot/uPlot.iife.min.js"):
        assert f"assets/{asset}" in page.text or asset.startswith("js/")
        assert client.get(f"/assets/{asset}").status_code == 200
    assert client.get("/assets/../app.py").status_code == 404
    assert "MIT" in client.get("/assets/uplot/LICENSE").text


@pytest.mark.e2e
def test_a_misspelt_setting_is_told(tmp_path: Path) -> None:
    with Server(tmp_path, job_worker="2", api_key="secret", log_level="warning") as server:
        lines = [json.loads(line) for line in server.log().splitlines()]
    assert [line["variable"] for line in lines] == ["TWIN_JOB_WORKER"] and lines[0]["level"] == "warning"
