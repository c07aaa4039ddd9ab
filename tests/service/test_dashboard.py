"""The dashboard as a person uses it: real server, real Chromium, samples arriving, clicks and keys."""

import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.browser import BINARY, Browser
from tests.service.conftest import SPEC
from tests.service.server import FAKE, Server

pytestmark = [pytest.mark.browser, pytest.mark.e2e, pytest.mark.skipif(BINARY is None, reason="no Chromium here")]


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with Server(tmp_path, command=FAKE) as running:
        yield running


@pytest.fixture
def page(server: Server, tmp_path: Path) -> Iterator[Browser]:
    with Browser(tmp_path / "profile") as browser:
        browser.open(server.url)
        yield browser


def send(server: Server, first: int, count: int = 200, twin: str = "benchsat") -> None:
    times = [60.0 * k for k in range(first, first + count)]
    jumps = [290.0 + 0.001 * k + (9.0 * (k % 2) if 150 <= k < 180 else 0.0) for k in range(first, first + count)]
    values = {"T_px": jumps, "T_tank": [15.0] * count, "Q_px": [0.5] * count}
    server.client().ingest(twin, times, values)


def test_a_day_at_the_console(server: Server, page: Browser) -> None:
    page.until("!document.getElementById('empty').hidden")
    assert "curl" in page.text("#empty-code")
    assert page.evaluate("document.querySelector('.picker').hidden")
    assert page.evaluate("(e => e.scrollWidth <= e.clientWidth)(document.getElementById('empty-code'))")

    server.client().register(SPEC)
    page.until("document.getElementById('twin').value === 'benchsat'")
    page.until("document.getElementById('temperatures').innerText.includes('No telemetry yet')")
    send(server, 0)
    page.until("document.querySelector('#temperatures canvas')")
    page.until("document.getElementById('facts').innerText.includes('200')")
    page.until("document.getElementById('residuals').innerText.includes('calibrate')")
    page.until("document.getElementById('anomalies').innerText.includes('No model')")  # none says that a sensor behaves
    page.until("document.querySelectorAll('#now .state.unknown').length === 2")

    page.click("#calibrate")
    page.until("document.getElementById('models').innerText.includes('active')")
    page.until("document.querySelector('#residuals canvas')")
    page.until("document.getElementById('now-note').innerText.includes('expected in')")
    page.until("document.getElementById('anomalies').innerText.includes('T_px')")
    page.until("!document.querySelector('#now .state.unknown')")
    page.until("document.getElementById('now').innerText.includes('17.05')")  # 290.2 K, in the unit of the other sensor
    page.until("document.querySelectorAll('#network circle.node').length === 1")

    send(server, 200)
    page.until("document.getElementById('facts').innerText.includes('400')")
    page.until("document.getElementById('now').innerText.includes('17.25')")

    page.click("#diagnose")
    page.until("document.querySelector('#jobs').innerText.includes('constant heat load')")
    page.until("[...document.querySelectorAll('#jobs button')].some((b) => b.innerText === 'Report')")
    page.click("#jobs li:first-child button")
    page.until("document.getElementById('report-dialog').open")
    assert "found" in page.evaluate("document.getElementById('report').srcdoc")
    page.click("#report-dialog button")
    page.until("!document.getElementById('report-dialog').open")

    page.click("#models tbody tr:first-child button")
    page.until("document.getElementById('activate-dialog').open")
    assert "Effects" in page.text("#compare") and "constant heat load" in page.text("#compare")
    # Cancelled and asked again at once: the browser tells of the first closing when the second question already stands.
    page.evaluate(
        "(() => { document.querySelector(\"#activate-dialog button[value='']\").click();"
        " document.querySelector('#models tbody tr:first-child button').click(); })()"
    )
    page.until("document.getElementById('activate-dialog').open")
    page.click("#activate-yes")
    page.until("document.querySelector('#models tbody tr:first-child').innerText.includes('active')")
    assert page.troubles == []


def test_what_is_not_of_the_present_is_told(server: Server, page: Browser) -> None:
    server.client().register(SPEC)
    page.until("document.getElementById('link-text').innerText === 'waiting for telemetry'")
    now = float(int(time.time()))
    values = {"T_px": [290.0] * 20, "T_tank": [15.0] * 20, "Q_px": [0.5] * 20}
    server.client().ingest("benchsat", [now - 60.0 * (19 - k) for k in range(20)], values)
    page.until("document.getElementById('link-text').innerText === 'live'")
    server.client().ingest("benchsat", [now + 5 * 86_400], {"T_px": [250.0]})
    page.until("document.getElementById('facts').innerText.includes('in quarantine 1')")
    server.client().register({**SPEC, "twin": "recorded"})
    send(server, 0, twin="recorded")
    page.until("[...document.getElementById('twin').options].length === 2")
    page.press("j")
    page.until("document.getElementById('link-text').innerText.startsWith('arriving')")
    assert page.troubles == []


