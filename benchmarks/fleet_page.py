"""The fleet page with a thousand twins in real Chromium: how long a click takes, and how long the page stands still.

``python -m benchmarks.fleet_page`` writes ``benchmarks/tables/fleet_page.md``.
"""

import os
import tempfile
import time
from pathlib import Path

import httpx
import numpy as np

from benchmarks.fleet_stream import cpu_s
from benchmarks.markdown import markdown_table, save_table
from service.instants import now_us
from service.store.database import Database
from tests.service.browser import Browser
from tests.service.server import FAKE, Server
from tests.service.test_dashboard_fleet import COUNT, ROWS, fill

ROUNDS = 6
CLICKS = ("sort-residual", "sort-model_age", "sort-ahead", "page-›", "sort-id", "kind-stale", "kind-all")
CLICK = """new Promise((resolve) => {
  const begun = performance.now(), still = [];
  const tasks = new PerformanceObserver((list) => still.push(...list.getEntries().map((e) => e.duration)));
  tasks.observe({ entryTypes: ["longtask"] });
  new MutationObserver((_, observer) => {
    observer.disconnect();
    requestAnimationFrame(() => setTimeout(() => resolve([performance.now() - begun, Math.max(0, ...still)])));
  }).observe(document.querySelector("#fleet-table"), { childList: true });
  document.querySelector("[data-key='KEY']").click();
})"""
"""From a click until the new table is painted, and the longest task meanwhile that kept the page from answering, in ms."""


def main() -> None:
    """Measure and write the table."""
    waits, still, answers = [], [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        database = Database(folder / "fleet.sqlite3")
        database.submit(fill, now_us()).result(120)
        database.close()
        url = f"sqlite:///{folder / 'fleet.sqlite3'}"
        with (
            Server(folder, command=FAKE, database_url=url, assimilate="false") as server,
            httpx.Client(base_url=server.url, trust_env=False) as client,
            Browser(folder / "profile", 1400, 1000) as page,
        ):
            page.open(server.url)
            page.until(f"{ROWS}.length === 50")
            load, begun_s = os.getloadavg()[0], cpu_s(server.process.pid)
            for _ in range(ROUNDS):
                for key in CLICKS:
                    waited_ms, still_ms = page.evaluate(CLICK.replace("KEY", key))
                    waits.append(waited_ms)
                    still.append(still_ms)
                    begun = time.perf_counter()
                    assert client.get("/v1/fleet").status_code == 200
                    answers.append(1e3 * (time.perf_counter() - begun))
            each_ms = 1e3 * (cpu_s(server.process.pid) - begun_s) / (2 * len(answers))

    def told(values: list[float]) -> list[str]:
        return [f"{float(np.quantile(values, q)):.0f} ms" for q in (0.5, 0.9, 1.0)]

    rows = [
        ["from a click until the new table is painted", *told(waits)],
        ["longest task that keeps the page from answering", *told(still)],
        ["request of fifty twins of a thousand, to its answer", *told(answers)],
    ]
    rows.append(
        ["processor time of the service for a request, its background work included", f"{each_ms:.0f} ms", "", ""]
    )
    note = f"{len(waits)} clicks (sort, turn, filter) with {COUNT:,} twins. Load average {load:.0f} on two cores."
    table = markdown_table(["what", "median", "90 %", "longest"], rows)
    print(table)
    save_table("fleet_page", "The fleet page with a thousand twins", table, "benchmarks.fleet_page", note)


if __name__ == "__main__":
    main()
