"""Open MCT with the plug-in, as an operator uses it: real Chromium, real service, clicks, and a service that restarts."""

import json
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.client import TwinClient
from tests.ground.openmct import MISSING, NODE, PLUGIN, served
from tests.service.browser import Browser
from tests.service.server import Server

pytestmark = [
    pytest.mark.ground,
    pytest.mark.browser,
    pytest.mark.skipif(MISSING is not None, reason=MISSING or ""),
]

STEP_S = 10.0


@pytest.fixture
def begun_s() -> float:
    """When the telemetry of a test begins: half an hour ago, for the page shows what surrounds now."""
    return float(int(time.time()) - 1800)


def send(client: TwinClient, begun_s: float, first: int, stop: int) -> None:
    ks = range(first, stop)
    leaps = [290.0 + 0.001 * k + (9.0 * (k % 2) if 50 <= k < 70 else 0.0) for k in ks]
    values = {"T_px": leaps, "T_tank": [15.0] * len(ks), "Q_px": [0.5] * len(ks)}
    client.ingest("benchsat", [begun_s + STEP_S * k for k in ks], values)


@pytest.fixture
def page(service: Server, client: TwinClient, begun_s: float, tmp_path: Path) -> Iterator[Browser]:
    """Open MCT in Chromium, beside a twin that is calibrated and has had an anomaly."""
    send(client, begun_s, 0, 150)
    client.wait("benchsat", client.calibrate("benchsat"))
    for _ in range(300):
        if client.anomalies("benchsat"):
            break
        time.sleep(0.1)
    with served(service.url, tmp_path) as url, Browser(tmp_path / "profile", 1500, 1000) as browser:
        browser.open(url)
        yield browser


def expand(page: Browser, name: str) -> None:
    """Open a folder of the tree."""
    page.click(f'[aria-label^="Expand {name} "]')


def go(page: Browser, name: str) -> None:
    """Click on an object in the tree."""
    page.click(f'.c-tree [aria-label^="Navigate to {name} "]')


ASK = """(async () => {
  const object = await openmct.objects.get({namespace: 'thermal-twin', key: %s});
  const data = await openmct.telemetry.request(object, %s);
  return data;
})()"""


def ask(page: Browser, key: str, **options: Any) -> list[dict[str, Any]]:
    """Return what Open MCT itself gets of an object."""
    found: list[dict[str, Any]] = page.evaluate(ASK % (json.dumps(key), json.dumps({"domain": "utc", **options})))
    return found


def test_an_operator_finds_everything_on_the_screen(page: Browser, client: TwinClient, begun_s: float) -> None:
    expand(page, "Thermal twins")
    expand(page, "benchsat")
    go(page, "T_px")
    page.until("document.body.innerText.includes('T_px forecast, 95 % K')")
    page.until("document.querySelectorAll('.gl-plot-chart-area canvas').length >= 2")
    page.until("/\\n298\\n/.test(document.body.innerText)")  # the axis spans the leaps, which reach 299 K
    go(page, "Anomalies")
    (anomaly, *_) = client.anomalies("benchsat")
    page.until(f"document.body.innerText.includes({json.dumps(anomaly.message)})")
    page.until(f"document.body.innerText.includes({json.dumps(anomaly.start[:19].replace('T', ' '))})")
    go(page, "T_px residual")
    page.until(
        "document.body.innerText.includes('T_px residual') && document.querySelector('.gl-plot-chart-area canvas')"
    )
    assert page.troubles == []


