"""The model of Chandra's power-supply box as it flew, imported, against the predictions that the flown software made of it."""

import csv
import os
from pathlib import Path

import numpy as np
import pytest

from twin_core._typing import FloatArray
from twin_core.constants import ZERO_CELSIUS_K
from twin_core.interchange.xija import read_xija
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.orbit.sun import sun_direction
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record
from twin_core.units import J2000_NS, parse_instant_ns

MODELS = Path(os.environ.get("FOREIGN_MODELS", Path(__file__).parents[4] / "shared" / "models")) / "xija"
STEP_S = 328.0

REFUSED = {"pm2thv1t_spec_radiative_coupling.json": "RadiativeCoupling"}
"""The one specification with a component that has no counterpart."""

pytestmark = pytest.mark.skipif(not MODELS.is_dir(), reason="the flown models are not beside this checkout")


def _table(path: Path) -> dict[str, list[str]]:
    with path.open() as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    return {name: [row[name] for row in rows] for name in rows[0]}


def _numbers(table: dict[str, list[str]], name: str) -> FloatArray:
    return np.array(table[name], dtype=np.float64)


def _precession(epoch_ns: int) -> FloatArray:
    """Return the matrix that turns vectors of the equator of 2000 into those of the date (Lieske 1979, linear terms)."""
    centuries = (epoch_ns - J2000_NS) / 86_400e9 / 36_525.0
    zeta, theta = np.radians(0.6406161 * centuries), np.radians(0.5567530 * centuries)

    def about_z(angle: float) -> FloatArray:
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    c, s = np.cos(theta), np.sin(theta)
    return about_z(-zeta) @ np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]) @ about_z(-zeta)


def _off_nominal_roll_deg(states: dict[str, list[str]], epoch_ns: int, first_s: float) -> FloatArray:
    """Return atan2(-y, -z) of the Sun in the body frame at the middle of each state."""
    q1, q2, q3, q4 = (_numbers(states, f"q{i}") for i in (1, 2, 3, 4))
    middle_s = 0.5 * (_numbers(states, "tstart") + _numbers(states, "tstop"))
    x, y, z = (
        sun_direction(epoch_ns, middle_s - first_s) @ _precession(epoch_ns)
    ).T  # the quaternions' equator: of 2000
    body_y = 2 * (q1 * q2 - q3 * q4) * x + (-(q1**2) + q2**2 - q3**2 + q4**2) * y + 2 * (q2 * q3 + q1 * q4) * z
    body_z = 2 * (q1 * q3 + q2 * q4) * x + 2 * (q2 * q3 - q1 * q4) * y + (-(q1**2) - q2**2 + q3**2 + q4**2) * z
    return np.degrees(np.arctan2(-body_y, -body_z))


def _week(folder: Path) -> tuple[Record, FloatArray]:
    """Return the commanded states of a week as telemetry, and which rows are instants of the stored prediction.

    Xija's first method takes its inputs at the instants of the prediction, two to a step, h (f_0 / 2 + f_1), and writes what
    h (f_0 / 2 + f_1 / 2) gives for the instant between: here the second one's inputs begin after a third of the step, and the
    instant between is read after two thirds. Pitch is interpolated, the other states are those in force.
    """
    states, stored = _table(folder / "states.dat"), _table(folder / "temperatures.dat")
    time_s, epoch_ns = _numbers(stored, "time"), parse_instant_ns(stored["date"][0])
    first = _numbers(states, "tstart")
    force = np.clip(np.searchsorted(first, time_s, side="right") - 1, 0, first.size - 1)
    columns = {n: _numbers(states, n)[force] for n in ("fep_count", "ccd_count", "vid_board", "clocking")}
    columns["sim_z"] = _numbers(states, "simpos")[force]
    columns["roll"] = _off_nominal_roll_deg(states, epoch_ns, float(time_s[0]))[force]
    columns["pitch"] = np.interp(time_s, first, _numbers(states, "pitch"))
    columns |= {"eclipse": np.zeros(time_s.size), "dh_heater": np.zeros(time_s.size)}
    at_s = time_s - time_s[0]
    effective_s = np.where(np.arange(at_s.size) % 2 == 1, at_s - STEP_S / 3.0, at_s)
    read_s = np.where(np.arange(at_s.size) % 2 == 1, at_s + STEP_S / 3.0, at_s)
    axis = np.union1d(read_s, effective_s)
    source = np.searchsorted(effective_s, axis, side="right") - 1
    values = {name: column[source] for name, column in columns.items()}
    temperature = np.full(axis.size, np.nan)
    temperature[np.isin(axis, read_s)] = _numbers(stored, "1pdeaat") + ZERO_CELSIUS_K
    return Record(axis, {**values, "T_1pdeaat": temperature}, epoch_ns), temperature


def test_the_flown_model_repeats_its_own_predictions() -> None:
    imported = read_xija((MODELS / "psmc_test_spec.json").read_text(), "psmc", hidden=["pin1at"], held=True)
    assert not imported.refused
    network = build_network(load_spec(imported.data))
    errors = {}
    for folder in sorted((MODELS / "psmc_runs").iterdir()):
        record, stored = _week(folder)
        forcing = build_forcing(network, record, 1e9)
        box = network.nodes.index("n1pdeaat")
        start_K = np.full(
            len(network.nodes), stored[0] - 10.0
        )  # as the flown software starts the node without telemetry
        start_K[box] = stored[0]
        path = rollout(network, network.parameters.values, start_K, forcing)
        assert path.converged
        errors[folder.name] = (path.at_samples(forcing.sample_step)[:, box] - stored)[np.isfinite(stored)]
    rms = {name: float(np.sqrt(np.mean(e**2))) for name, e in errors.items()}
    assert max(rms.values()) < 0.1, rms


@pytest.mark.parametrize("path", sorted((MODELS / "specs").glob("*.json")), ids=lambda path: path.stem)
def test_every_flown_model_is_translated_or_refused_by_name(path: Path) -> None:
    if path.stem.endswith("fit_log"):
        return
    imported = read_xija(path.read_text(), path.name)
    assert len(imported.refused) == (path.name in REFUSED)
    assert all(REFUSED[path.name] in line and "line " in line for line in imported.refused)
    assert build_network(load_spec(imported.data), table_knots={}).nodes
