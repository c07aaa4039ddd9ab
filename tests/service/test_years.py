"""What a twin needs that is kept for years: windows, bounds, exports, retention, deletion in pieces."""

import csv
import io
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from service.jobs.executor import JobFailed, ProcessPerTask, Task
from service.jobs.runner import usual_samples
from service.running.housekeeping import Housekeeping
from service.store import appending, retention, selection
from service.store.batch import Batch
from service.store.database import Database
from service.workbench.core import CoreWorkbench
from service.workbench.interface import DiagnosisTask, Telemetry
from tests.helpers import conductive_spec
from tests.service.conftest import SPEC, STORE, Sql
from tests.service.fakes import SHORTEST_SEARCH_S, FakeWorkbench
from tests.service.harness import AppClient, until
from tests.service.test_jobs import finish
from twin_core._typing import no_progress
from twin_core.network.spec_io import load_spec

TWIN = "/v1/twins/benchsat"
N = 3000


def ingest(client: AppClient, first: int, count: int, power: float = 0.5) -> None:
    times = [float(k) for k in range(first, first + count)]
    values = {
        "T_px": [290.0 + 0.001 * k for k in range(first, first + count)],
        "T_tank": [15.0 + k % 7 for k in range(first, first + count)],
        "Q_px": [power] * count,
    }
    assert client.post(f"{TWIN}/telemetry", json={"time": times, "values": values}).json()["accepted"] == count


def calibrate(client: AppClient, body: dict[str, Any]) -> Any:
    return finish(client, client.post(f"{TWIN}/calibrations", json=body).headers["Location"])


@pytest.fixture
def database(tmp_path: Path) -> Any:
    database = Database(tmp_path / "store.sqlite3")
    database.submit(
        lambda c: c.execute("INSERT INTO twin (name, specification, created_us) VALUES ('t', '{}', 0)")
    ).result()
    database.submit(lambda c: c.execute("INSERT INTO head (twin) VALUES (1)")).result()
    yield database
    database.close()


def test_a_thinned_archive_keeps_readings_and_loses_no_heat(database: Database) -> None:
    generator = np.random.default_rng(0)
    time_us = np.cumsum(generator.integers(1, 5, 4000)) * 1_000_000
    values = np.stack([generator.normal(290, 1, 4000), generator.choice([0.0, 50.0], 4000)])
    values[1, generator.random(4000) < 0.3] = np.nan  # an input that is sent when it changes
    values[1, 0] = 20.0
    for first in range(0, 4000, 500):
        database.submit(
            appending.append, 1, Batch(time_us[first : first + 500], values[:, first : first + 500])
        ).result()
    made = database.submit(selection.choose, 1, 2, None, None, 400, True, [0], [1]).result()
    kept = made.samples
    assert (made.how, made.stride, made.of, kept.time_us.size) == ("thinned", 10, 4000, 400)
    place = np.searchsorted(time_us, kept.time_us)
    assert (kept.values[0] == values[0, place]).all()
    held = pd.Series(values[1]).ffill().to_numpy()
    joules = (held[:-1] * np.diff(time_us)).cumsum()
    taken = (kept.values[1, :-1] * np.diff(kept.time_us)).sum()
    assert taken == pytest.approx(joules[place[-1] - 1], rel=1e-12)


def test_sensors_that_report_in_turn_all_stay_in_a_thinned_archive(database: Database) -> None:
    values = np.full((4, 4000), np.nan)
    for row in range(4):
        values[row, row::4] = row
    database.submit(appending.append, 1, Batch(np.arange(4000) * 1_000_000, values)).result()
    kept = database.submit(selection.choose, 1, 4, None, None, 1000, True, [0, 1, 2, 3], []).result().samples
    assert (np.isfinite(kept.values).sum(axis=1) >= 200).all()


def test_a_job_takes_the_newest_samples_and_says_so(make_client: Any) -> None:
    client = make_client(FakeWorkbench, job_values=1000)
    client.post("/v1/twins", json=SPEC)
    for first in range(0, N, 500):
        ingest(client, first, 500)
    job = calibrate(client, {})
    assert job["state"] == "succeeded", job["message"]
    assert "the newest 333 of 3,000 samples" in job["message"]
    taken = client.get(f"{TWIN}/models/1").json()["provenance"]["telemetry"]
    assert (taken["samples"], taken["of"], taken["how"]) == (333, 3000, "newest")
    job = calibrate(client, {"samples": 100, "thin": True})
    assert "one in 30" in job["message"]
    job = calibrate(client, {"samples": 5000})
    assert "samples" not in job["message"].partition("; from")[2]
    assert client.post(f"{TWIN}/calibrations", json={"samples": 3}).status_code == 422


@pytest.mark.parametrize(("n_nodes", "samples"), [(1, 125_000), (11, 20_833), (199, 253), (3000, 20)])
def test_a_job_takes_fewer_samples_of_a_wide_network(n_nodes: int, samples: int) -> None:
    channels = {"Q": {"kind": "power", "unit": "W"}}
    row = conductive_spec(n_nodes, [(i, i + 1) for i in range(n_nodes - 1)], channels=channels)
    assert usual_samples(load_spec(row), 250_000) == samples


