"""The test that the declared model suffices: how often it is wrong while everybody looks at every sample, and how late it is.

Healthy records: a block that a heater and its sink drive is read by a sensor whose noise is normal, heavy-tailed, or cut into
steps; the noise is fitted to the first ``N_FIT`` readings as a calibration does, a Kalman filter of the true balance runs
over the rest, and every test sees its normalised innovations. Delays: a change of these sets in at ``ONSET``. Beside the
test stand universal inference with a normal and with Student's law, both with the scale refitted at every sample (Wasserman,
Ramdas and Balakrishnan, arXiv 1912.11436), and a two-sided CUSUM (Page) whose threshold is chosen so that it is wrong on
normal records as often as the level says. Then spacecraft of finite elements, calibrated on healthy orbits.

``python -m benchmarks.sufficiency [--records 10000] [--rivals 2000] [--looks 2000] [--spacecraft 12] [--first SEED]`` saves
``benchmarks/tables/sufficiency.md``.
"""

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numba import njit
from scipy.signal import lfilter
from scipy.stats import beta

from benchmarks.markdown import markdown_table, save_table
from twin_core.anomaly import adjusted, discoveries
from twin_core.anomaly.sufficiency import TOLERANCE, follow_evidence
from twin_core.assimilate import FLOOR_SHARE, assimilate
from twin_core.calibrate.noise import sensor_noise_K
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

N_FIT = 500
ONSET = 1000
LEVELS = (0.05, 0.01)
ORBIT = 95
KEEPS, SWING_K = 0.97, 8.0
"""What a block keeps of its temperature from one reading to the next, and how far its inputs drive it."""
Values = np.ndarray[Any, np.dtype[np.float64]]
Draw = Callable[[np.random.Generator, tuple[int, int]], Values]


def _normal(rng: np.random.Generator, shape: tuple[int, int]) -> Values:
    return rng.normal(size=shape)


def _student(rng: np.random.Generator, shape: tuple[int, int]) -> Values:
    return rng.standard_t(3, size=shape) / np.sqrt(3.0)


def _outliers(rng: np.random.Generator, shape: tuple[int, int]) -> Values:
    return rng.normal(size=shape) * np.where(rng.random(shape) < 0.05, 5.0, 1.0)


LAWS: dict[str, tuple[Draw, float]] = {
    "normal": (_normal, 0.0),
    "Student, 3 degrees of freedom": (_student, 0.0),
    "one in twenty five times as large": (_outliers, 0.0),
    "normal, steps of 1 σ": (_normal, 1.0),
    "normal, steps of 3 σ": (_normal, 3.0),
    "Student, steps of 2 σ": (_student, 2.0),
}
"""Noise of unit size, and the steps in which it is read."""

CHANGES: dict[str, Callable[[Values], Values]] = {
    "mean off by 0.5": lambda n: np.full(n.size, 0.5),
    "mean off by 1": lambda n: np.full(n.size, 1.0),
    "mean off by 2": lambda n: np.full(n.size, 2.0),
    "drift of 1 in 500 readings": lambda n: n / 500.0,
    "swing of 1.5 with every orbit": lambda n: 1.5 * np.sin(2.0 * np.pi * n / ORBIT),
}
"""What the normalised innovations have from the onset on, by readings since then."""


def innovations(rng: np.random.Generator, law: str, n_records: int, n_looks: int) -> Values:
    """Return normalised innovations of healthy records, (n_records, n_looks), filtered with noise that was fitted."""
    draw, step = LAWS[law]
    shape = (n_records, N_FIT + n_looks)
    phase = rng.uniform(0.0, 2.0 * np.pi, (n_records, 1))
    drive = (1.0 - KEEPS) * SWING_K * (1.0 + np.sin(2.0 * np.pi * np.arange(shape[1]) / ORBIT + phase))
    process = FLOOR_SHARE * rng.normal(size=shape)
    truth = lfilter([1.0], [1.0, -KEEPS], drive + process, axis=1)
    read = truth + draw(rng, shape)
    if step:
        read = step * np.round(read / step)
    noise = np.array([fitted_noise_K(row) for row in read[:, :N_FIT]])
    return _filtered(read, drive, noise)[:, N_FIT:]


SPEC = load_spec(
    {
        "twin": "block",
        "channels": {"T": {"kind": "temperature", "unit": "K"}},
        "nodes": [{"id": "block", "sensor": "T"}],
    }
)


