"""The whole way: finite-element orbits with a hidden effect played into Yamcs, and what comes of it on the screens.

Nothing here is faked: a Yamcs server, the service with its own workbench, the bridge, and Open MCT in Chromium.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from replay.bridges.config import YamcsConfig
from tests.ground import openmct, yamcs
from tests.ground.test_yamcs import make_bridge, running, until
from tests.ground.yamcs import Yamcs
from tests.service.browser import Browser
from tests.service.server import Server

MISSING = yamcs.MISSING or openmct.MISSING
pytestmark = [
    pytest.mark.ground,
    pytest.mark.slow,
    pytest.mark.timeout(1500),
    pytest.mark.skipif(MISSING is not None, reason=MISSING or ""),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

ONSET = "2026-03-01T11:00:00Z"
HEALTHY = 600
"""Samples before the effect sets in that the twin is calibrated on."""


def orbits() -> tuple[dict[str, Any], Any]:
    """Return an operator's specification, and the record of orbits in which a payload loses most of its power."""
    from twin_core.fem.demo import demo_scenario
    from twin_core.fem.scenario import load_scenario
    from twin_core.fem.simulate import simulate
    from twin_core.network.spec_io import dump_spec

    scenario, spec = demo_scenario("none", 3)
    body = scenario.model_dump(mode="json", exclude_none=True)
    body["hidden"] = [{"effect": "input_step", "channel": "Q_box", "f": 0.3, "time": ONSET}]
    return dump_spec(spec), simulate(load_scenario(body)).record


def mission(spec: dict[str, Any]) -> str:
    """Return XTCE with one parameter per channel, in the units of the specification, temperatures in °C."""
    from yamcs.pymdb import DataSource, FloatParameter, System

    system = System("SAT")
    for name, channel in spec["channels"].items():
        units = "degC" if channel["kind"] == "temperature" else channel.get("unit")
        FloatParameter(system, name, bits=64, units=units, data_source=DataSource.GROUND)
    return str(system.dumps())


def play(server: Yamcs, spec: dict[str, Any], record: Any, first: int, stop: int) -> list[int]:
    """Play samples into Yamcs; return their generation times in milliseconds."""
    from replay.bridges.yamcs_gateway import Row, YamcsGateway

    epoch_ms = 1_772_323_200_000  # 2026-03-01, where the scenario begins
    begun = record.time_s[0]
    rows = []
    for k in range(first, stop):
        values = {name: float(column[k]) for name, column in record.values.items() if name in spec["channels"]}
        offset = {n: 273.15 if spec["channels"][n]["kind"] == "temperature" else 0.0 for n in values}
        time_ms = epoch_ms + round(1000 * (record.time_s[k] - begun))
        rows.append(Row(time_ms, {f"/SAT/{n}": v - offset[n] for n, v in values.items() if not np.isnan(v)}))
    with YamcsGateway(server.url, "sat") as gateway:
        for at in range(0, len(rows), 100):
            gateway.publish("pp_realtime", rows[at : at + 100])
    return [row.time_ms for row in rows]


def found_in(server: Yamcs, name: str) -> dict[int, float]:
    """Return a published parameter by generation time, each of which must be there once."""
    from replay.bridges.yamcs_gateway import YamcsGateway

    with YamcsGateway(server.url, "sat") as gateway:
        rows = list(gateway.history([f"/THERMAL_TWIN/demo/{name}"], 0, 4_000_000_000_000))
    found = {row.time_ms: float(value) for row in rows for value in row.values.values()}
    assert len(found) == sum(len(row.values) for row in rows)
    return found


def told(server: Yamcs) -> dict[str, Any]:
    """Return the events of the twin by type, the first of each."""
    from contextlib import closing

    from yamcs.client import YamcsClient

    with closing(YamcsClient(server.url)) as client:
        events = list(client.get_archive("sat").list_events(source="thermal-twin/demo"))
    return {event.event_type: event for event in reversed(events)}


