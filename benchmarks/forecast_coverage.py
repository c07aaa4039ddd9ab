"""Do the forecast's bands cover what came, with inputs as planned, as assumed (auto), and held? FEM orbits, flight sets.

Each spacecraft is calibrated on fourteen orbits (healthy), or diagnosed on them (with a hidden effect, which the corrected
model then carries); then forecasts of three orbits start at moments that neither saw. A flight set is calibrated on its first
60 %; forecasts over a twentieth of the record start in the rest. A 90 % band should hold 85 to 95 % of the readings, and the
simultaneous band all of one orbit's (of one horizon's) with 90 %. ``python -m benchmarks.forecast_coverage [--spacecraft N]
[--effects none random] [--starts N] [--sets ROOT]`` writes ``benchmarks/tables/forecast_coverage.md``; without
spacecraft (``--spacecraft 0``) the flight sets have a table of their own, ``forecast_coverage_flight.md``.
"""

import argparse
import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.markdown import markdown_table, save_table
from twin_core.calibrate import CalibratedModel, calibrate
from twin_core.closed_loop import close_loop
from twin_core.fem.demo import ORBIT_S, demo_scenario
from twin_core.fem.scenario import load_scenario
from twin_core.fem.simulate import simulate
from twin_core.forecast import forecast
from twin_core.network.screened import screened
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record
from twin_core.telemetry_csv import read_csv

TRAIN_ORBITS, HORIZON_ORBITS = 14, 3
APART_ORBITS = 1.3
"""Between two starts: no multiple of an orbit, so that they see every phase."""
LEVELS = (0.05, 0.5, 0.95)
MODES = ("plan", "auto", "hold")
FLIGHT_SETS = {
    "chandra_psmc": ("chandra-psmc.yaml", "flight_a.csv"),
    "flexhouse_prbs": ("flexhouse.yaml", "prbs_2009.csv"),
    "three_block_tue": ("three-block.yaml", "three_block_24h.csv"),
}
TRAIN_SHARE, HORIZON_SHARE, FLIGHT_STARTS = 0.6, 0.05, 12
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
Row = list[str]


def spacecraft(seed: int, effect: str, starts: int) -> tuple[CalibratedModel, Record]:
    """Return the model of a spacecraft after fourteen orbits, and its whole record."""
    scenario, spec = demo_scenario(effect, seed)
    body = scenario.model_dump(mode="json", exclude_none=True)
    orbits = TRAIN_ORBITS + APART_ORBITS * (starts - 1) + HORIZON_ORBITS + 0.1
    body["time"]["duration_s"] = orbits * ORBIT_S
    record = simulate(load_scenario(body)).record
    train = record.take(record.time_s < TRAIN_ORBITS * ORBIT_S)
    if effect == "none":
        return calibrate(spec, [train]), record
    return close_loop(spec, [train], holdout=0.2).model, record


def coverage(
    model: CalibratedModel,
    record: Record,
    cuts_s: Sequence[float],
    horizon_s: float,
    step_s: float,
    parts: int,
    mode: str,
) -> tuple[np.ndarray, np.ndarray]:
    """Return how many readings lie in the band, by part of the horizon, and how often a sensor's whole path does."""
    inside, whole = [], []
    for cut_s in cuts_s:
        past = record.take(record.time_s <= cut_s)
        plan = record.take((record.time_s > cut_s) & (record.time_s <= cut_s + horizon_s + step_s))
        options = {"plan": plan} if mode == "plan" else {"inputs": mode}
        for length_s in (horizon_s, horizon_s / parts):
            made = forecast(model, past, length_s, step_s=step_s, quantiles=LEVELS, **options)
            at = np.minimum(np.searchsorted(record.time_s, made.time_s - 1e-6), record.time_s.size - 1)
            read = np.stack([record.values[s][at] for s in made.sensors], axis=1)
            read[np.abs(record.time_s[at] - made.time_s) > 0.01 * step_s] = np.nan
            missing = np.isnan(read)
            held = np.where(missing, np.nan, (read >= made.quantiles_K[0.05]) & (read <= made.quantiles_K[0.95]))
            if length_s == horizon_s:
                inside.append([np.nanmean(part) for part in np.array_split(held, parts)])
            if length_s == horizon_s / parts:
                whole.append((missing | ((read >= made.whole_K[0]) & (read <= made.whole_K[1]))).all(axis=0))
    return np.array(inside), np.array(whole, dtype=np.float64)


