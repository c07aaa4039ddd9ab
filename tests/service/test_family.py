"""What spacecraft of one design tell each other: where parameters lie, who is unlike the others, which effects to look for."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.store import anomalies, fleet, models, twins
from service.store.anomalies import Change
from service.store.database import Database
from service.workbench.core import _beside_family, _with_prior
from service.workbench.interface import CalibrationTask, DiagnosisTask, Outcome, Progress
from tests.helpers import conductive_spec, model_of
from tests.service.conftest import SPEC, MakeClient
from tests.service.fakes import FakeWorkbench
from tests.service.test_jobs import feed, finish, start
from twin_core.calibrate.result import CalibratedModel
from twin_core.network.spec_io import load_spec

CAPACITIES = {"C:n0": 4e3, "C:n1": 6e3}


def sibling(seed: int, factor: float = 1.0, std: float = 0.02) -> CalibratedModel:
    """Return a model whose capacities lie 3 % from those of the design, one of them by a factor more."""
    rng = np.random.default_rng(seed)
    values = {name: value * float(np.exp(rng.normal(0, 0.03))) for name, value in CAPACITIES.items()}
    values["C:n1"] *= factor
    return model_of(load_spec(conductive_spec(2, [(0, 1)], twin=f"sat-{seed}")), values, std=std)


def test_a_family_is_the_prior_of_a_sibling_and_tells_who_is_unlike_it() -> None:
    siblings = {f"sat-{k}": sibling(k) for k in range(8)}
    declared = load_spec(conductive_spec(2, [(0, 1)], twin="sat-9"))
    prior = _with_prior(declared, siblings).nodes[1].capacity_J_per_K
    assert prior is not None and prior.guess == pytest.approx(6e3, rel=0.05) and 1.0 < prior.spread < 1.15
    assert set(_beside_family(sibling(9, factor=2.0), siblings)["family"]["differs"]) == {"C:n1"}
    assert _beside_family(sibling(9), siblings) == {"family": {"siblings": 8, "differs": {}}}


def test_two_siblings_or_those_of_another_network_are_no_family() -> None:
    declared = load_spec(conductive_spec(2, [(0, 1)], twin="sat-9"))
    two = {f"sat-{k}": sibling(k) for k in range(2)}
    other = model_of(load_spec(conductive_spec(3, [(0, 1), (1, 2)])), {}, std=0.02)
    for siblings in (two, two | {"other": other}):
        assert _with_prior(declared, siblings) is declared
        assert _beside_family(sibling(9), siblings) == {}


@pytest.fixture
def database(tmp_path: Path) -> Any:
    opened = Database(tmp_path / "twin.sqlite3")
    yield opened
    opened.close()


def test_siblings_are_the_other_twins_of_a_family_with_their_active_models(database: Database) -> None:
    def fill(connection: Any) -> dict[str, Any]:
        for name, family in (("a", "bus-1"), ("b", "bus-1"), ("c", "bus-10"), ("d", None), ("e", "bus-1")):
            twin, _ = twins.register(connection, name, {**SPEC, "twin": name} | ({"family": family} if family else {}))
            for version in (1, 2) if name != "e" else ():
                models.add(connection, twin.key, "manual", {}, {"of": name, "version": version})
                models.activate(connection, twin.key, version, "requested")
            models.activate(connection, twin.key, 1, "requested") if name == "b" else None
        return models.siblings(connection, "bus-1", "a")

    assert database.submit(fill).result() == {"b": {"of": "b", "version": 1}}


def test_what_is_unlike_its_family_is_an_anomaly_that_no_residual_ends(database: Database) -> None:
    def fill(connection: Any) -> tuple[list[str], list[int]]:
        twin = twins.register(connection, "benchsat", SPEC)[0].key
        models.add(connection, twin, "manual", {}, {})
        models.activate(connection, twin, 1, "requested")
        (row,) = anomalies.tell_family(connection, twin, 1, 50, {"C:px": 1e-6})
        assert row.score == pytest.approx(4.89, abs=0.01)  # the normal deviate of a two-sided p of 1e-6
        anomalies.apply(connection, twin, 1, [Change("T_px", "residual", 60, None, 5.0)], (0, 100))
        anomalies.apply(connection, twin, 1, [], (0, 100))
        anomalies.close(connection, twin, 1, 200, 300)
        lasting = [one.wire()["message"] for one in anomalies.select(connection, twin) if one.stop_us is None]
        return lasting, fleet.duties(connection)[twin].open_ids

    lasting, recalibrated = database.submit(fill).result()
    assert lasting == ["C:px is unlike its family"]
    assert recalibrated == []  # a new calibration would find the same


class Acquainted(FakeWorkbench):
    """Tells of the siblings that it is shown."""

    def calibrate(self, task: CalibrationTask, progress: Progress) -> Outcome:
        made = super().calibrate(task, progress)
        known = {"siblings": len(task.siblings), "differs": {"C:px": 1e-6} if task.siblings else {}}
        return Outcome(made.document, made.train, made.validation, [], extra={"family": known})

    def diagnose(self, task: DiagnosisTask, progress: Progress) -> Outcome:
        made = super().diagnose(task, progress)
        assert made.report is not None
        made.report["provenance"] = {"siblings": sorted(task.siblings)}
        return made


def test_jobs_are_shown_the_siblings(make_client: MakeClient) -> None:
    client = make_client(Acquainted)
    for name in ("benchsat", "second"):
        assert client.post("/v1/twins", json={**SPEC, "twin": name, "family": "bench"}).status_code == 201
    feed(client, 0.5)
    finish(client, start(client))
    assert client.get("/v1/twins/benchsat/anomalies").json()["anomalies"] == []
    times = list(range(120))
    values = {"T_px": [290.0] * 120, "T_tank": [1.0] * 120, "Q_px": [0.4] * 120}
    assert client.post("/v1/twins/second/telemetry", json={"time": times, "values": values}).status_code == 200
    job = client.post("/v1/twins/second/calibrations", json={}).json()
    finish(client, f"/v1/twins/second/calibrations/{job['id']}")
    (model,) = client.get("/v1/twins/second/models").json()["models"]
    assert model["family"] == {"siblings": 1, "differs": {"C:px": 1e-6}}
    (anomaly,) = client.get("/v1/twins/second/anomalies").json()["anomalies"]
    assert (anomaly["message"], anomaly["stop"]) == ("C:px is unlike its family", None)
    report = finish(client, start(client, "diagnoses"))["result"]
    assert report["provenance"] == {"siblings": ["second"]}
