"""What webhooks hear of an anomaly."""

import json
from pathlib import Path

import pytest

from service.store import twins, webhooks
from service.store.anomalies import AnomalyRow
from service.store.database import Database
from tests.service.conftest import SPEC


@pytest.mark.parametrize(
    ("sensor", "kind", "stop_us", "line"),
    [
        ("T_px", "residual", None, "T_px departs from its model"),
        ("T_px", "residual", 2, "T_px departs from its model (ended)"),
        ("*", "joint", None, "all sensors together depart from their model"),
        ("T_tank", "stuck", None, "T_tank is frozen: it repeats one reading"),
    ],
)
def test_an_anomaly_is_told_in_one_sentence(
    tmp_path: Path, sensor: str, kind: str, stop_us: int | None, line: str
) -> None:
    database = Database(tmp_path / "twin.sqlite3")
    try:
        twin, _ = database.submit(twins.register, "benchsat", SPEC).result()
        database.submit(webhooks.add, "http://127.0.0.1/", None, None, "secret").result()
        row = AnomalyRow(1, sensor, kind, 1, stop_us, 5.0, None, 1)
        database.submit(webhooks.enqueue, twin.key, 1, 1, "anomaly", {"anomaly": row.wire()}).result()
        (text,) = database.submit(lambda c: c.execute("SELECT body FROM delivery").fetchone()).result()
    finally:
        database.close()
    told = json.loads(text)
    assert (told["body"], told["title"]) == (line, f"benchsat: {line}")
