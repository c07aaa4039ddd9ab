"""The operator's guide, carried out: its requests and its Python run against a real server."""

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.client import TwinClient
from tests.service.harness import AppClient
from tests.service.server import Server

DOCS = Path(__file__).parents[2] / "docs"
GUIDE = (DOCS / "operating.md").read_text()


def requests() -> list[tuple[str, str, Any]]:
    """Return method, path and body of every curl line of the guide, in their order."""
    found = []
    for block in re.findall(r"^```sh\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL):
        for text in re.split(r"^(?=curl|deletion=\$\(curl)", block, flags=re.MULTILINE)[1:]:
            path = re.search(r"http://127\.0\.0\.1:8000([^\s']+)", text)
            body = re.search(r"-d '(.*?)'", text, re.DOTALL)
            assert path is not None
            named = re.search(r"-s?X ([A-Z]+)", text)
            method = named[1] if named else "POST" if body else "GET"
            found.append((method, path[1], json.loads(body[1]) if body else None))
    return found


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with Server(tmp_path) as running:
        yield running


def test_the_guide_takes_out_what_it_sent(client: AppClient) -> None:
    sent = requests()
    past = re.findall(r"^```python\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)[0]
    names: dict[str, Any] = {}
    exec(compile(past.partition("with TwinClient")[0].partition("\n\n")[2], "operating.md", "exec"), names)
    assert client.post("/v1/twins", json=sent[0][2]).status_code == 201
    times = [names["begin_s"] + 60 * minute for minute in range(600)]
    client.post("/v1/twins/pair/telemetry", json={"time": times, "values": names["values"]})
    method, path, _ = next(request for request in sent if request[0] == "DELETE")
    assert client.request(method, path).json()["samples"] == 60
    now = next(body for _, path, body in sent if path.endswith("/telemetry"))["values"]
    for name in ("T_a", "T_b"):  # what arrives next goes on where the simulation ended
        assert abs(now[name][0] - names["values"][name][-1]) < 0.3


def finish(client: TwinClient) -> None:
    """Wait for every calibration."""
    while not all(job["finished"] for job in client._http.get("/v1/twins/pair/calibrations").json()["jobs"]):
        time.sleep(0.1)


@pytest.mark.e2e
@pytest.mark.long
def test_the_guide_runs(server: Server, capsys: pytest.CaptureFixture[str]) -> None:
    sent = requests()
    assert len(sent) >= 9 and sent[0][1] == "/v1/twins"
    past, program = re.findall(r"^```python\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)
    client = server.client()
    taken_out = None
    for number, (method, path, body) in enumerate(sent):
        if number == 1:
            exec(compile(past.replace("http://127.0.0.1:8000", server.url), "operating.md", "exec"), {})
        if path.endswith("/activate"):
            finish(client)
        if path.endswith("/events"):
            assert next(client.events("pair", after_seq=0)).seq >= 1
            continue
        path = path.replace("$deletion", str(taken_out))
        response = client._http.request(method, path, json=body)
        while "Retry-After" in response.headers:  # on a busy machine there is no state yet
            response = client._http.request(method, path, json=body)
        assert response.is_success, (path, response.text)
        if method == "DELETE":
            taken_out = response.json()["id"]
    names = {"specification": sent[0][2]}
    exec(compile(program.replace("http://127.0.0.1:8000", server.url), "operating.md", "exec"), names)
    printed = capsys.readouterr().out
    assert "version 2 is" in printed and " K" in printed
    assert all(anomaly.stop is not None for anomaly in client.anomalies("pair"))
    assert client.models("pair")[0].validation["rmse_K"] < 0.1


def test_every_metric_of_the_manual_exists(client: AppClient) -> None:
    client.get("/healthz")
    text = client.get("/metrics").text
    named = set(re.findall(r"`?\b(twin_[a-z_]+?)(?:_total)?\b[`{\[ ]", GUIDE + (DOCS / "deployment.md").read_text()))
    assert len(named) >= 4
    for name in named:
        assert f"# TYPE {name}" in text or f"# TYPE {name}_total" in text, name
