"""Do the forecast's bands cover what came? Held-out finite-element orbits, inputs as planned, effects included.

Each spacecraft is calibrated on fourteen orbits (healthy), or diagnosed on them (with a hidden effect, which the corrected
model then carries); then forecasts of three orbits start at several moments that neither saw. A 90 % band should hold
85 to 95 % of the readings. ``python -m benchmarks.forecast_coverage [--spacecraft N]`` writes
``benchmarks/tables/forecast_coverage.md``.
"""

import argparse

import numpy as np

from benchmarks.markdown import markdown_table, save_table
from twin_core.calibrate import CalibratedModel, calibrate
from twin_core.discover import close_loop
from twin_core.fem.demo import ORBIT_S, demo_scenario
from twin_core.fem.scenario import load_scenario
from twin_core.fem.simulate import simulate
from twin_core.forecast import forecast
from twin_core.telemetry import Record

TRAIN_ORBITS, TEST_ORBITS, HORIZON_ORBITS = 14, 12, 3
STARTS = (0.0, 3.1, 6.2, 8.9)
LEVELS = (0.05, 0.5, 0.95)


def spacecraft(seed: int, effect: str) -> tuple[CalibratedModel, Record]:
    """Return the model of a spacecraft after fourteen orbits, and its whole record."""
    scenario, spec = demo_scenario(effect, seed)
    body = scenario.model_dump(mode="json", exclude_none=True)
    body["time"]["duration_s"] = (TRAIN_ORBITS + TEST_ORBITS) * ORBIT_S
    record = simulate(load_scenario(body)).record
    train = record.take(record.time_s < TRAIN_ORBITS * ORBIT_S)
    if effect == "none":
        return calibrate(spec, [train]), record
    return close_loop(spec, [train], holdout=0.2).model, record


def coverage(model: CalibratedModel, record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Return which readings lie in the band, and which below the median, each (n_times, n_orbits_ahead, n_sensors)."""
    inside, below = [], []
    for start in STARTS:
        cut_s = (TRAIN_ORBITS + start) * ORBIT_S
        past = record.take(record.time_s <= cut_s)
        plan = record.take((record.time_s > cut_s) & (record.time_s <= cut_s + HORIZON_ORBITS * ORBIT_S + 60.0))
        made = forecast(model, past, HORIZON_ORBITS * ORBIT_S, step_s=60.0, plan=plan, quantiles=LEVELS)
        at = np.searchsorted(record.time_s, made.time_s - 1e-6)
        read = np.stack([record.values[s][at] for s in made.sensors], axis=1)
        shape = (HORIZON_ORBITS, -1, len(made.sensors))
        inside.append(((read >= made.quantiles_K[0.05]) & (read <= made.quantiles_K[0.95])).reshape(shape))
        below.append((read < made.quantiles_K[0.5]).reshape(shape))
    return np.concatenate(inside, axis=1), np.concatenate(below, axis=1)


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--spacecraft", type=int, default=4, help="how many spacecraft of each kind, from seed 0")
    count = parser.parse_args().spacecraft
    rows, every = [], []
    for effect in ("none", "random"):
        for seed in range(count):
            model, record = spacecraft(seed, effect)
            inside, below = coverage(model, record)
            every.append(inside)
            carried = ", ".join(e.name for e in model.effects) or "-"
            ahead = [f"{share:.1%}" for share in inside.mean(axis=(1, 2))]
            rows.append([str(seed), effect, carried, f"{inside.mean():.1%}", *ahead, f"{below.mean():.1%}"])
            print(" | ".join(rows[-1]), flush=True)
    total = np.concatenate(every, axis=1)
    ahead = [f"{share:.1%}" for share in total.mean(axis=(1, 2))]
    rows.append(["all", "", "", f"{total.mean():.1%}", *ahead, ""])
    header = [
        "seed",
        "hidden",
        "effects of the model",
        "in the 90 % band",
        "orbit 1",
        "orbit 2",
        "orbit 3",
        "below median",
    ]
    note = "The readings are those of the simulator's sensors, noise included; the inputs of the forecast are the planned ones."
    table = markdown_table(header, rows)
    save_table("forecast_coverage", "Coverage of the forecast's bands", table, "benchmarks.forecast_coverage", note)


if __name__ == "__main__":
    main()