def test_a_hidden_effect_is_seen_in_yamcs_and_in_open_mct(tmp_path: Path) -> None:
    from replay.bridges.yamcs_mdb import write_xtce

    spec, record = orbits()
    config = YamcsConfig.model_validate(
        {
            "twin": "demo",
            "parameters": {name: f"/SAT/{name}" for name in spec["channels"]},
            "backfill": {"start": "2026-01-01T00:00:00Z"},
        }
    )
    (tmp_path / "service").mkdir()
    with Server(tmp_path / "service") as service:
        client = service.client()
        client.register(spec)
        mdb = {"mission.xml": mission(spec), "twin.xml": write_xtce(config, client.twin("demo"))}
        with Yamcs(tmp_path / "yamcs", mdb) as server, running(make_bridge(config, server, service)):
            healthy = play(server, spec, record, 0, HEALTHY)
            until(lambda: client.twin("demo").samples == HEALTHY, "the service holds what was played")
            job = client.wait("demo", client.calibrate("demo"))
            assert job.state == "succeeded", job.message
            until(lambda: len(found_in(server, "T_box/residual")) == HEALTHY, "residuals are in Yamcs")
            assert "ANOMALY" not in told(server)

            rest = play(server, spec, record, HEALTHY, record.time_s.size)
            until(
                lambda: len(found_in(server, "T_box/residual")) == len(healthy) + len(rest), "all residuals are there"
            )
            until(lambda: "ANOMALY" in told(server), "the anomaly is told")
            job = client.wait("demo", client.diagnose("demo"))
            assert job.state == "succeeded", job.message
            until(lambda: "FINDING" in told(server), "the finding is told")

            residual, sigma = found_in(server, "T_box/residual"), found_in(server, "T_box/residual_sigma")
            assert list(residual) == [*healthy, *rest] == list(sigma)
            onset_ms = 1_772_362_800_000
            score = {t: residual[t] / sigma[t] for t in residual}
            before = np.array([s for t, s in score.items() if t < onset_ms])
            after = np.array([s for t, s in score.items() if onset_ms <= t < onset_ms + 3_600_000])
            assert np.sqrt(np.mean(before[20:] ** 2)) < 1.5 and np.sqrt(np.mean(after**2)) > 3.0

            expected, low, high = (found_in(server, f"T_box/{name}") for name in ("forecast", "q05", "q95"))
            assert max(expected) > rest[-1] + 3_000_000  # an hour ahead of the newest sample
            assert all(low[t] < expected[t] < high[t] for t in expected)

            anomaly, finding = told(server)["ANOMALY"], told(server)["FINDING"]
            assert anomaly.severity == "WARNING" and anomaly.generation_time.timestamp() * 1000 >= onset_ms
            assert "input_step at channel Q_box" in finding.message
            link = finding.extra["link"]
            assert link == f"{service.url}/v1/twins/demo/diagnoses/{job.id}/report.html"
            assert "input_step" in client.report_html("demo", job)
            look(tmp_path, service, client, residual)


def look(folder: Path, service: Server, client: Any, residual: dict[int, float]) -> None:
    """Find the same in Open MCT on the screen; ``residual`` is what stands in Yamcs of T_box, by generation time."""
    with openmct.served(service.url, folder) as url, Browser(folder / "profile", 1500, 1000) as page:
        page.open(f"{url}/?start=2026-03-01T00:00:00Z&stop=2026-03-02T00:00:00Z")
        page.until("document.querySelector('.c-tree')")
        page.evaluate("void openmct.time.setBounds({start: 1772323200000, end: 1772409600000})")
        for name in ("Thermal twins", "demo"):
            page.click(f'[aria-label^="Expand {name} "]')
        page.click('.c-tree [aria-label^="Navigate to T_box "]')
        for name in ("T_box measured K", "T_box forecast K", "T_box forecast, 95 % K"):
            page.until(f"document.body.innerText.includes({json.dumps(name)})")
        ask = (
            "(async () => (await openmct.telemetry.request(await openmct.objects.get("
            "{namespace: 'thermal-twin', key: '%s~demo~T_box'}), "
            "{start: %d, end: %d, domain: 'utc'})).length)()"
        )
        span = (1_772_323_200_000, 1_772_409_600_000)
        assert page.evaluate(ask % ("measured", *span)) == client.twin("demo").samples
        assert page.evaluate(ask % ("forecast", *span)) > 10
        page.click('.c-tree [aria-label^="Navigate to Anomalies "]')
        sensors = {found.sensor for found in client.anomalies("demo")}
        page.until(f"{json.dumps(sorted(sensors))}.some((name) => document.body.innerText.includes(name + ' departs'))")
        page.until("document.body.innerText.includes('2026-03-01 11:')")
        page.click('.c-tree [aria-label^="Navigate to T_box residual "]')
        page.until("document.querySelector('.gl-plot-chart-area canvas')")
        read = (
            "(async () => (await openmct.telemetry.request(await openmct.objects.get("
            "{namespace: 'thermal-twin', key: 'residual~demo~T_box'}), "
            "{start: %d, end: %d, domain: 'utc'})).map((datum) => [datum.time, datum.residual]))()"
        )
        assert dict(map(tuple, page.evaluate(read % span))) == pytest.approx(residual)
        page.evaluate("void openmct.time.setBounds({start: Date.now() - 3600000, end: Date.now() + 60000})")
        page.click('.c-tree [aria-label^="Navigate to Findings "]')
        page.until("document.body.innerText.includes('input_step at channel Q_box')")
        assert page.troubles == []
