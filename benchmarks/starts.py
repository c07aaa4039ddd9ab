"""Calibrations that start from few guesses or none, over random networks of every size and scale.

The truth is integrated here by Runge and Kutta's fourth-order method, which has no part in the product. A network counts
as found where the calibrated trajectories leave no more than the noise that was put in, and where every parameter that
is said to be identified is the true one within its stated uncertainty.
"""

import argparse
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.markdown import markdown_table, save_table
from twin_core.calibrate import CalibratedModel, calibrate
from twin_core.errors import TwinError
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

SIGMA = 5.670374419e-8
N_SAMPLES = 240
NOISE_SHARE = 1.05
"""A fit that leaves more than this many times the noise that was put in has not found the trajectories."""
Z_LIMIT = 5.0
"""An identified parameter further from the truth than this many of its standard deviations is not found."""


@dataclass(frozen=True)
class Trial:
    """One random network: its declaration, its telemetry, and the truth behind both."""

    spec: TwinSpec
    record: Record
    truth: dict[str, float]
    noise_K: float
    """Root mean square of the noise that was drawn."""
    kind: str


@dataclass(frozen=True)
class Outcome:
    """What a calibration made of a trial."""

    residual: float
    """Root mean square residual in units of the noise."""
    farthest: float
    """Largest distance of an identified parameter from the truth, in its standard deviations."""
    failure: str = ""

    @property
    def found(self) -> bool:
        """Whether trajectories and identified parameters are the truth's."""
        return not self.failure and self.residual <= NOISE_SHARE and self.farthest <= Z_LIMIT


