"""The long format: what its rows say is what the other routes say, and the dashboards find every column that they name."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.service.conftest import SPEC, MakeClient
from tests.service.fakes import FakeWorkbench
from tests.service.harness import AppClient, until

GRAFANA = Path(__file__).parents[2] / "replay" / "bridges" / "grafana"
BEGUN_S = 1_772_323_200
LIMITED = {
    **SPEC,
    "channels": {**SPEC["channels"], "T_px": {**SPEC["channels"]["T_px"], "limits": {"red": [250, 298]}}},
}


@pytest.fixture
def client(make_client: MakeClient) -> AppClient:
    """A service whose twin has had an anomaly and exceeded a limit."""
    client = make_client(workbench=FakeWorkbench)
    assert client.post("/v1/twins", json=LIMITED).status_code == 201
    ks = range(120)
    leaps = [290.0 + 0.001 * k + (9.0 * (k % 4 // 2) if 50 <= k < 70 else 0.0) for k in ks]
    values = {"T_px": leaps, "T_tank": [15.0] * 120, "Q_px": [0.5, None] * 60}
    columns = {"time": [BEGUN_S + 60 * k for k in ks], "values": values}
    assert client.post("/v1/twins/benchsat/telemetry", json=columns).status_code == 200
    job = client.post("/v1/twins/benchsat/calibrations", json={}).json()
    until(lambda: client.get(f"/v1/twins/benchsat/calibrations/{job['id']}").json()["state"] == "succeeded")
    until(lambda: client.get("/v1/twins/benchsat/anomalies").json()["anomalies"])
    until(lambda: client.get("/v1/twins/benchsat/alarms").json()["alarms"])
    return client


def rows(client: AppClient, what: str, **query: Any) -> list[dict[str, Any]]:
    answer = client.get(f"/v1/twins/benchsat/rows/{what}", params=query)
    assert answer.status_code == 200, answer.text
    found: list[dict[str, Any]] = answer.json()
    return found


def test_rows_say_what_the_columns_say(client: AppClient) -> None:
    archive = client.get("/v1/twins/benchsat/telemetry").json()
    found = rows(client, "telemetry")
    for name, column in archive["values"].items():
        own = [(row["time"], row["value"]) for row in found if row["channel"] == name]
        assert own == [pair for pair in zip(archive["time"], column, strict=True) if pair[1] is not None]
    assert {row["channel"]: row["unit"] for row in found} == {"T_px": "K", "T_tank": "degC", "Q_px": "W"}
    residuals = client.get("/v1/twins/benchsat/residuals").json()
    own = [row for row in rows(client, "residuals") if row["channel"] == "T_px"]
    assert [row["residual_K"] for row in own] == residuals["residual_K"]["T_px"]
    assert [row["std_K"] for row in own] == residuals["std_K"]["T_px"]
    (anomaly, *_) = client.get("/v1/twins/benchsat/anomalies").json()["anomalies"]
    (first, *_) = rows(client, "anomalies")
    assert (first["time"], first["sensor"], first["message"]) == (
        anomaly["start"],
        anomaly["sensor"],
        anomaly["message"],
    )
    assert first["lasts"] == (anomaly["stop"] is None) and (first["lasts"] or first["time_end"] == anomaly["stop"])
    assert {row["colour"] for row in rows(client, "alarms")} == {"red"}


def test_rows_can_be_few(client: AppClient) -> None:
    stop = BEGUN_S + 600
    assert {row["channel"] for row in rows(client, "telemetry", stop=stop, channels="T_px,Q_px")} == {"T_px", "Q_px"}
    assert len(rows(client, "telemetry", stop=stop, channels="T_px")) == 10
    thin = rows(client, "telemetry", channels="T_px", max_points=10)
    assert len(thin) <= 10 and max(row["value"] for row in thin) > 298.0  # extremes stay
    assert {row["channel"] for row in rows(client, "residuals", channels="T_tank,Q_px")} == {"T_tank"}
    ahead = rows(client, "forecast", stop=BEGUN_S + 119 * 60 + 600, max_points=20, channels="T_px")
    assert len(ahead) == 20 and all(row["q05"] < row["mean"] < row["q95"] for row in ahead)
    assert rows(client, "forecast", stop=BEGUN_S) == []


@pytest.mark.parametrize("what", ["telemetry", "residuals", "forecast"])
def test_unknown_channels_are_named(client: AppClient, what: str) -> None:
    answer = client.get(f"/v1/twins/benchsat/rows/{what}", params={"channels": "T_px,nobody", "stop": BEGUN_S + 10_000})
    assert answer.status_code == 422 and "nobody" in answer.text
    assert client.get(f"/v1/twins/none/rows/{what}").status_code == 404


def queries(part: Any) -> Iterator[dict[str, Any]]:
    """Yield every query of the Infinity data source in a dashboard, those of variables and annotations too."""
    if isinstance(part, dict):
        if "url" in part and "columns" in part:
            yield part
        part = list(part.values())
    if isinstance(part, list):
        for item in part:
            yield from queries(item)


def filled(text: str) -> str:
    """Return text as Grafana fills it in."""
    known = {"twin": "benchsat", "sensor:csv": "T_px,T_tank"}
    known |= {"__from:date:iso": "2026-03-01T00:00:00.000Z", "__to:date:iso": "2026-03-01T03:00:00.000Z"}
    return re.sub(r"\$\{([^}]+)\}", lambda match: known[match[1]], text)


@pytest.mark.parametrize("name", ["twin.json", "fleet.json"])
def test_dashboards_find_what_they_name(client: AppClient, name: str) -> None:
    board = json.loads((GRAFANA / "dashboards" / name).read_text())
    asked = list(queries(board))
    assert asked
    for query in asked:
        pairs = {pair["key"]: filled(pair["value"]) for pair in query["url_options"].get("params", ())}
        answer = client.get(filled(query["url"]), params=pairs or None)
        assert answer.status_code == 200, (query["url"], answer.text)
        found = answer.json()[query["root_selector"]] if query["root_selector"] else answer.json()
        assert found, query["url"]
        assert {column["selector"] for column in query["columns"]} <= set(found[0]), query["url"]


def test_dashboards_use_what_is_provisioned() -> None:
    sources = yaml.safe_load((GRAFANA / "provisioning" / "datasources" / "thermal-twin.yaml").read_text())[
        "datasources"
    ]
    known = {(source["type"], source["uid"]) for source in sources}
    for path in (GRAFANA / "dashboards").glob("*.json"):
        text = path.read_text()
        board = json.loads(text)
        ids = [panel["id"] for panel in board["panels"]]
        assert len(set(ids)) == len(ids) and board["uid"]
        used = {(s["type"], s["uid"]) for s in re_sources(board)}
        assert used <= known


def re_sources(part: Any) -> Iterator[dict[str, str]]:
    """Yield every reference to a data source."""
    if isinstance(part, dict):
        if isinstance(part.get("datasource"), dict):
            yield part["datasource"]
        part = list(part.values())
    if isinstance(part, list):
        for item in part:
            yield from re_sources(item)