def flight(name: str, root: Path) -> tuple[CalibratedModel, Record, list[float], float]:
    """Return model, record, starts and horizon of a measured set."""
    specification, file = FLIGHT_SETS[name]
    spec = load_spec(EXAMPLES / specification)
    record = screened(spec, read_csv(root / name / file, spec))
    span_s = float(np.ptp(record.time_s))
    first_s = float(record.time_s[0]) + TRAIN_SHARE * span_s
    horizon_s = HORIZON_SHARE * span_s
    cuts = np.linspace(first_s, float(record.time_s[-1]) - 1.01 * horizon_s, FLIGHT_STARTS)
    return calibrate(spec, [record.take(record.time_s <= first_s)]), record, cuts.tolist(), horizon_s


def rows_of(
    label: Row, count: Callable[[str], tuple[np.ndarray, np.ndarray]]
) -> Iterator[tuple[Row, np.ndarray, float]]:
    """Yield one line of the table per mode, with its figures."""
    for mode in MODES:
        inside, whole = count(mode)
        ahead = [f"{share:.1%}" for share in inside.mean(axis=0)]
        error = inside.mean(axis=1).std(ddof=1) / np.sqrt(len(inside))
        row = [
            *label,
            mode,
            f"{inside.mean():.1%} ± {error:.1%}",
            ", ".join(ahead),
            f"{whole.mean():.0%} of {whole.size}",
        ]
        print(" | ".join(row), flush=True)
        yield row, inside.mean(axis=0), float(whole.mean())


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--spacecraft", type=int, default=4, help="how many spacecraft of each kind, from seed 0")
    parser.add_argument("--effects", nargs="*", default=["none", "random"], choices=["none", "random"])
    parser.add_argument("--starts", type=int, default=8, help="forecasts of each")
    parser.add_argument("--sets", type=Path, default=os.environ.get("MEASURED_DATA"), help="folder of measured sets")
    arguments = parser.parse_args()
    rows: list[Row] = []
    totals: dict[str, list[tuple[np.ndarray, float]]] = {mode: [] for mode in MODES}
    cuts = [(TRAIN_ORBITS + APART_ORBITS * k) * ORBIT_S for k in range(arguments.starts)]
    for effect in arguments.effects:
        for seed in range(arguments.spacecraft):
            model, record = spacecraft(seed, effect, arguments.starts)
            carried = ", ".join(e.name for e in model.effects) or "-"
            label = [f"orbits {seed}", effect, carried]
            orbits = partial(coverage, model, record, cuts, HORIZON_ORBITS * ORBIT_S, 60.0, HORIZON_ORBITS)
            for row, inside, whole in rows_of(label, orbits):
                rows.append(row)
                totals[row[3]].append((inside, whole))
    for mode, found in totals.items():
        if found:
            ahead = np.mean([inside for inside, _ in found], axis=0)
            shares, whole = ", ".join(f"{share:.1%}" for share in ahead), np.mean([w for _, w in found])
            error = (
                np.std([inside.mean() for inside, _ in found], ddof=1) / np.sqrt(len(found))
                if len(found) > 1
                else np.nan
            )
            rows.append(["all orbits", "", "", mode, f"{ahead.mean():.1%} ± {error:.1%}", shares, f"{whole:.0%}"])
    for name in FLIGHT_SETS if arguments.sets else ():
        if not ((arguments.sets / name).is_dir() and (EXAMPLES / FLIGHT_SETS[name][0]).is_file()):
            continue
        model, record, starts, horizon_s = flight(name, arguments.sets)
        step_s = float(np.median(np.diff(record.time_s)))
        label = [name, "", f"horizon {horizon_s / 3600:.3g} h"]
        count = partial(coverage, model, record, starts, horizon_s, step_s, 1)
        rows += [row for row, _, _ in rows_of(label, count)]
    header = [
        "record",
        "hidden",
        "effects of the model",
        "inputs",
        "in the 90 % band",
        "by orbit ahead",
        "whole orbit inside",
    ]
    note = (
        "The readings are those of the sensors, noise included. plan: inputs as they came; auto: no plan, periodic inputs "
        "repeat and the others hold; hold: no plan, all hold. whole orbit inside: share of sensors and starts whose every "
        "reading of the first orbit (of the horizon, on flight sets) lies in the simultaneous 90 % band. ±: standard error, from "
        "how the starts of a record differ, or the spacecraft."
    )
    table = markdown_table(header, rows)
    name, of = ("forecast_coverage", "") if arguments.spacecraft else ("forecast_coverage_flight", " on flight sets")
    save_table(name, f"Coverage of the forecast's bands{of}", table, "benchmarks.forecast_coverage", note)


if __name__ == "__main__":
    main()