def test_a_search_has_a_deadline_and_one_that_was_cut_short_is_told(make_client: Any) -> None:
    client = make_client(FakeWorkbench, job_search_s=SHORTEST_SEARCH_S - 1.0)
    client.post("/v1/twins", json=SPEC)
    ingest(client, 0, 500)
    assert "its search ended at its deadline" in calibrate(client, {})["message"]
    assert "deadline" not in calibrate(client, {"deadline_s": SHORTEST_SEARCH_S})["message"]
    assert client.post(f"{TWIN}/calibrations", json={"deadline_s": 0}).status_code == 422


def test_a_diagnosis_that_had_no_time_answers_and_says_so(
    pair_declared: dict[str, Any], pair_telemetry: Callable[[int], str]
) -> None:
    rows = list(csv.DictReader(io.StringIO(pair_telemetry(120))))
    columns = {name: np.array([float(row[name]) for row in rows]) for name in ("T_a", "T_b", "Q_a")}
    columns["Q_a"][60:] *= 1.5
    telemetry = Telemetry(0, 60_000_000 * np.arange(120), columns)
    task = DiagnosisTask(pair_declared, telemetry, 0.3, None, 0.01, deadline_s=1e-3)
    made = CoreWorkbench().diagnose(task, no_progress)
    assert made.cut_short and made.report is not None and made.report["search"]["left_out"] > 0


def test_a_window_knows_the_inputs_that_hold_where_it_begins(database: Database) -> None:
    values = np.stack([np.full(100, 290.0), np.full(100, np.nan)])
    values[1, 3] = 7.0
    database.submit(appending.append, 1, Batch(np.arange(100) * 1_000_000, values)).result()
    kept = database.submit(selection.choose, 1, 2, None, None, 50, False, [0], []).result().samples
    assert kept.time_us[0] == 50_000_000 and kept.values[1, 0] == 7.0 and np.isnan(kept.values[1, 1:]).all()


def _hoard(progress: Any) -> None:
    kept = []
    for _ in range(600):
        kept.append(np.ones(2**20))  # eight megabytes at a time
        time.sleep(0.02)


def test_a_job_that_needs_too_much_memory_is_ended() -> None:
    executor = ProcessPerTask(1, 600.0, 250.0)
    with pytest.raises(JobFailed, match="250 MiB of memory"):
        executor.start(Task(_hoard)).result()
    executor.shutdown()


def test_a_new_model_follows_a_window_of_the_archive(make_client: Any) -> None:
    client = make_client(FakeWorkbench, assimilate_samples=1000)
    client.post("/v1/twins", json=SPEC)
    for first in range(0, N, 500):
        ingest(client, first, 500)
    calibrate(client, {})
    found = client.get(f"{TWIN}/residuals").json()
    assert found["samples"] == 1000 and found["time"][0] == "1970-01-01T00:33:20Z"
    progress = client.get(TWIN).json()["assimilation"]
    assert (progress["done"], progress["of"], progress["since"]) == (1000, 1000, "1970-01-01T00:33:20Z")
    ingest(client, N, 10)
    client.post(f"{TWIN}/telemetry", json={"time": [100.5, 2500.5], "values": {"T_px": [290.1, 292.5]}})
    found = client.get(f"{TWIN}/residuals").json()  # the late one in the window counts, the other one is archived only
    assert found["samples"] == 1011
    forecast = client.get(f"{TWIN}/forecast", params={"horizon_s": 10}).json()
    assert forecast["from"] == "1970-01-01T00:50:09Z" and forecast["behind_s"] == 0.0
    client.close()
    client = make_client(FakeWorkbench, assimilate_samples=1000)
    assert client.get(f"{TWIN}/residuals").json()["samples"] == 1011
    assert client.get(TWIN).json()["assimilation"]["since"] == "1970-01-01T00:33:20Z"