def test_alarms_are_acknowledged_and_shelved(server: Server, page: Browser) -> None:
    limits = {"yellow": [None, 295.0], "red": [None, 400.0]}
    limited = {**SPEC["channels"], "T_px": {**SPEC["channels"]["T_px"], "limits": limits}}
    server.client().register({**SPEC, "channels": limited})
    server.client().ingest("benchsat", [9000, 9001, 9002], {"T_px": [290.0, 296.0, 297.0]})
    page.until("document.getElementById('alarms').innerText.includes('above its yellow limit of 295 K')")
    page.until("document.querySelector('#now .state.warn').title === 'above its yellow limit'")
    page.until_drawn("T_px yellow")  # the limit's line in the plot
    page.click("#alarms button:first-of-type")
    page.until("document.getElementById('alarms').innerText.includes('acknowledged')")
    page.click("#alarms button:last-of-type")
    page.until("document.querySelector('#alarms .quietly')")
    page.click("#alarms button:last-of-type")
    page.until("!document.querySelector('#alarms .quietly')")
    assert page.evaluate("document.querySelector('#now .big .over.warn').title") == "above its yellow limit of 295 K"
    server.client().ingest("benchsat", [9003, 9004], {"T_px": [280.0, 280.0]})
    page.until(
        "document.querySelector('#alarms .past')?.innerText.includes('was above its yellow limit of 295 K: 297 at worst')"
    )
    page.until("!document.querySelector('#now .big .over')")
    assert page.troubles == []


def test_heat_of_a_found_effect_has_a_way_and_no_sign(server: Server, page: Browser) -> None:
    """A leak that cools box, whose other end is bus, flows to bus, whichever end is named first."""
    drawn = page.evaluate(
        """(async () => {
          const { NetworkDrawing } = await import("/assets/js/network.js");
          const host = document.createElement("div");
          document.body.append(host);
          const drawing = new NetworkDrawing(host);
          const picture = (effect) => ({
            nodes: [{ id: "box", temperature_K: 300, heat_W: 0, sensed: true }], boundaries: [{ id: "bus", temperature_K: 290 }],
            links: [], loads: [], effects: [effect] });
          const found = [];
          for (const [nodes, heat] of [[["box", "bus"], -10.8], [["box", "bus"], 10.8], [["bus", "box"], -10.8]]) {
            const heat_W = { box: heat };
            drawing.update(picture({ effect: "leak_to_boundary", where: { nodes }, heat_W }), "K");
            const [bx, by] = drawing.places.get("box"), [sx, sy] = drawing.places.get("bus");
            const head = host.querySelector(".effect-head").getAttribute("transform");
            const turn = Number(/rotate\\(([^)]+)\\)/.exec(head)[1]) * Math.PI / 180;
            const towards = Math.cos(turn) * (sx - bx) + Math.sin(turn) * (sy - by) > 0 ? "bus" : "box";
            found.push(`${host.querySelector(".effect-label").textContent} to ${towards}`);
          }
          host.remove();
          return JSON.stringify(found);
        })()"""
    )
    label = "leak to boundary 10.8 W"
    assert json.loads(drawn) == [f"{label} to bus", f"{label} to box", f"{label} to bus"]
    assert page.troubles == []