def test_requests_are_answered_from_the_archive(page: Browser, client: TwinClient, begun_s: float) -> None:
    span = {"start": 1000.0 * begun_s, "end": 1000.0 * (begun_s + 5400.0)}
    held = client.archive("benchsat")
    whole = ask(page, "measured~benchsat~T_px", **span)
    assert [datum["value"] for datum in whole] == held.values["T_px"]
    assert [datum["time"] for datum in whole] == [1000.0 * (begun_s + STEP_S * k) for k in range(150)]
    thin = ask(page, "measured~benchsat~T_px", strategy="minmax", size=20, **span)
    assert len(thin) <= 40
    values = [datum["value"] for datum in whole]
    assert {min(values), max(values)} <= {datum["value"] for datum in thin}  # extremes survive
    (latest,) = ask(page, "measured~benchsat~T_px", strategy="latest", size=1, **span)
    assert latest == whole[-1]
    (earlier,) = ask(page, "measured~benchsat~T_px", strategy="latest", **{**span, "end": span["start"] + 95_000.0})
    assert earlier["value"] == whole[9]["value"]
    residuals = client.residuals("benchsat").model_dump()
    found = ask(page, "residual~benchsat~T_px", **span)
    assert [datum["residual"] for datum in found] == residuals["residual_K"]["T_px"]
    assert [datum["sigma"] for datum in found] == residuals["std_K"]["T_px"]
    low, mean, high = (ask(page, f"{kind}~benchsat~T_px", **span) for kind in ("low", "forecast", "high"))
    assert (
        len(mean) >= 100
        and mean[0]["time"] > whole[-1]["time"]
        and mean[-1]["time"] == pytest.approx(span["end"], abs=1.0)
    )
    assert all(a["value"] < b["value"] < c["value"] for a, b, c in zip(low, mean, high, strict=True))
    assert ask(page, "measured~benchsat~T_px", start=0.0, end=1000.0) == []


def test_limits_are_evaluated(page: Browser) -> None:
    """The twin's red limits are 250 and 320 K."""
    judged = page.evaluate(
        """(async () => {
          const object = await openmct.objects.get({namespace: 'thermal-twin', key: 'measured~benchsat~T_px'});
          const evaluator = openmct.telemetry.limitEvaluator(object);
          await new Promise((resolve) => setTimeout(resolve, 1000));
          const meta = openmct.telemetry.getMetadata(object).value('value');
          const limits = await openmct.telemetry.limitDefinition(object).limits();
          return [[249, 260, 321].map((value) => evaluator.evaluate({value}, meta)?.name ?? null), limits.CRITICAL];
        })()"""
    )
    assert judged[0] == ["red low", None, "red high"]
    assert judged[1] == {"low": {"color": "red", "value": 250}, "high": {"color": "red", "value": 320}}


def test_what_is_live_goes_on_where_it_broke_off(
    page: Browser, service: Server, client: TwinClient, begun_s: float
) -> None:
    page.evaluate(
        """(async () => {
          const object = await openmct.objects.get({namespace: 'thermal-twin', key: 'measured~benchsat~T_tank'});
          window.heard = [];
          openmct.telemetry.subscribe(object, (datum) => window.heard.push(datum.time));
        })()"""
    )
    time.sleep(1.0)  # the socket opens
    send(client, begun_s, 150, 155)
    page.until("window.heard.length === 5")
    service._environment["TWIN_PORT"] = service.url.rsplit(":", 1)[1]
    service.kill()
    service.start()
    again = service.client()
    send(again, begun_s, 155, 165)  # most likely before the page has found its way back
    page.until("window.heard.length >= 15")
    assert page.evaluate("window.heard") == [1000.0 * (begun_s + STEP_S * k) for k in range(150, 165)]


def test_the_key_stays_with_the_server_and_nobody_writes_through_it(service: Server, tmp_path: Path) -> None:
    guarded = tmp_path / "guarded"
    guarded.mkdir()
    with (
        Server(guarded, api_keys="read:r-key,operate:o-key") as other,
        served(other.url, tmp_path, key="r-key") as url,
        httpx.Client(base_url=url, trust_env=False) as http,
    ):
        assert http.get("/twin/v1/twins").json() == {"twins": []}
        assert "r-key" not in http.get("/").text + http.get("/plugin/index.js").text
        assert http.post("/twin/v1/twins", json={}).status_code == 405
        assert http.get("/plugin/../../../pyproject.toml").status_code == 404
        assert http.get("/plugin/%2e%2e/%2e%2e/%2e%2e/pyproject.toml").status_code == 404
        upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Origin": "http://elsewhere.example"}
        assert http.get("/twin/v1/twins/x/stream", headers=upgrade).status_code == 403


def test_it_packs(tmp_path: Path) -> None:
    assert NODE is not None
    made = subprocess.run(
        ["npm", "pack", "--json", "--pack-destination", str(tmp_path)],
        cwd=PLUGIN,
        capture_output=True,
        text=True,
        check=True,
    )
    (package,) = json.loads(made.stdout)
    assert {file["path"] for file in package["files"]} >= {"index.js", "telemetry.js", "serve.js", "package.json"}