def test_answers_are_bounded_and_exports_are_whole(make_client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.http.routes.telemetry.USUAL_VALUES", 900)
    monkeypatch.setattr("service.archive.export.PIECE", 700)
    client = make_client()
    client.post("/v1/twins", json=SPEC)
    for first in range(0, N, 500):
        ingest(client, first, 500)
    client.post(f"{TWIN}/telemetry", json={"time": [0.5], "values": {"T_px": [290.5]}})
    plot = client.get(f"{TWIN}/telemetry").json()
    assert len(plot["time"]) <= 300 and plot["samples"] == N + 1 and plot["downsampled"]
    answer = client.get(f"{TWIN}/telemetry/export", params={"start": 0, "stop": 2000})
    assert (
        answer.headers["content-type"].startswith("text/csv")
        and "benchsat.csv" in answer.headers["content-disposition"]
    )
    table = pd.read_csv(io.BytesIO(answer.content))
    assert list(table.columns) == ["time", "T_px", "T_tank", "Q_px"] and len(table) == 2001
    assert (
        table["T_px"][1] == 290.5 and np.isnan(table["T_tank"][1]) and table["time"][1] == "1970-01-01T00:00:00.500000Z"
    )
    parquet = client.get(f"{TWIN}/telemetry/export", params={"format": "parquet", "channels": "T_tank,T_px"})
    frame = pd.read_parquet(io.BytesIO(parquet.content))
    assert list(frame.columns) == ["time", "T_tank", "T_px"] and len(frame) == N + 1
    assert frame["time"].is_monotonic_increasing and frame["T_px"].to_numpy()[2:] == pytest.approx(
        290 + 0.001 * np.arange(1, N)
    )
    assert client.get(f"{TWIN}/telemetry/export", params={"format": "xlsx"}).status_code == 422
    assert client.get(f"{TWIN}/telemetry/export", params={"start": 1e9}).text == "time,T_px,T_tank,Q_px\r\n"


def test_a_deleted_twin_goes_bit_by_bit_and_its_room_is_given_back(make_client: Any, sql: Sql) -> None:
    client = make_client(FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    for first in range(0, 40_000, 2000):
        ingest(client, first, 2000)
    calibrate(client, {})
    client.get(f"{TWIN}/residuals")
    assert client.delete(TWIN).status_code == 204
    assert client.get(TWIN).status_code == 404
    assert client.post("/v1/twins", json=SPEC).status_code == 201
    assert client.get(TWIN).json()["samples"] == 0
    assert client.post(f"{TWIN}/telemetry", json={"time": [1], "values": {"T_px": [290.0]}}).json()["accepted"] == 1
    room = "SELECT 0" if STORE == "postgres" else "PRAGMA freelist_count"  # PostgreSQL gives it back by itself
    until(lambda: sql("SELECT count(*) FROM twin") + sql(room) == [(1,), (0,)])
    for table in ("chunk", "residual", "checkpoint", "job", "model"):
        assert sql(f"SELECT count(*) FROM {table} WHERE twin = 1") == [(0,)]


def test_residuals_take_less_room_than_the_archive_and_go_with_their_model(
    make_client: Any, sql: Sql, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def idle(self: Housekeeping) -> None:
        """Leave the sweep to the test: a process that comes to lead sweeps, too."""

    monkeypatch.setattr(Housekeeping, "_sweep", idle)
    client = make_client(FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    for first in range(0, 9000, 3000):
        ingest(client, first, 3000)
    for _ in range(3):
        calibrate(client, {"activate": True})
        assert client.get(f"{TWIN}/residuals").json()["samples"] == 9000
    size = "SELECT sum(length(seq) + length(time) + length(value)) FROM {} WHERE twin = 1"
    ((archive,),) = sql(size.format("chunk").replace("length(value)", "length(value) + length(received)"))
    ((one,),) = sql(size.format("residual") + " AND version = 3")
    assert float(one) <= 0.75 * float(archive)
    other = client.post("/v1/twins", json={**SPEC, "twin": "of-no-concern"})
    database = client.app.state.service.database
    assert other.status_code == 201 and client.portal.call(database.read, retention.due) == [1]
    while client.portal.call(database.write_to, 1, retention.sweep_old, 1):
        pass
    assert sql(size.format("residual")) <= [(archive,)]
    assert client.get(f"{TWIN}/residuals").json()["samples"] == 9000


def test_retention_keeps_what_it_says(make_client: Any) -> None:
    client = make_client(FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    for first in range(0, 9000, 1000):
        ingest(client, first, 1000)
    for _ in range(4):
        calibrate(client, {"activate": True})
    assert client.delete(f"{TWIN}/models/4").status_code == 409
    assert client.delete(f"{TWIN}/models/1").status_code == 204
    assert client.delete(f"{TWIN}/models/1").status_code == 404
    kept = {"samples_days": 3000 / 86_400, "residuals_days": None, "models": 0, "jobs": 1}
    assert client.request("PUT", f"{TWIN}/retention", json=kept).json() == kept
    assert client.get(f"{TWIN}/retention").json() == kept

    def versions() -> list[int]:
        return [model["version"] for model in client.get(f"{TWIN}/models").json()["models"]]

    until(lambda: versions() == [3, 4] and client.get(TWIN).json()["samples"] <= 4000)  # the active one and its parent
    archive = client.get(f"{TWIN}/telemetry").json()
    assert archive["samples"] >= 3000
    assert archive["time"][0] == client.get(TWIN).json()["first_time"]
    assert len(client.get(f"{TWIN}/calibrations").json()["jobs"]) == 1
    assert client.get(f"{TWIN}/forecast", params={"horizon_s": 10}).json()["behind_s"] == 0.0
    for wrong in ({"samples_days": -1}, {"residuals_days": 1e300}, {"jobs": 10**30}):  # what no database can count back
        assert client.request("PUT", f"{TWIN}/retention", json=wrong).status_code == 422
