"""What an operator's monitoring is told while the database is away, and by workers, which serve nobody else."""

import json
import re
from pathlib import Path
from typing import Any

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from service.http.problems import answer
from service.live.engine import WorkerDied
from service.store.errors import Unavailable
from tests.service.conftest import SPEC
from tests.service.fakes import GATE, FakeWorkbench
from tests.service.fleet.load import LOGGED, WORKER, calibrations, fleet, prepare
from tests.service.harness import until
from tests.service.postgres import own_server
from tests.service.server import FAKE

pytestmark = pytest.mark.fleet
Told = dict[tuple[str, str | None], float]


def parsed(text: str, label: str = "twin") -> Told:
    samples = (s for family in text_string_to_metric_families(text) for s in family.samples)
    return {(s.name, s.labels.get(label)): s.value for s in samples}


def test_without_its_database_a_service_still_tells_of_itself(make_client: Any) -> None:
    with own_server() as server:
        client = make_client(workbench=FakeWorkbench, database_url=server.url)
        client.post("/v1/twins", json=SPEC)
        found = parsed(client.get("/metrics").text)
        assert found["twin_database_up", None] == 1.0 and found["twin_open_anomalies", "benchsat"] == 0.0
        server.kill()
        scraped = client.get("/metrics")
        assert scraped.status_code == 200
        found = parsed(scraped.text)
        assert found["twin_database_up", None] == 0.0 and found["process_cpu_seconds_total", None] > 0
        assert ("twin_open_anomalies", "benchsat") not in found  # nobody knows whether that is true now
        for method, path in (
            ("GET", "/v1/twins/benchsat"),
            ("GET", "/readyz"),
            ("POST", "/v1/twins/benchsat/telemetry"),
        ):
            refused = client.request(method, path, json={"time": [1], "values": {"T_px": [290.0]}})
            assert refused.status_code == 503, refused.text
            assert int(refused.headers["retry-after"]) >= 1
        server.start()
        until(lambda: parsed(client.get("/metrics").text)["twin_database_up", None] == 1.0)


@pytest.mark.parametrize("error", [Unavailable("away"), WorkerDied("it died")])
def test_who_is_refused_for_now_hears_when_to_ask_again(error: Exception) -> None:
    refused = answer(error)
    assert refused.status_code == 503 and int(refused.headers["retry-after"]) >= 1


def test_a_worker_tells_of_its_jobs(tmp_path: Path, postgres: str, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare(postgres, 1, is_watched=False)
    gate = tmp_path / "gate"
    gate.touch()
    monkeypatch.setenv(GATE, str(gate))
    settings = {"metrics_port": "0", "log_level": "info", "job_workers": "0"}
    with fleet(tmp_path, [postgres] * 2, [LOGGED + WORKER, FAKE], **settings) as (worker, service):
        calibrations(service, 1)
        lines = [json.loads(line) for line in worker.log().splitlines()]
        url = next(line["url"] for line in lines if "url" in line)
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/metrics", url)

        def told(label: str = "twin") -> Told:
            return parsed(httpx.get(url, trust_env=False).text, label)

        until(lambda: told("state").get(("twin_jobs_total", "succeeded")) == 1.0)
        assert told()["twin_database_up", None] == 1.0
