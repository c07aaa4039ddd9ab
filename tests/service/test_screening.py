"""Samples that are no readings: stored as they came, masked for the filter, told with the residuals."""

import json
import time
from collections.abc import Collection, Mapping

import numpy as np
import pytest

from service.workbench.core import CoreWorkbench
from service.workbench.interface import ForecastTask, Masks, Telemetry
from tests.helpers import conductive_spec, model_of
from tests.service.conftest import SPEC
from tests.service.fakes import FakeWorkbench
from tests.service.harness import AppClient
from twin_core.network.spec_io import load_spec

TWIN = "/v1/twins/benchsat"


class ScreeningWorkbench(FakeWorkbench):
    """Filters like the fake one, yet looks at the readings as the real one does."""

    def screen(self, units: Mapping[str, str | None], inputs: Collection[str], telemetry: Telemetry) -> Masks:
        """Look for samples that are no readings."""
        return CoreWorkbench().screen(units, inputs, telemetry)


@pytest.fixture
def client(make_client) -> AppClient:
    client = make_client(workbench=ScreeningWorkbench)
    client.post("/v1/twins", json=SPEC)
    return client


def telemetry(n_times: int) -> dict[str, list[float]]:
    rng = np.random.default_rng(2)
    at = np.arange(n_times)
    return {
        "T_px": (290.0 + 5.0 * np.sin(at / 25.0) + rng.normal(0.0, 0.1, n_times)).tolist(),
        "T_tank": (15.0 + 2.0 * np.sin(at / 40.0) + rng.normal(0.0, 0.1, n_times)).tolist(),
        "Q_px": [0.5] * n_times,
    }


def send(client: AppClient, values: dict[str, list[float]], first: int, stop: int) -> None:
    part = {name: column[first:stop] for name, column in values.items()}
    body = {"time": list(range(first, stop)), "values": part}
    answer = client.post(f"{TWIN}/telemetry", json=body)
    assert answer.status_code == 200 and answer.json()["accepted"] == stop - first


def activate(client: AppClient) -> None:
    path = client.post(f"{TWIN}/calibrations", json={"activate": True}).headers["location"]
    while client.get(path).json()["state"] in ("queued", "running"):
        time.sleep(0.02)


def test_what_is_no_reading_is_stored_masked_and_told(client: AppClient) -> None:
    values = telemetry(400)
    values["T_px"][120] = 0.0
    values["T_tank"][200] = values["T_tank"][201] = -999.0
    values["T_px"][300] += 80.0
    send(client, values, 0, 350)
    activate(client)
    found = client.get(f"{TWIN}/residuals").json()
    for sensor, rows in (("T_px", [120, 300]), ("T_tank", [200, 201])):
        missing = [row for row, value in enumerate(found["residual_K"][sensor]) if value is None]
        assert set(rows) <= set(missing)
        assert max(abs(v) for v in found["residual_K"][sensor] if v is not None) < 2.0
    spans = {
        (sensor, span["start"], span["stop"], span["reason"], span["samples"])
        for sensor, rows in found["masked"].items()
        for span in rows
    }
    assert spans == {
        ("T_px", "1970-01-01T00:02:00Z", "1970-01-01T00:02:00Z", "sentinel", 1),
        ("T_px", "1970-01-01T00:05:00Z", "1970-01-01T00:05:00Z", "spike", 1),
        ("T_tank", "1970-01-01T00:03:20Z", "1970-01-01T00:03:21Z", "sentinel", 2),
    }
    archive = client.get(f"{TWIN}/telemetry").json()["values"]
    assert archive["T_px"][120] == 0.0 and archive["T_tank"][200] == -999.0


def test_a_marker_that_comes_live_is_masked_with_what_came_before_it(client: AppClient) -> None:
    values = telemetry(360)
    send(client, values, 0, 350)
    activate(client)
    values["T_tank"][350] = -999.0
    values["Q_px"][351] = -9999.0
    for row in range(350, 355):
        send(client, values, row, row + 1)
    found = client.get(f"{TWIN}/residuals", params={"start": 350}).json()
    missing = [value is None for value in found["residual_K"]["T_tank"]]  # the fake filter misses the next one, too
    assert missing[0] and not any(missing[2:]) and len(missing) == 5
    forecast = client.get(f"{TWIN}/forecast", params={"horizon_s": 10, "step_s": 5})
    assert forecast.status_code == 200
    assert [span["reason"] for span in found["masked"].get("T_tank", [])] == ["sentinel"]


def test_a_sensor_that_only_sends_markers_is_missed(client: AppClient) -> None:
    values = telemetry(400)
    values["T_tank"][300:] = [-999.0] * 100
    send(client, values, 0, 400)
    activate(client)
    client.get(f"{TWIN}/residuals")
    found = client.get(f"{TWIN}/anomalies").json()["anomalies"]
    assert {(row["sensor"], row["kind"]) for row in found} == {("T_tank", "dropout")}


def test_what_no_instrument_reads_and_nobody_writes_for_missing_is_refused(client: AppClient) -> None:
    body = {"time": [0.0], "values": {"T_tank": [-998.0]}}
    answer = client.post(f"{TWIN}/telemetry", json=body)
    assert answer.status_code == 422 and "no instrument reads -998" in answer.text


@pytest.mark.parametrize("at", [200, 399])
def test_a_marker_in_the_past_of_an_input_says_nothing_of_its_future(at: int) -> None:
    """One -999 degC of the boundary, the newest sample, once widened the band of the forecast to 80 K."""
    spec = load_spec(
        conductive_spec(
            1,
            [],
            channels={"T_out": {"kind": "temperature", "unit": "degC"}},
            boundaries={"outdoors": {"channel": "T_out"}},
            conductors=[{"between": ["n0", "outdoors"], "conductance_W_per_K": {"guess": 1.0}}],
        )
    )
    document = json.dumps(model_of(spec, {}).to_json())
    outdoors = 5.0 + np.sin(np.arange(400) / 30.0) + np.random.default_rng(1).normal(0.0, 0.05, 400)
    time_us = 60_000_000 * np.arange(400)
    now = Telemetry(0, time_us[-1:], {"T0": np.array([290.0]), "T_out": outdoors[-2:-1]})
    made = []
    for value in (-999.0, np.nan):
        past = outdoors.copy()
        past[at] = value
        task = ForecastTask(now, None, 3600.0, 600.0, None, (0.05, 0.95), past=Telemetry(0, time_us, {"T_out": past}))
        made.append(CoreWorkbench().forecast(document, task))
    for q in (0.05, 0.95):
        np.testing.assert_array_equal(made[0].quantiles[q]["T0"], made[1].quantiles[q]["T0"])
