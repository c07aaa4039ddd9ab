"""The page of a fleet of a thousand: sorted, filtered and turned by the service, in real Chromium."""

from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from service.instants import format_instant, now_us
from service.store import alarms, anomalies, appending, fleet, models, twins
from service.store.alarms import Limit
from service.store.anomalies import Change
from service.store.batch import Batch
from service.store.connection import Connection
from service.store.database import Database
from service.store.fleet import Vital
from tests.service.browser import BINARY, Browser
from tests.service.conftest import SPEC
from tests.service.server import FAKE, Server

pytestmark = [pytest.mark.browser, pytest.mark.e2e, pytest.mark.skipif(BINARY is None, reason="no Chromium here")]

COUNT = 1000
DAY_US = 86_400_000_000
ROWS = "document.querySelectorAll('#fleet-table tbody tr')"
FIRST = "document.querySelector('#fleet-table tbody tr').innerText"


def fill(connection: Connection, at_us: int) -> None:
    """Register a thousand twins of which a few need somebody."""
    generator = np.random.default_rng(0)
    for k in range(COUNT):
        family = f"block-{1 + k // 250}"
        limits = {"red": [None, 295.0]} if k % 125 == 60 else {"yellow": [None, 296.0]} if k % 50 == 33 else None
        watched = {"T_px": {**SPEC["channels"]["T_px"], "limits": limits}} if limits else {}
        declared = {**SPEC, "twin": f"sat-{k:04}", "family": family, "channels": {**SPEC["channels"], **watched}}
        twin, _ = twins.register(connection, f"sat-{k:04}", declared)
        ages_us = 30_000_000 * np.arange(40, 0, -1) + (3_600_000_000 if k % 100 == 7 else 0)
        time_us = (at_us - ages_us).astype(np.int64)
        values = generator.normal(290, 1, (3, 40))
        if k % 125 == 60:
            values[0, -5:] = 297.0
        appending.append(connection, twin.key, Batch(time_us, values, time_us + 1_000_000))
        if k % 200 == 11:
            continue
        summary = {"epoch_us": at_us, "train": {}, "validation": {"rmse_K": 0.1}, "effects": []}
        models.add(connection, twin.key, "manual", summary, {"rmse_K": 0.1, "max_step_s": 60.0, "spec": SPEC})
        models.activate(connection, twin.key, 1, "requested")
        age_us = int(DAY_US * (40 if k == 500 else generator.uniform(0.2, 9)))
        connection.execute("UPDATE model SET created_us = ? WHERE twin = ?", (at_us - age_us, twin.key))
        deviations = 7.5 if k == 321 else float(np.abs(generator.normal(size=9)).max())
        worst = Vital(int(time_us[-1]), "T_tank" if k % 3 else "T_px", 0.11 * deviations, deviations)
        fleet.note(connection, twin.key, 1, worst)
        if k % 125 == 60:
            body = {"unit": "K", "worst": 297.0, "message": "T_px is above its red limit"}
            alarms.write(connection, twin.key, Limit("measured", "T_px", "red", "high", 295.0), at_us, None, body)
        if k % 50 == 33:
            expected = format_instant(at_us + int((1 + k / 100) * 3.6e9))
            body = {"unit": "K", "message": "T_px reaches its yellow limit", "expected": expected}
            alarms.write(connection, twin.key, Limit("forecast", "T_px", "yellow", "high", 296.0), at_us, None, body)
        if k % 40 == 21:
            anomalies.apply(connection, twin.key, 1, [Change("T_px", "bias", at_us, None, 5.0)], (at_us - 1, at_us))


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    place = tmp_path / "fleet.sqlite3"
    database = Database(place)
    database.submit(fill, now_us()).result(120)
    database.close()
    with Server(tmp_path, command=FAKE, database_url=f"sqlite:///{place}", assimilate="false") as running:
        yield running


def test_a_fleet_of_a_thousand(server: Server, tmp_path: Path) -> None:
    with Browser(tmp_path / "profile", 1400, 1000) as page:
        page.open(server.url)
        page.until(f"{ROWS}.length === 50")
        page.until("document.getElementById('link-text').innerText === '1,000 twins'")
        kinds = page.evaluate("[...document.querySelectorAll('.kind b')].map((b) => b.innerText)")
        assert kinds == ["1,000", "8", "0", "20", "25", "10", "5"]
        assert page.evaluate(f"{FIRST}.startsWith('sat-0560') && {FIRST}.includes('1 red')")
        assert page.text("#fleet-pager").startswith("1–50 of 1,000")

        page.click("[data-key='page-›']")
        page.until("document.getElementById('fleet-pager').innerText.startsWith('51–100')")
        page.click("[data-key='sort-residual']")
        page.until(f"{FIRST}.startsWith('sat-0321') && {FIRST}.includes('7.5 σ')")
        page.click("[data-key='sort-model_age']")
        page.until(f"{FIRST}.startsWith('sat-0500') && {FIRST}.includes('40 d')")
        page.click("[data-key='sort-ahead']")
        page.until(f"{FIRST}.startsWith('sat-0033') && {FIRST}.includes('yellow')")
        page.click("[data-key='kind-stale']")
        page.until(f"{ROWS}.length === 10 && {FIRST}.includes('silent')")
        page.click("[data-key='kind-all']")
        page.click("[data-key='sort-id']")
        page.until(f"{FIRST}.startsWith('sat-0000')")
        page.click("[data-key='sort-id']")
        page.until(f"{FIRST}.startsWith('sat-0999')")

        page.evaluate("document.getElementById('fleet-find').focus()")
        page.send("Input.insertText", text="block-2")
        page.until("document.getElementById('fleet-pager').innerText.startsWith('1–50 of 250')")
        page.evaluate("document.getElementById('fleet-find').select()")
        page.send("Input.insertText", text="nobody")
        page.until(f"{ROWS}.length === 1 && {FIRST}.includes('nobody')")
        page.evaluate("document.getElementById('fleet-find').select()")
        page.send("Input.insertText", text="sat-0811")
        page.until(f"{ROWS}.length === 1 && {FIRST}.startsWith('sat-0811')")
        page.click("button.open")
        page.until("document.getElementById('twin').value === 'sat-0811' && !document.getElementById('main').hidden")
        assert page.evaluate("document.getElementById('fleet').hidden")
        page.until("document.getElementById('facts').innerText.includes('samples')")
        page.press("f")
        page.until(f"!document.getElementById('fleet').hidden && {ROWS}.length === 1")
        page.resize(390, 800)
        page.until("document.documentElement.scrollWidth <= 390")
        assert page.troubles == []

    answer = httpx.get(f"{server.url}/v1/fleet", timeout=60.0, trust_env=False)  # of a thousand only fifty travel
    assert len(answer.json()["twins"]) == 50 and len(answer.content) < 40_000
