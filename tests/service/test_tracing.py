"""Traces: one per request, down to the filter that its samples wake; nothing of it where nobody asks."""

import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest

from service.monitoring import tracing
from tests.service.conftest import SPEC
from tests.service.fakes import FakeWorkbench
from tests.service.harness import AppClient

MODEL = {"spec": SPEC, "rmse_K": 1.0, "max_step_s": 60.0}


@pytest.fixture
def spans() -> Iterator[Any]:
    """Return what collects the spans of this test."""
    sdk = pytest.importorskip("opentelemetry.sdk.trace")
    export = pytest.importorskip("opentelemetry.sdk.trace.export")
    memory = pytest.importorskip("opentelemetry.sdk.trace.export.in_memory_span_exporter").InMemorySpanExporter()
    provider = sdk.TracerProvider()
    provider.add_span_processor(export.SimpleSpanProcessor(memory))
    tracing.use(provider)
    yield memory
    tracing.use(None)


def ingest(client: AppClient, first: int, headers: dict[str, str] | None = None) -> None:
    body = {"time": [60.0 * k for k in range(first, first + 5)], "values": {"T_px": [290.0] * 5}}
    assert client.post("/v1/twins/benchsat/telemetry", json=body, headers=headers).status_code == 200


def test_a_request_its_commit_and_the_filter_are_one_trace(make_client: Any, spans: Any) -> None:
    client = make_client(workbench=FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    client.post("/v1/twins/benchsat/models", json=MODEL)
    client.post("/v1/twins/benchsat/models/1/activate")
    spans.clear()
    trace, caller = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"  # the example of W3C Trace Context
    ingest(client, 0, {"traceparent": f"00-{trace}-{caller}-01"})
    until = time.monotonic() + 60.0
    while "filter" not in {span.name for span in spans.get_finished_spans()} and time.monotonic() < until:
        time.sleep(0.02)
    found = {span.name: span for span in spans.get_finished_spans()}
    request, store, filtered = (found[name] for name in ("POST /v1/twins/{twin}/telemetry", "store", "filter"))
    assert {f"{span.context.trace_id:032x}" for span in (request, store, filtered)} == {trace}
    assert f"{request.parent.span_id:016x}" == caller and request.kind.name == "SERVER"
    assert store.parent.span_id == request.context.span_id and filtered.parent.span_id == store.context.span_id
    assert request.start_time <= store.start_time <= store.end_time <= request.end_time
    assert dict(request.attributes) == {
        "http.request.method": "POST",
        "http.route": "/v1/twins/{twin}/telemetry",
        "http.response.status_code": 200,
    }
    assert dict(filtered.attributes)["thermal_twin.samples"] == 5 == dict(store.attributes)["thermal_twin.samples"]
    assert dict(filtered.attributes)["thermal_twin.model_version"] == 1


def test_the_next_request_is_a_trace_of_its_own(make_client: Any, spans: Any) -> None:
    client = make_client(workbench=FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    for first in (0, 5):
        ingest(client, first)
    assert client.get("/v1/twins/nobody").status_code == 404
    stores = [span for span in spans.get_finished_spans() if span.name == "store"]
    assert len({span.context.trace_id for span in stores}) == 2
    refused = next(s for s in spans.get_finished_spans() if s.attributes.get("http.response.status_code") == 404)
    assert refused.name == "GET /v1/twins/{twin}" and refused.status.status_code.name == "UNSET"


def test_nothing_is_imported_where_nobody_asks() -> None:
    """The service answers where OpenTelemetry's SDK cannot be imported, and does not try where it can."""
    code = (
        "import sys; from service.app import create_app; from service.monitoring import tracing\n"
        "with tracing.request('GET', []) as span, tracing.part('store', {}): tracing.remember(1)\n"
        "assert span is None and not any(m.startswith('opentelemetry.sdk') for m in sys.modules)\n"
        "sys.modules['opentelemetry.sdk'] = None\n"
        "from service.server import ServerError, serve; from service.settings import Settings\n"
        "try: serve(Settings(traces_url='http://127.0.0.1:4318/v1/traces'))\n"
        "except ServerError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "TWIN_TRACES_URL needs OpenTelemetry: pip install 'thermal-twin[traces]'\n"
