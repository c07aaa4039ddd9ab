"""Do the forecast's bands cover what came, with inputs as planned, as assumed (auto), and held? FEM orbits, flight sets.

Each spacecraft is calibrated on fourteen orbits (healthy), or diagnosed on them (with a hidden effect, which the corrected
model then carries); then forecasts of three orbits start at moments that neither saw. Forecasts over a twentieth of a flight set
start in its last 40 %; it is calibrated anew before each of them, on all that came before, as ``TWIN_CALIBRATE_EVERY_S`` does
it, and once on the first 60 %. A 90 % band should hold 85 to 95 % of the readings, and the simultaneous band all of one orbit's
(of one horizon's) with 90 %. ``python -m benchmarks.forecast_coverage [--spacecraft N]
[--effects none random] [--starts N] [--sets ROOT]`` writes ``benchmarks/tables/forecast_coverage.md``; without
spacecraft (``--spacecraft 0``) the flight sets have a table of their own, ``forecast_coverage_flight.md``.

A flight set is one record, all of whose forecasts share the errors of its parameters: what share it ought to cover is told by
``--worlds N``, records of which the set's own model, misfit and noise are the truth, each calibrated and forecast anew.
"""

import argparse
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import accumulate
from pathlib import Path

import numpy as np

from benchmarks.markdown import markdown_table, save_table
from twin_core.assimilate import assimilate
from twin_core.calibrate import CalibratedModel, calibrate
from twin_core.closed_loop import close_loop
from twin_core.fem.demo import ORBIT_S, demo_scenario
from twin_core.fem.scenario import load_scenario
from twin_core.fem.simulate import simulate
from twin_core.forecast import forecast
from twin_core.network.dynamics import reading_offsets_K
from twin_core.network.screened import screened
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record
from twin_core.telemetry_csv import read_csv

TRAIN_ORBITS, HORIZON_ORBITS = 14, 3
APART_ORBITS = 1.3
"""Between two starts: no multiple of an orbit, so that they see every phase."""
LEVELS = (0.05, 0.5, 0.95)
MODES = ("plan", "auto", "hold")
FLIGHT_SETS = {
    "chandra_psmc": ("chandra-psmc.yaml", "flight_a.csv"),
    "funcube1": ("funcube1.yaml", "whole_orbit_2016-02-04.csv"),
    "flexhouse_prbs": ("flexhouse.yaml", "prbs_2009.csv"),
    "three_block_tue": ("three-block.yaml", "three_block_24h.csv"),
}
TRAIN_SHARE, HORIZON_SHARE, FLIGHT_STARTS = 0.6, 0.05, 12
START_SAMPLES = 20
"""Readings that tell where a simulated record starts."""
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
    models: Sequence[CalibratedModel],
    record: Record,
    cuts_s: Sequence[float],
    horizon_s: float,
    step_s: float,
    parts: int,
    mode: str,
) -> tuple[np.ndarray, np.ndarray]:
    """Return how many readings lie in the band, by part of the horizon, and how often a sensor's whole path does.

    ``models`` are those at each of ``cuts_s``.
    """
    inside, whole = [], []
    for model, cut_s in zip(models, cuts_s, strict=True):
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


def worlds(model: CalibratedModel, record: Record, count: int) -> Iterator[Record]:
    """Yield records with the inputs of one, whose readings are the model's rollout with its misfit and its noise."""
    network = model.network()
    values = network.parameters.values
    forcing = build_forcing(network, record, model.max_step_s)
    start_K = assimilate(model, record.take(np.arange(START_SAMPLES))).mean_K
    path = rollout(network, values, start_K, forcing)
    assert path.converged
    read = path.at_samples(forcing.sample_step)[:, network.sensor_node]
    read += reading_offsets_K(network, values, record.clock_s)
    for seed in range(count):
        rng = np.random.default_rng(seed)
        made = dict(record.values)
        for column, sensor in enumerate(model.spec.sensors):
            size_K = model.misfit_K[sensor]
            keep = np.exp(-np.diff(record.time_s, prepend=-np.inf) / model.misfit_length_s[sensor])
            shocks = size_K * np.sqrt(1.0 - keep**2) * rng.standard_normal(record.time_s.size)
            misfit = np.array(list(accumulate(zip(keep, shocks, strict=True), _next, initial=0.0))[1:])
            noise = model.noise_K[sensor] * rng.standard_normal(record.time_s.size)
            made[sensor] = np.where(np.isnan(record.values[sensor]), np.nan, read[:, column] + misfit + noise)
        yield replace(record, values=made)


def _next(now: float, step: tuple[float, float]) -> float:
    """Return an Ornstein-Uhlenbeck process after a step that keeps so much of it and adds so much."""
    return step[0] * now + step[1]


def world_rows(label: Row, model: CalibratedModel, record: Record, starts: list[float], count: int) -> Iterator[Row]:
    """Yield a line per mode: the mean over worlds, and how far one world lies from it."""
    horizon_s, step_s = HORIZON_SHARE * float(np.ptp(record.time_s)), float(np.median(np.diff(record.time_s)))
    found: dict[str, list[tuple[float, float]]] = {mode: [] for mode in MODES}
    for world in worlds(model, record, count):
        own = calibrate(model.spec, [world.take(world.time_s <= starts[0])])
        for mode in MODES:
            inside, whole = coverage([own] * len(starts), world, starts, horizon_s, step_s, 1, mode)
            found[mode].append((float(inside.mean()), float(whole.mean())))
            print(" | ".join([*label, mode, f"{inside.mean():.1%}"]), flush=True)
    for mode, shares in found.items():
        inside, whole = np.array(shares).T
        spread = f"one world lies {inside.std(ddof=1):.1%} from their mean"
        error = inside.std(ddof=1) / np.sqrt(count)
        yield [*label, mode, f"{inside.mean():.1%} ± {error:.1%}", spread, f"{whole.mean():.0%}"]


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
    parser.add_argument("--worlds", type=int, default=0, help="simulated records of each flight set")
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
            orbits = partial(
                coverage, [model] * len(cuts), record, cuts, HORIZON_ORBITS * ORBIT_S, 60.0, HORIZON_ORBITS
            )
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
        anew = [calibrate(model.spec, [record.take(record.time_s <= start_s)]) for start_s in starts]
        for when, models in (("anew", anew), ("once", [model] * len(starts))):
            label = [name, "", f"horizon {horizon_s / 3600:.3g} h, calibrated {when}"]
            count = partial(coverage, models, record, starts, horizon_s, step_s, 1)
            rows += [row for row, _, _ in rows_of(label, count)]
        if arguments.worlds > 1:
            rows += world_rows([name, f"{arguments.worlds} worlds", label[2]], model, record, starts, arguments.worlds)
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
        "how the starts of a record differ, or the spacecraft, or worlds: records simulated from the set's own model, misfit and "
        "noise, each calibrated anew. All forecasts of one record share the errors of its parameters, which ± does not know."
    )
    table = markdown_table(header, rows)
    name, of = ("forecast_coverage", "") if arguments.spacecraft else ("forecast_coverage_flight", " on flight sets")
    save_table(name, f"Coverage of the forecast's bands{of}", table, "benchmarks.forecast_coverage", note)


if __name__ == "__main__":
    main()