def fitted_noise_K(column: Values) -> float:
    """Return the noise that a calibration takes from the readings of a sensor that declares none."""
    record = Record(60.0 * np.arange(column.size), {"T": column}, None, "block")
    return float(sensor_noise_K(SPEC, [record])[0])


@njit(cache=True)
def _filtered(read: Values, drive: Values, noise: Values) -> Values:
    """Return the normalised innovations of a Kalman filter that knows the balance, (n_records, n_times)."""
    out = np.empty(read.shape)
    for r in range(read.shape[0]):
        density = (FLOOR_SHARE * noise[r]) ** 2
        mean, variance = read[r, 0], noise[r] ** 2
        out[r, 0] = 0.0
        for k in range(1, read.shape[1]):
            mean = KEEPS * mean + drive[r, k]
            variance = KEEPS**2 * variance + density
            spread = variance + noise[r] ** 2
            innovation = read[r, k] - mean
            out[r, k] = innovation / np.sqrt(spread)
            mean += variance / spread * innovation
            variance *= noise[r] ** 2 / spread
    return out


def by_product(scaled: Values, tolerance: float = TOLERANCE) -> Values:
    """Return the log evidence of the product's own test after each look, (n_records, n_looks)."""
    out = np.empty(scaled.shape)
    for row, record in zip(out, scaled, strict=True):
        row[:] = follow_evidence(None, ["T"], record[:, None], tolerance)[1]
    return out


SHIFTS = np.array([0.0, 0.25, 0.5, 1.0, 2.0, -0.25, -0.5, -1.0, -2.0])


@njit(cache=True)
def by_normal(scaled: Values) -> Values:
    """Return the log ratio of shifted normal laws, one reading ahead, to the normal law of the best scale so far."""
    out = np.empty(scaled.shape)
    for r in range(scaled.shape[0]):
        shares = np.zeros(SHIFTS.size)
        shares[0] = 1.0
        squares, numerator = 100.0, 0.0
        total = 0.0
        for k in range(scaled.shape[1]):
            variance = squares / (k + 100.0)
            gone = shares[0] / (k + 101.0)
            shares[0] -= gone
            shares[1:] += gone / (SHIFTS.size - 1)
            z = scaled[r, k] / np.sqrt(variance)
            most = -0.5 * np.min((z - SHIFTS) ** 2)
            shares *= np.exp(-0.5 * (z - SHIFTS) ** 2 - most)
            whole = shares.sum()
            shares /= whole
            numerator += np.log(whole) + most - 0.5 * np.log(variance)
            squares += scaled[r, k] ** 2
            total += scaled[r, k] ** 2
            n = k + 1.0
            out[r, k] = numerator + 0.5 * n * (np.log(max(total, 1e-12) / n) + 1.0)
    return out


FREEDOMS = np.array([3.0, 5.0, 10.0, 100.0])
SCALES = np.exp(np.linspace(np.log(0.4), np.log(1.6), 15))