def test_inputs_limits_plans_and_files(server: Server, page: Browser) -> None:
    limits = {"yellow": [None, 290.3], "red": [None, 290.35]}
    mode = {"kind": "auxiliary", "levels": True}
    limited = {**SPEC["channels"], "T_px": {**SPEC["channels"]["T_px"], "limits": limits}, "mode": mode}
    server.client().register({**SPEC, "channels": limited})
    times = [60.0 * k for k in range(200)]
    values = {"T_px": [290.0 + 0.001 * k for k in range(200)], "T_tank": [15.0] * 200, "Q_px": [0.5] * 200}
    server.client().ingest("benchsat", times, {**values, "mode": [float(k // 100) for k in range(200)]})
    page.until("document.querySelector('#inputs canvas')")
    assert page.text("#input-legend").split() == ["Q_px", "mode"]
    page.until_drawn("mode 1")  # the change of mode is marked in the plot
    page.click("#input-legend button:last-child")
    assert (
        page.evaluate("document.querySelector('#input-legend button:last-child').getAttribute('aria-pressed')")
        == "false"
    )
    assert "hidden=mode" in page.evaluate("location.hash")

    page.click("#what-if")
    page.until_told("needs an active model")
    page.click("#calibrate")
    page.until("document.getElementById('now-note').innerText.includes('expected in')")
    page.evaluate(
        "(e => { e.value = '10800'; e.dispatchEvent(new Event('change')); })(document.getElementById('horizon'))"
    )
    page.until("document.getElementById('now-note').innerText.includes('expected in 3 h')")
    assert "ahead=10800" in page.evaluate("location.hash")
    page.click("#predicted")
    page.until("document.getElementById('plot-note').innerText.includes('predicted one sample ahead')")

    page.click("#what-if")
    page.until("document.getElementById('plan-dialog').open")
    page.evaluate("document.querySelector('#plan-rows input[type=number]').value = '7'")
    page.evaluate("document.querySelector('#plan-rows input.instant').value = '2030-01-01T00:00'")
    page.click("#plan-show")
    page.until("!document.getElementById('plan-refused').hidden")  # the plan begins after the forecast ends
    page.evaluate("document.querySelector('#plan-rows input.instant').value = '1970-01-01T04:00'")
    page.click("#plan-show")
    page.until("!document.getElementById('plan-dialog').open")
    page.until("document.getElementById('plot-note').innerText.includes('with your plan')")

    page.evaluate("HTMLAnchorElement.prototype.click = () => {}")
    keep = "(blob) => { blob.text().then((text) => { window.saved = text; }); return 'about:blank'; }"
    page.evaluate(f"URL.createObjectURL = {keep}; 0")
    page.click("#csv")
    page.until("window.saved")
    head, first = page.evaluate("window.saved").split("\r\n")[:2]
    assert head.startswith("time,T_px [K],T_tank [degC],Q_px [W],T_px forecast,T_px 5 %,T_px 95 %,T_px with the plan")
    assert first.startswith("1970-01-01T00:00:00Z,290,15,0.5,")
    (refused,) = page.troubles
    assert "422" in refused


def test_a_time_is_entered_and_the_address_keeps_it(server: Server, page: Browser) -> None:
    server.client().register(SPEC)
    send(server, 0)
    page.until("document.getElementById('from').value !== ''")
    page.evaluate("document.getElementById('from').focus()")  # what somebody writes there stays there
    page.evaluate("document.getElementById('from').value = '1970-01-01T01:00:00'")
    page.evaluate("document.getElementById('to').value = '1970-01-01T01:30:00'")
    page.click("#times button")
    page.until("document.getElementById('plot-note').innerText.startsWith('31 samples')")
    address = page.evaluate("location.href")
    assert "from=1970-01-01T01:00:00Z&to=1970-01-01T01:30:00Z" in address
    page.open("about:blank")
    page.open(address)
    page.until("document.getElementById('plot-note').innerText.startsWith('31 samples')")
    page.until("document.getElementById('to').value === '1970-01-01 01:30:00'")
    page.evaluate("document.getElementById('to').focus()")
    page.evaluate("document.getElementById('to').value = '1970-01-01T00:30:00'")
    page.click("#times button")
    page.until_told("must come before")
    page.evaluate("document.getElementById('to').value = '1/1/1970, 2 PM'")
    page.click("#times button")
    page.until_told("Write both times as")
    assert page.troubles == []


def test_several_twins_begin_with_an_overview(server: Server, page: Browser) -> None:
    for twin in ("first", "second"):
        server.client().register({**SPEC, "twin": twin})
    limits = {"red": [None, 295.0]}
    hot = {**SPEC["channels"], "T_px": {**SPEC["channels"]["T_px"], "limits": limits}}
    server.client().register({**SPEC, "twin": "third", "channels": hot})
    server.client().ingest("third", [9000, 9001, 9002], {"T_px": [290.0, 296.0, 297.0]})
    page.open("about:blank")
    page.open(server.url)
    page.until("document.querySelectorAll('#fleet-table tbody tr').length === 3")
    page.until("document.querySelector('#fleet-table tbody tr').innerText.startsWith('third')")
    page.until("document.querySelector('#fleet-table tbody tr').innerText.includes('1 red')")
    assert page.evaluate("document.getElementById('main').hidden")
    page.click("#fleet-table tbody tr:nth-child(2) button")
    page.until("document.getElementById('twin').value === 'first' && !document.getElementById('main').hidden")
    assert page.evaluate("location.hash").startswith("#first?range=")
    page.until("document.getElementById('facts').innerText.includes('samples')")
    page.press("f")
    page.until("!document.getElementById('fleet').hidden")
    page.resize(390, 800)
    page.until("document.documentElement.scrollWidth <= 390")
    assert page.troubles == []


def test_the_heat_flows_can_be_walked_with_the_keyboard(server: Server, page: Browser) -> None:
    server.client().register(SPEC)
    send(server, 0)
    page.until("document.querySelector('#temperatures canvas')")
    page.click("#calibrate")
    page.until("document.getElementById('network-note').innerText.startsWith('at ')")
    page.evaluate("document.querySelector('#network .place').focus()")
    assert page.evaluate("document.activeElement.getAttribute('aria-label')").startswith("px: ")
    page.resize(390, 800)
    page.until("document.getElementById('facts').offsetHeight > 0")
    page.until("document.getElementById('facts').innerText.includes('model v1')")
    page.until("document.documentElement.scrollWidth <= 390")
    assert page.troubles == []


def test_keys_zoom_and_small_screens(server: Server, page: Browser) -> None:
    server.client().register(SPEC)
    send(server, 0)
    page.until("document.querySelector('#temperatures canvas')")

    page.press("t")
    first = page.evaluate("document.documentElement.dataset.theme")
    page.press("t")
    assert {first, page.evaluate("document.documentElement.dataset.theme")} == {"light", "dark"}
    unit = page.text("#unit")
    page.press("u")
    assert {unit, page.text("#unit")} == {"K", "°C"}
    page.press("1")
    assert page.text("#ranges [aria-pressed=true]") == "1 h"
    page.until("document.getElementById('plot-note').innerText.startsWith('61 samples')")
    page.drag("#temperatures .u-over", 0.2, 0.6)
    page.until("!document.querySelector('#ranges [aria-pressed=true]')")
    page.press("1")
    page.until("document.getElementById('plot-note').innerText.startsWith('61 samples')")
    page.press("ArrowLeft")  # half an hour back
    page.until("!document.querySelector('#ranges [aria-pressed=true]')")
    page.until("document.getElementById('plot-note').innerText.startsWith('61 samples')")
    page.press("+")
    page.until("document.getElementById('plot-note').innerText.startsWith('31 samples')")
    page.press("-")
    page.until("document.getElementById('plot-note').innerText.startsWith('61 samples')")
    page.press("5")
    page.until("document.getElementById('plot-note').innerText.startsWith('200 samples')")
    page.press("?")
    page.until("document.getElementById('help-dialog').open")
    page.click("#help-dialog button")
    page.until("!document.getElementById('help-dialog').open")
    page.click("#calibrate")
    page.until("document.getElementById('models').innerText.includes('active')")
    page.click("#diagnose")
    page.until("document.getElementById('models').innerText.includes('constant heat load')")
    page.click("#legend button")
    assert page.evaluate("document.querySelector('#legend button').getAttribute('aria-pressed')") == "false"

    for width in (360, 820, 1400):
        page.resize(width, 900)
        page.until(f"document.documentElement.scrollWidth <= {width}")
        fits = "(e => e.parentElement.scrollWidth <= e.parentElement.clientWidth)(document.getElementById('{}'))"
        page.until(" && ".join(fits.format(table) for table in ("now", "models")))
    assert page.troubles == []


def test_a_key_is_asked_for_where_one_is_needed(tmp_path: Path) -> None:
    with Server(tmp_path, command=FAKE, api_keys="read:sesame,operate:o") as server:
        server.client("o").register(SPEC)
        with Browser(tmp_path / "profile") as page:
            page.open(server.url)
            page.until("document.getElementById('key-dialog').open")
            assert page.evaluate("document.getElementById('key-refused').hidden")
            page.evaluate("document.getElementById('key').value = 'open'")
            page.click("#key-dialog button")
            page.until("document.getElementById('key-dialog').open && !document.getElementById('key-refused').hidden")
            page.evaluate("document.getElementById('key').value = 'sesame'")
            page.click("#key-dialog button")
            page.until("document.getElementById('twin').value === 'benchsat'")
            page.until("document.getElementById('link').dataset.state === 'live'")
            page.click("#calibrate")
            page.until_told("operate")
            assert server.client("o")._http.get("/v1/twins/benchsat/calibrations").json() == {"jobs": []}


def test_the_description_of_the_api_needs_no_other_host(server: Server, page: Browser) -> None:
    page.open(f"{server.url}/docs")
    page.until("document.querySelectorAll('.opblock').length >= 20")
    loaded = page.evaluate("performance.getEntriesByType('resource').map((entry) => entry.name)")
    assert len(loaded) >= 3 and all(name.startswith((server.url, "data:")) for name in loaded)
    assert page.troubles == []
