"""Out again: a patch to the deck that a model came from, and a specification whose values are known."""

import json
import shutil
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest

from replay.cli.main import main
from tests.twin_core.interchange.test_decks import ESATAN
from tests.twin_core.network.test_declared_terms import data
from twin_core.calibrate.result import CalibratedModel
from twin_core.effects import REGISTRY, Effect
from twin_core.interchange.esatan import read_esatan
from twin_core.network.calibrated import with_values
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec


def model_of(spec_data: dict, *effects: Effect, **changed: float) -> CalibratedModel:  # type: ignore[type-arg]
    """Return a model at the declared values but some."""
    spec = load_spec(spec_data)
    parameters = build_network(spec, effects).parameters.updated(changed)
    zero = dict.fromkeys(spec.sensors, 0.1)
    return CalibratedModel(spec, effects, parameters.as_dict(), np.zeros((0, 0)), (), zero, zero, zero, 60.0)


def test_a_patch_puts_calibrated_couplings_into_the_deck(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec = read_esatan(ESATAN, "plate.d", channels={"n1": "T_plate"}, held=False).data
    changed = {"G:n1|n2": 0.15, "G:n1|n10": 0.6, "R:n12|n99": 0.02, "G:n1>n12": 0.04}
    model = model_of(spec, **changed, **{"G:n10|n11": 0.7})
    (tmp_path / "model.json").write_text(json.dumps(model.to_json()))
    deck, patch = tmp_path / "plate.d", tmp_path / "plate.patch"
    deck.write_text(ESATAN)
    assert main(["export", str(tmp_path / "model.json"), "--esatan", str(deck), "--out", str(patch)]) == 0
    assert "G:n10|n11 stands in no statement of its own" in capsys.readouterr().err
    if shutil.which("patch") is None:
        pytest.skip("patch is not installed")
    subprocess.run(["patch", "-p0", "-i", str(patch)], cwd=tmp_path, check=True, capture_output=True)
    again = build_network(load_spec(read_esatan(deck.read_text(), "plate.d", held=True).data)).parameters.as_dict()
    for name, value in changed.items():
        assert again[name] == pytest.approx(value, rel=1e-8), name
    assert again["G:n11|n12"] == pytest.approx(0.25)


def test_every_value_is_known_afterwards(tmp_path: Path) -> None:
    parameters = build_network(load_spec(data())).parameters
    moved = {parameters.parameters[i].name: 1.1 * parameters.parameters[i].value for i in parameters.free_index}
    model = model_of(data(), **moved)
    (tmp_path / "model.json").write_text(json.dumps(model.to_json()))
    for suffix in ("yaml", "json"):
        out = tmp_path / f"known.{suffix}"
        assert main(["export", str(tmp_path / "model.json"), "--spec", "--out", str(out)]) == 0
        known = build_network(load_spec(out)).parameters
        assert known.free_index.size == 0
        for name, value in model.values.items():
            if name != "C:skin":  # stores nothing: what stands for that follows from its couplings
                assert known.as_dict()[name] == pytest.approx(value), name
    assert with_values(model.spec, model.values)["parameters"]["joints"] == {"value": pytest.approx(1.32)}


def test_a_unit_and_plain_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    radiator = {
        "twin": "plate",
        "boundaries": {"space": {"value_K": 3.0}},
        "channels": {"T": {"kind": "temperature", "unit": "K"}},
        "nodes": [{"id": "a", "sensor": "T", "capacity_J_per_K": {"guess": 900.0}}],
        "radiators": [{"node": "a", "emissivity": 0.8, "area_m2": 0.1, "sink": "space"}],
    }
    (tmp_path / "model.json").write_text(json.dumps(model_of(radiator, **{"C:a": 800.0}).to_json()))
    unit, plain = tmp_path / "plate.fmu", tmp_path / "plate.json"
    assert main(["export", str(tmp_path / "model.json"), "--fmu", "--out", str(unit)]) == 0
    with zipfile.ZipFile(unit) as archive:
        assert {"modelDescription.xml", "sources/network.c", "sources/buildDescription.xml"} <= set(archive.namelist())
    assert main(["export", str(tmp_path / "model.json"), "--json", "--out", str(plain)]) == 0
    told = json.loads(plain.read_text())
    assert told["specification"]["nodes"][0]["capacity_J_per_K"] == {"value": 800.0}
    assert {"name": "C:a", "unit": "J/K", "value": 800.0, "std": None, "held": False} in told["parameters"]
    heaters = [{"node": "a", "thermostat": {"on_K": 280.0, "off_K": 282.0, "power_W": {"value": 5.0}}}]
    (tmp_path / "model.json").write_text(json.dumps(model_of(radiator | {"heaters": heaters}).to_json()))
    assert main(["export", str(tmp_path / "model.json"), "--fmu", "--out", str(unit)]) == 0
    drift = REGISTRY["sensor_drift"]({"sensor": "T"}, {"d_K_per_s": 1e-6}, {"t0_s": 0.0, "dated": False})
    (tmp_path / "model.json").write_text(json.dumps(model_of(radiator, drift).to_json()))
    assert main(["export", str(tmp_path / "model.json"), "--fmu", "--out", str(unit)]) == 2
    assert "fault of a sensor" in capsys.readouterr().err


def test_one_of_both(tmp_path: Path) -> None:
    assert main(["export", "m.json", "--out", str(tmp_path / "x")]) == 2
