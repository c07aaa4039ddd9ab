"""What a bridge decides without a server: configuration, units, wiring and which events there are."""

import zlib
from pathlib import Path
from typing import Any

import pytest

from replay.bridges.config import read_config
from replay.bridges.errors import BridgeError
from replay.bridges.events import SEVERITY, of_alarms, of_anomalies, of_diagnoses
from replay.bridges.instants import parse_utc_ms, service_ms, to_datetime, to_ms, to_text
from replay.bridges.units import conversion
from replay.bridges.yamcs_names import sensors_of
from service.schemas import Alarm, Anomaly, Job, TwinDetail

LEAST = {"twin": "sat", "parameters": {"T_a": "/SAT/T_a"}}


def test_the_least_configuration_suffices(tmp_path: Path) -> None:
    (tmp_path / "b.yaml").write_text("twin: sat\nparameters: {T_a: /SAT/T_a}\n")
    config = read_config(tmp_path / "b.yaml")
    assert config.root == "/THERMAL_TWIN/sat" and config.source == "thermal-twin/sat"
    assert config.parameters["T_a"].name == "/SAT/T_a" and config.parameters["T_a"].unit is None


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"twin": "Not An Id"}, "twin"),
        ({"parameters": {}}, "parameters"),
        ({"parameters": {"T_a": "T_a"}}, "no qualified name"),
        ({"parameters": {"T_a": "/S/x", "T_b": "/S/x"}}, "feeds both T_a and T_b"),
        ({"paramters": {}}, "paramters"),
        ({"forecast": {"lead_s": -1}}, "forecast.lead_s"),
        ({"backfill": {"start": "2026-03-01T00:00:00"}}, "the zone must be stated"),
        ({"backfill": {"start": "yesterday"}}, "no instant"),
    ],
)
def test_a_wrong_configuration_is_named(tmp_path: Path, change: dict[str, Any], told: str) -> None:
    import yaml

    path = tmp_path / "b.yaml"
    path.write_text(yaml.safe_dump(LEAST | change))
    with pytest.raises(BridgeError, match=told) as raised:
        read_config(path)
    assert str(path) in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize("text", ["[1, 2]", "a: [", "\x00"])
def test_what_is_no_configuration_is_told(tmp_path: Path, text: str) -> None:
    path = tmp_path / "b.yaml"
    path.write_text(text)
    with pytest.raises(BridgeError, match=r"b\.yaml"):
        read_config(path)
    with pytest.raises(BridgeError, match="cannot be read"):
        read_config(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("given", "wanted", "value", "expected"),
    [
        ("degC", "K", 20.0, 293.15),
        ("°C", "degC", 20.0, 20.0),
        ("kelvin", "degC", 0.0, -273.15),
        ("mW", "W", 250.0, 0.25),
        ("kW", "W", 1.5, 1500.0),
        ("%", "percent", 40.0, 40.0),
        ("deg", "deg", 3.0, 3.0),
        ("anything", None, 3.0, 3.0),
    ],
)
def test_units_convert(given: str, wanted: str | None, value: float, expected: float) -> None:
    convert = conversion(given, wanted)
    assert convert is not None and convert(value) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ("given", "wanted"), [("V", "K"), (None, "K"), ("degF", "K"), ("W", "percent"), ("rad", "deg")]
)
def test_units_that_do_not_fit_are_never_guessed(given: str | None, wanted: str) -> None:
    assert conversion(given, wanted) is None


def test_instants_survive_the_way_there_and_back() -> None:
    assert parse_utc_ms("2026-03-01T01:00:00.5+01:00") == parse_utc_ms("2026-03-01T00:00:00.500Z")
    for time_ms in (0, 1_772_323_200_001, 4_102_444_800_000):
        assert service_ms(to_text(time_ms)) == time_ms == to_ms(to_datetime(time_ms))
    assert service_ms("2026-03-01T00:00:00.000600Z") % 1000 == 1  # the service knows microseconds, Yamcs milliseconds


def test_every_event_has_its_severity_and_its_key() -> None:
    alarm = {"id": 3, "channel": "T_a", "side": "high", "limit": 40.0, "unit": "degC", "stop": None}
    alarm |= {"start": "2026-03-01T00:00:00Z", "message": "T_a is above", "acknowledged": None, "shelved_until": None}
    for (on, colour), severity in SEVERITY.items():
        (note,) = of_alarms([Alarm(**alarm, on=on, colour=colour)])
        assert note.severity == severity and note.number == zlib.crc32(b"alarm:3:begun") & 0x7FFFFFFF
    ended = Anomaly(
        id=1,
        sensor="T_a",
        start="2026-03-01T00:00:00Z",
        stop="2026-03-01T01:00:00Z",
        score=7.0,
        cause=None,
        message="T_a drifts",
    )
    begun, over = of_anomalies([ended])
    assert (begun.severity, over.severity) == ("warning", "info")
    assert over.time_ms - begun.time_ms == 3_600_000 and begun.number != over.number


def test_a_finding_is_told_with_place_numbers_and_a_link() -> None:
    found = {
        "effect": "missing_conductor",
        "where": {"nodes": ["a", "b"]},
        "parameters": {"G_W_per_K": {"mean": 2.0, "std": 0.125}},
    }
    times = {"created": "2026-03-01T00:00:00Z", "started": "2026-03-01T00:00:00Z", "finished": "2026-03-01T00:10:00Z"}
    job = {"id": "j1", "kind": "diagnosis", "state": "succeeded", "progress": 1.0, "message": "", **times}
    done = Job(**job, result={"verdict": "effect_added", "findings": [found]})
    none = Job(**job | {"id": "j2"}, result={"verdict": "no_effect_supported", "findings": []})
    failed = Job(**job | {"id": "j3", "state": "failed"}, result=None)
    finding, nothing = of_diagnoses([done, none, failed], "http://x/v1/twins/sat/diagnoses")
    link = "http://x/v1/twins/sat/diagnoses/j1/report.html"
    assert finding.message == f"missing_conductor at nodes a - b: G_W_per_K = 2 ± 0.12; report: {link}"
    assert finding.link == link and finding.severity == "watch"
    assert nothing.message.startswith("no effect supported") and nothing.severity == "info"


def test_only_sensors_of_nodes_are_published() -> None:
    """A boundary whose temperature is a channel is no sensor: the twin is given it and predicts nothing of it."""
    specification = {
        "channels": {name: {"kind": "temperature", "unit": "K"} for name in ("T_a", "T_bus", "T_b", "T_c")},
        "nodes": [{"id": "a", "sensor": "T_a"}, {"id": "b", "sensor": ["T_b", "T_c"]}, {"id": "hidden"}],
        "boundaries": {"bus": {"channel": "T_bus"}},
    }
    twin = TwinDetail.model_construct(channels=list(specification["channels"]), specification=specification)
    assert sensors_of(twin) == ["T_a", "T_b", "T_c"]
