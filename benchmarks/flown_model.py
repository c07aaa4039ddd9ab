"""A flown model, imported: does it repeat its own predictions, and what does flight telemetry say that it lacks?

``python -m benchmarks.flown_model [--deadline S]`` writes ``benchmarks/tables/flown_model.md``. The Xija model of Chandra's
ACIS power supply, the predictions that the flown software made from it and the telemetry are not part of the repository: they
lie in the folders that FOREIGN_MODELS and MEASURED_DATA name, by default ``../shared/models`` and ``../shared/data``.
"""

import argparse
import csv
import os
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.markdown import markdown_table, save_table
from benchmarks.measured_splits import DATA, ROOT
from twin_core._typing import FloatArray
from twin_core.closed_loop import close_loop
from twin_core.constants import ZERO_CELSIUS_K
from twin_core.interchange.xija.specification import read_xija
from twin_core.network.model import build_network
from twin_core.network.screened import screened
from twin_core.network.spec_io import load_spec
from twin_core.orbit.sun import sun_direction
from twin_core.report.phrasing import sentence
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record
from twin_core.telemetry_csv import read_csv
from twin_core.units import J2000_NS, parse_instant_ns

MODELS = Path(os.environ.get("FOREIGN_MODELS", ROOT.parent / "shared" / "models")) / "xija"
STEP_S = 328.0
BURN_IN_S = 86_400.0
COLUMNS = {
    "1pdeaat": "T_psmc_degC",
    "dpa_power": "P_dpa_W",
    "pitch": "pitch_deg",
    "roll": "roll_deg",
    "sim_z": "table_steps",
}
"""What the components of the model are called in the telemetry."""


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


def week(folder: Path) -> tuple[Record, FloatArray]:
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


def repeated_rms_K() -> dict[str, float]:
    """Return the rms by which the imported model misses each week of stored predictions, by name."""
    imported = read_xija((MODELS / "psmc_test_spec.json").read_text(), "psmc", hidden=["pin1at"], held=True)
    network = build_network(load_spec(imported.data))
    found = {}
    for folder in sorted((MODELS / "psmc_runs").iterdir()):
        record, stored = week(folder)
        forcing = build_forcing(network, record, 1e9)
        box = network.nodes.index("n1pdeaat")
        start_K = np.full(
            len(network.nodes), stored[0] - 10.0
        )  # as the flown software starts the node without telemetry
        start_K[box] = stored[0]
        path = rollout(network, network.parameters.values, start_K, forcing)
        error = (path.at_samples(forcing.sample_step)[:, box] - stored)[np.isfinite(stored)]
        found[folder.name] = float(np.sqrt(np.mean(error**2)))
    return found


def flight_model_rmse_K(data: Path) -> float:
    """Return the error of the prediction that flight operations made of the later flight, without its first day."""
    measured = pd.read_csv(data / "flight_b.csv")
    predicted = pd.read_csv(data / "flight_b_flight_model.csv")["T_psmc_degC"]
    after = pd.to_datetime(measured["time"]) - pd.to_datetime(measured["time"][0]) >= pd.Timedelta(seconds=BURN_IN_S)
    return float(np.sqrt(((predicted - measured["T_psmc_degC"])[after] ** 2).mean()))


def loop_row(data: Path, deadline_s: float) -> tuple[list[str], str]:
    """Close the loop on flight a with the model as it flew, measure on flight b, and say whether the time was enough."""
    constants = {"eclipse": 0.0, "dh_heater": 0.0}
    text = (MODELS / "psmc_test_spec.json").read_text()
    imported = read_xija(text, "psmc", channels=COLUMNS, constants=constants, hidden=["pin1at"], held=True)
    spec = load_spec(imported.data)
    train, later = (screened(spec, read_csv(data / name, spec)) for name in ("flight_a.csv", "flight_b.csv"))
    loop = close_loop(
        spec,
        [train],
        holdout=None,
        holdout_records=[later],
        burn_in_s=BURN_IN_S,
        deadline_s=deadline_s,
    )
    before, after = (f"{loop.report[when]['rmse_K']:.2f}" for when in ("before", "after"))
    said = "; ".join(sentence(finding) for finding in loop.report["findings"]) or "nothing"
    ended = any("the deadline ended the search" in notice for notice in loop.report["notices"])
    time = f"had {deadline_s:g} s, which " + ("cut it short" if ended else "it did not use up")
    return ["as it flew", before, after, loop.report["verdict"], said], time


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA / "chandra_psmc", help="folder of the telemetry")
    parser.add_argument("--deadline", type=float, default=900.0, help="seconds for the search")
    given = parser.parse_args()
    row, time = loop_row(given.data, given.deadline)
    table = markdown_table(["the imported model", "before, K", "after, K", "verdict", "what it lacks"], [row])
    weeks = ", ".join(f"{rms:.3f}" for rms in repeated_rms_K().values())
    note = (
        "Errors are open loop over flight b, but for its first day, which tells the initial state; the search saw flight a"
        f" alone and {time}. The prediction that flight operations made of the same rows, restarted from"
        f" telemetry every three weeks: {flight_model_rmse_K(given.data):.2f} K. With the commanded states of three weeks of"
        f" 2017 the imported model repeats the predictions of the flown software to {weeks} K rms."
    )
    print(table, note, sep="\n")
    save_table("flown_model", "A flown model, imported", table, "benchmarks.flown_model", note)


if __name__ == "__main__":
    main()
