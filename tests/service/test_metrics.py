"""What a scrape tells of each twin and of the process, so that alarms need nothing else."""

import os

import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.service.conftest import SPEC
from tests.service.fakes import FakeWorkbench
from tests.service.harness import AppClient


def scrape(client: AppClient) -> dict[tuple[str, str | None], float]:
    families = text_string_to_metric_families(client.get("/metrics").text)
    return {(s.name, s.labels.get("twin")): s.value for family in families for s in family.samples}


@pytest.fixture
def client(make_client) -> AppClient:
    client = make_client(workbench=FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    return client


def test_last_sample_and_open_anomalies_of_each_twin(client: AppClient) -> None:
    client.post("/v1/twins", json={**SPEC, "twin": "silent"})
    last, anomalies = "twin_last_sample_timestamp_seconds", "twin_open_anomalies"
    found = scrape(client)
    assert (last, "benchsat") not in found and found[anomalies, "benchsat"] == found[anomalies, "silent"] == 0.0

    model = {"spec": SPEC, "rmse_K": 1.0, "max_step_s": 60.0}
    assert client.post("/v1/twins/benchsat/models", json=model).status_code == 201
    client.post("/v1/twins/benchsat/models/1/activate")
    times = [60.0 * k for k in range(300)]
    jumps = [290.0 + 0.001 * k + (40.0 * (k % 2) if k >= 200 else 0.0) for k in range(300)]
    client.post("/v1/twins/benchsat/telemetry", json={"time": times, "values": {"T_px": jumps}})
    client.get("/v1/twins/benchsat/residuals")  # waits for the assimilation
    listed = client.get("/v1/twins/benchsat/anomalies").json()["anomalies"]
    found = scrape(client)
    assert found[last, "benchsat"] == 60.0 * 299
    assert found[anomalies, "benchsat"] == sum(anomaly["stop"] is None for anomaly in listed) > 0
    assert found[anomalies, "silent"] == 0.0

    client.delete("/v1/twins/benchsat")
    found = scrape(client)
    assert (last, "benchsat") not in found and (anomalies, "benchsat") not in found


def test_the_process_is_measured(client: AppClient) -> None:
    found = scrape(client)
    page = os.sysconf("SC_PAGE_SIZE")
    with open("/proc/self/statm") as file:
        resident = int(file.read().split()[1]) * page
    assert found["process_resident_memory_bytes", None] == pytest.approx(resident, rel=0.2)
    assert found["process_open_fds", None] > 0 and found["process_cpu_seconds_total", None] > 0
    assert ("python_info", None) in found and ("python_gc_collections_total", None) in found