class Hardware:
    """A random network of 2 to 7 nodes whose power spans ten decades, and its capacities as many or more."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.n = int(rng.integers(2, 8))
        self.power_W = 10.0 ** rng.uniform(-5.0, 5.0)
        self.tau_s = 10.0 ** rng.uniform(0.0, 5.0)
        rise_K = rng.uniform(5.0, 40.0)
        scale = self.power_W / rise_K
        self.edges = [(int(rng.integers(0, i)), i) for i in range(1, self.n)]
        extra = (0, self.n - 1)
        if self.n > 3 and rng.random() < 0.4 and extra not in self.edges:
            self.edges.append(extra)
        self.conductance = scale * np.exp(rng.uniform(-1.0, 1.0, len(self.edges)))
        self.capacity = scale * self.tau_s * np.exp(rng.uniform(-1.2, 1.2, self.n))
        self.loads = rng.choice(self.n, int(rng.integers(1, min(3, self.n) + 1)), replace=False).tolist()
        self.gain = np.where(rng.random(len(self.loads)) < 0.5, 1.0, np.exp(rng.normal(0.0, 2.0, len(self.loads))))
        sink = str(rng.choice(["room", "space", "both"]))
        places = rng.choice(self.n, 2, replace=False)
        self.room = {int(places[0]): scale * np.exp(rng.uniform(-1.0, 0.5))} if sink != "space" else {}
        mean_W = 0.5 * self.power_W * len(self.loads)
        self.radiators = {int(places[1]): mean_W / (SIGMA * 285.0**4)} if sink != "room" else {}
        self.time_s = self.tau_s * rng.uniform(0.05, 0.25) * np.arange(N_SAMPLES)
        hold = int(rng.integers(4, 25))
        levels = rng.uniform(0.0, 1.0, (N_SAMPLES // hold + 1, len(self.loads)))
        self.heat_W = self.power_W * np.repeat(levels, hold, axis=0)[:N_SAMPLES]
        cycle = 2.0 * np.pi * np.arange(N_SAMPLES) / rng.uniform(60.0, 200.0)
        self.room_K = 288.0 + rng.uniform(0.0, 4.0) * np.sin(cycle)
        self.start_K = rng.uniform(275.0, 295.0, self.n)

    def simulate(self) -> np.ndarray:
        """Return the temperatures, (n_samples, n); power holds from one sample to the next, the room is interpolated."""
        laplacian = np.zeros((self.n, self.n))
        for (a, b), g in zip(self.edges, self.conductance, strict=True):
            laplacian[[a, b, a, b], [a, b, b, a]] += np.array([-g, -g, g, g])
        room = np.array([self.room.get(i, 0.0) for i in range(self.n)])
        area = np.array([self.radiators.get(i, 0.0) for i in range(self.n)])
        stiff = (room - np.diag(laplacian) + 4.0 * SIGMA * area * 400.0**3) / self.capacity
        step_s = float(self.time_s[1])
        inner = max(2, int(np.ceil(2.0 * step_s * float(stiff.max()) / 0.4)))
        h = step_s / inner
        state, states = self.start_K.copy(), [self.start_K]
        for k in range(N_SAMPLES - 1):
            heat = np.zeros(self.n)
            heat[self.loads] = self.heat_W[k]

            def rate(x: np.ndarray, share: float, heat: np.ndarray = heat, k: int = k) -> np.ndarray:
                room_K = self.room_K[k] + share * (self.room_K[k + 1] - self.room_K[k])
                flow = heat + laplacian @ x + room * (room_K - x) + SIGMA * area * (2.7**4 - x**4)
                return np.asarray(flow / self.capacity)

            for part in range(inner):
                k1 = rate(state, part / inner)
                k2 = rate(state + 0.5 * h * k1, (part + 0.5) / inner)
                k3 = rate(state + 0.5 * h * k2, (part + 0.5) / inner)
                k4 = rate(state + h * k3, (part + 1.0) / inner)
                state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            states.append(state)
        return np.array(states)


def trial(seed: int) -> Trial:
    """Return a seeded network with any subset of its guesses missing."""
    rng = np.random.default_rng(seed)
    hardware = Hardware(rng)
    keep = float(rng.choice([0.0, 0.3, 0.7, 1.0]))

    def guess(truth: float) -> dict[str, float]:
        told = {"guess": float(truth * np.exp(rng.normal(0.0, 0.5)))}
        return told if rng.random() < keep else {}

    hidden: set[int] = set()
    if rng.random() < 0.5:
        hidden = set(rng.choice(hardware.n, int(rng.integers(1, max(2, hardware.n // 3 + 1))), replace=False).tolist())
    truth: dict[str, float] = {}
    channels: dict[str, Any] = {
        f"T{i}": {"kind": "temperature", "unit": "K"} for i in range(hardware.n) if i not in hidden
    }
    nodes: list[dict[str, Any]] = []
    for i, capacity in enumerate(hardware.capacity.tolist()):
        truth[f"C:n{i}"] = capacity
        nodes.append({"id": f"n{i}"} | ({} if i in hidden else {"sensor": f"T{i}"}))
        nodes[-1] |= {"capacity_J_per_K": told} if (told := guess(capacity)) else {}
    boundaries: dict[str, Any] = {}
    conductors: list[dict[str, Any]] = []
    pairs = [((f"n{a}", f"n{b}"), float(g)) for (a, b), g in zip(hardware.edges, hardware.conductance, strict=True)]
    pairs += [((f"n{i}", "room"), float(g)) for i, g in hardware.room.items()]
    for pair, value in pairs:
        truth[f"G:{pair[0]}|{pair[1]}"] = value
        conductors.append({"between": list(pair)} | ({"conductance_W_per_K": told} if (told := guess(value)) else {}))
    if hardware.room:
        boundaries["room"] = {"channel": "T_room"}
        channels["T_room"] = {"kind": "temperature", "unit": "K"}
    if hardware.radiators:
        boundaries["space"] = {"value_K": 2.7}
    loads: list[dict[str, Any]] = []
    for j, (node, gain) in enumerate(zip(hardware.loads, hardware.gain.tolist(), strict=True)):
        channels[f"Q{j}"] = {"kind": "power", "unit": "W"}
        truth[f"gain:Q{j}|n{node}"] = gain
        loads.append({"channel": f"Q{j}", "node": f"n{node}"} | ({"gain": guess(gain)} if gain != 1.0 else {}))
    spec = load_spec(
        {
            "twin": f"start-{seed}",
            "boundaries": boundaries,
            "channels": channels,
            "nodes": nodes,
            "conductors": conductors,
            "radiators": [
                {"node": f"n{i}", "emissivity": 1.0, "area_m2": a, "sink": "space"}
                for i, a in hardware.radiators.items()
            ],
            "loads": loads,
        }
    )
    states = hardware.simulate()
    seen = [i for i in range(hardware.n) if i not in hidden]
    noise = float(rng.uniform(0.02, 0.2)) * rng.normal(0.0, 1.0, (N_SAMPLES, len(seen)))
    values = {f"T{i}": states[:, i] + noise[:, k] for k, i in enumerate(seen)}
    values |= {f"Q{j}": hardware.heat_W[:, j] / gain for j, gain in enumerate(hardware.gain.tolist())}
    if hardware.room:
        values["T_room"] = hardware.room_K
    record = Record(hardware.time_s, values, None, f"start-{seed}")
    kind = f"{'all read' if not hidden else 'some unread'}, {round(100 * keep)} % of guesses given"
    return Trial(spec, record, truth, float(np.sqrt(np.mean(noise**2))), kind)


def judge(case: Trial, model: CalibratedModel) -> Outcome:
    """Return how near a calibrated model is to the truth."""
    residual = float(model.summary["rmse_K"]) / case.noise_K
    std = dict(zip(model.free_names, np.sqrt(np.diag(model.covariance)).tolist(), strict=True))
    told = [row["name"] for row in model.summary["parameters"] if row["identified"]]
    far = [abs(np.log(model.values[name] / case.truth[name])) / max(std[name], 0.01) for name in told]
    return Outcome(residual, max(far, default=0.0))


def attempt(seed: int) -> tuple[Trial, Outcome]:
    """Return a trial and what a calibration made of it; a refusal is an outcome too."""
    case = trial(seed)
    try:
        return case, judge(case, calibrate(case.spec, [case.record]))
    except (TwinError, ArithmeticError, np.linalg.LinAlgError) as error:
        return case, Outcome(np.inf, np.inf, f"{type(error).__name__}: {error}")


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--count", type=int, default=500, help="how many networks")
    parser.add_argument("--out", help="also append the outcomes to this file, one line each")
    parser.add_argument("--gather", nargs="*", help="make the table of the lines in such files instead")
    given = parser.parse_args()
    lines: list[str] = []
    if given.gather:
        for name in given.gather:
            with open(name, encoding="utf-8") as file:
                lines += file.read().splitlines()
    else:
        for seed in range(given.first, given.first + given.count):
            case, got = attempt(seed)
            line = f"{seed};{case.kind};{got.found};{got.residual:.4g};{got.farthest:.3g};{got.failure}"
            lines.append(line)
            if not got.found or seed % 25 == 0:
                print(line, flush=True)
            if given.out:
                with open(given.out, "a", encoding="utf-8") as file:
                    file.write(line + "\n")
        if given.out:
            return
    save_table("starts", "Calibrations from few guesses or none", table(lines), "benchmarks.starts", NOTE)


NOTE = (
    "Random networks of 2 to 7 nodes, 240 samples each, power and time constants over ten and five decades. Found:"
    f" the residual is at most {NOISE_SHARE:g} times the noise that was put in, and each identified parameter within"
    f" {Z_LIMIT:g} standard deviations (of at least 1 %) of the truth."
)


def table(lines: list[str]) -> str:
    """Return the shares that were found, by kind, as markdown."""
    rows = [line.split(";") for line in lines]
    body = []
    for kind in [*sorted({row[1] for row in rows}), "all"]:
        own = [row for row in rows if kind in ("all", row[1])]
        found = sum(row[2] == "True" for row in own)
        refused = sum(bool(row[5]) for row in own)
        median = float(np.median([float(row[3]) for row in own]))
        body.append([kind, str(len(own)), str(found), f"{found / len(own):.1%}", str(refused), f"{median:.3f}"])
    return markdown_table(["networks", "number", "found", "share", "refused", "median residual / noise"], body)


if __name__ == "__main__":
    main()