@njit(cache=True)
def by_student(scaled: Values) -> Values:
    """Return the same with Student's law: scale and degrees of freedom on a grid, refitted at every reading."""
    out = np.empty(scaled.shape)
    n_grid = FREEDOMS.size * SCALES.size
    constant = np.empty(n_grid)
    for g in range(n_grid):
        freedom, scale = FREEDOMS[g // SCALES.size], SCALES[g % SCALES.size]
        lg = math_lgamma(0.5 * (freedom + 1.0)) - math_lgamma(0.5 * freedom)
        constant[g] = lg - 0.5 * np.log(np.pi * freedom) - np.log(scale)
    for r in range(scaled.shape[0]):
        shares = np.zeros(SHIFTS.size)
        shares[0] = 1.0
        fits = np.zeros(n_grid)
        best = n_grid - SCALES.size // 2
        numerator = 0.0
        logs = np.empty(SHIFTS.size)
        for k in range(scaled.shape[1]):
            gone = shares[0] / (k + 101.0)
            shares[0] -= gone
            shares[1:] += gone / (SHIFTS.size - 1)
            freedom, scale = FREEDOMS[best // SCALES.size], SCALES[best % SCALES.size]
            for j in range(SHIFTS.size):
                z = scaled[r, k] / scale - SHIFTS[j]
                logs[j] = -0.5 * (freedom + 1.0) * np.log1p(z * z / freedom)
            most = logs.max()
            shares *= np.exp(logs - most)
            whole = shares.sum()
            shares /= whole
            numerator += np.log(whole) + most + constant[best]
            for g in range(n_grid):
                freedom, scale = FREEDOMS[g // SCALES.size], SCALES[g % SCALES.size]
                z = scaled[r, k] / scale
                fits[g] += constant[g] - 0.5 * (freedom + 1.0) * np.log1p(z * z / freedom)
                if fits[g] > fits[best]:
                    best = g
            best = np.argmax(fits)
            out[r, k] = numerator - fits[best]
    return out


@njit(cache=True)
def math_lgamma(x: float) -> float:
    """Return log Γ(x) by Stirling's series, to 1e-10 for x above 1.

    It is shifted up by eight before the series is used.
    """
    shift = 0.0
    while x < 9.0:
        shift -= np.log(x)
        x += 1.0
    series = 1.0 / (12.0 * x) - 1.0 / (360.0 * x**3) + 1.0 / (1260.0 * x**5)
    return shift + (x - 0.5) * np.log(x) - x + 0.5 * np.log(2.0 * np.pi) + series


@njit(cache=True)
def by_cusum(scaled: Values) -> Values:
    """Return the two-sided CUSUM with allowance 0.5 after each look, (n_records, n_looks)."""
    out = np.empty(scaled.shape)
    for r in range(scaled.shape[0]):
        up = down = 0.0
        for k in range(scaled.shape[1]):
            up = max(up + scaled[r, k] - 0.5, 0.0)
            down = max(down - scaled[r, k] - 0.5, 0.0)
            out[r, k] = max(up, down)
    return out


TESTS: dict[str, Callable[[Values], Values]] = {
    "the product's": by_product,
    "the same without tolerance": partial(by_product, tolerance=0.0),
    "universal inference, normal": by_normal,
    "universal inference, Student": by_student,
    "CUSUM": by_cusum,
}
OURS = ("the product's", "the same without tolerance")
BATCH = 500


def tops(law: str, n_records: int, n_looks: int, n_rivals: int) -> dict[str, Values]:
    """Return the greatest value that each test ever shows on healthy records, rivals on the first ones only."""
    rng = np.random.default_rng([list(LAWS).index(law), 17])
    found: dict[str, list[Values]] = {name: [] for name in TESTS}
    for first in range(0, n_records, BATCH):
        scaled = innovations(rng, law, min(BATCH, n_records - first), n_looks)
        for name, test in TESTS.items():
            if first < n_rivals or name in OURS:
                found[name].append(test(scaled).max(axis=1))
    return {name: np.concatenate(parts) for name, parts in found.items()}


def delay(test: str, change: str, threshold: float, n_records: int = 500, n_after: int = 3000) -> str:
    """Return the median readings from the onset of a change to the alarm, and the share of changes that are seen."""
    rng = np.random.default_rng(23)
    scaled = innovations(rng, "normal", n_records, ONSET + n_after)
    scaled[:, ONSET:] += CHANGES[change](np.arange(float(n_after)))
    hits = TESTS[test](scaled)[:, ONSET:] > threshold
    late = np.where(hits.any(axis=1), hits.argmax(axis=1), np.inf)
    median = float(np.median(late))
    share = float(np.isfinite(late).mean())
    return (
        "not seen" if not np.isfinite(median) else f"{median:.0f}" + ("" if share > 0.995 else f" ({share:.0%} seen)")
    )


def upper_bound(k: int, n: int) -> float:
    """Return the one-sided upper 95 % bound of a share (Clopper and Pearson)."""
    return 1.0 if k >= n else float(beta.ppf(0.95, k + 1, n - k))


def false_discoveries(rate: float = 0.1, n_fleets: int = 100, n_looks: int = 1500) -> tuple[float, float]:
    """Return false and true discovery shares over fleets of twenty twins, four of them off by 1, looked at all along."""
    rng = np.random.default_rng(31)
    false, found = [], []
    for _ in range(n_fleets):
        scaled = innovations(rng, "Student, 3 degrees of freedom", 20, n_looks)
        scaled[:4, 500:] += 1.0
        most = np.maximum.accumulate(by_product(scaled), axis=1)[:, -1]
        fallen = discoveries([adjusted(value) for value in most], rate)
        false.append(fallen[4:].sum() / max(fallen.sum(), 1))
        found.append(fallen[:4].mean())
    return float(np.mean(false)), float(np.mean(found))


def healthy_table(n_records: int, n_looks: int, n_rivals: int) -> tuple[str, dict[str, float]]:
    """Return how often each test is wrong, by law, and the thresholds at the lower level."""
    limits = {name: {level: float(np.log(1.0 / level)) for level in LEVELS} for name in TESTS}
    rows = []
    for law in LAWS:
        highest = tops(law, n_records, n_looks, n_rivals)
        if law == next(iter(LAWS)):
            limits["CUSUM"] = {level: float(np.quantile(highest["CUSUM"], 1.0 - level)) for level in LEVELS}
        shares = {n: " · ".join(f"{100 * (h > limits[n][a]).mean():.2f} %" for a in LEVELS) for n, h in highest.items()}
        rows.append([law, *shares.values()])
        print(rows[-1], flush=True)
    levels = " · ".join(f"{level:.0%}" for level in LEVELS)
    header = ["noise", *(f"{name}, at {levels}" for name in TESTS)]
    return markdown_table(header, rows), {name: limits[name][LEVELS[-1]] for name in TESTS}


def spacecraft_table(first: int, n_spacecraft: int) -> str:
    """Return what the test says on finite-element spacecraft after their calibration, healthy and with a fault."""
    from benchmarks.anomaly_events import ONSET_ORBIT, ORBIT_S, TRAIN_ORBITS, spacecraft

    counts: dict[str, list[float]] = {}
    for seed in range(first, first + n_spacecraft):
        model, runs = spacecraft(seed)
        for number, run in enumerate(runs):
            if run.fault == "none" and number == 0:
                continue  # the record that it was calibrated on
            done = assimilate(model, run.record)
            scored = run.record.time_s >= TRAIN_ORBITS * ORBIT_S
            _, log = follow_evidence(None, done.sensors, (done.innovation_K / done.innovation_std_K)[scored])
            hits = np.flatnonzero(log > np.log(1.0 / LEVELS[-1]))
            at_s = run.record.time_s[scored][hits[0]] if hits.size else np.inf
            begun_s = 0.0 if run.fault == "none" else ONSET_ORBIT * ORBIT_S
            early = run.fault != "none" and at_s < begun_s
            counts.setdefault(run.fault, []).append(-np.inf if early else float(at_s - begun_s))
        print(f"spacecraft {seed}", flush=True)
    rows = []
    for fault, delays in counts.items():
        seen = [d for d in delays if np.isfinite(d)]
        before = sum(d == -np.inf for d in delays)
        median = f"{np.median(seen) / 60.0:.0f} min" if seen and fault != "none" else "-"
        rows.append([fault, str(len(delays)), str(len(seen)), str(before), median])
    return markdown_table(["fault", "records", "refuted", "refuted before the fault", "median delay"], rows)


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=10_000)
    parser.add_argument("--rivals", type=int, default=2000, help="records that the other tests see")
    parser.add_argument("--looks", type=int, default=2000, help="readings after the fit, each of them looked at")
    parser.add_argument("--spacecraft", type=int, default=12)
    parser.add_argument("--first", type=int, default=700, help="seed of the first spacecraft")
    given = parser.parse_args()
    healthy, thresholds = healthy_table(given.records, given.looks, given.rivals)
    delays = [[change, *(delay(test, change, thresholds[test]) for test in TESTS)] for change in CHANGES]
    false, found = false_discoveries()
    parts = [
        f"## Wrong on healthy records, ever within {given.looks} looks",
        healthy,
        f"{given.records} records of each law, {given.rivals} for the other tests; where none is wrong the upper 95 % bound is "
        f"{100 * upper_bound(0, given.records):.2f} % and {100 * upper_bound(0, given.rivals):.2f} %.",
        f"## Readings from onset to alarm, at a level of {LEVELS[-1]:.0%}",
        markdown_table(["change after 1000 readings, in σ", *TESTS], delays),
        "## Many twins",
        f"100 fleets of twenty twins with Student's noise, four of them off by 1 after 500 readings: false discovery rate "
        f"{false:.3f} where 0.1 is allowed, {found:.0%} of those that are off are found.",
    ]
    if given.spacecraft:
        parts += [
            f"## Finite-element spacecraft, level {LEVELS[-1]:.0%}",
            spacecraft_table(given.first, given.spacecraft),
            "Calibrated on fourteen healthy orbits, watched over the next twelve; faults as in the table of anomalies.",
        ]
    text = "\n\n".join(part.strip() for part in parts) + "\n"
    save_table(
        "sufficiency",
        "Does the declared model suffice? A test that is looked at all the time",
        text,
        "benchmarks.sufficiency",
    )
    print(text)


if __name__ == "__main__":
    main()
