"""Rollouts beside torchdiffeq and SciPy; how their cost grows with samples, nodes and conductors, and their memory."""

import resource
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.integrate import solve_ivp
from threadpoolctl import threadpool_limits
from torchdiffeq import odeint

from benchmarks.markdown import TABLES, markdown_table
from benchmarks.paper_a_speed import seconds
from twin_core._typing import FloatArray
from twin_core.calibrate.neural_ode import Recipe, Trainer
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.calibrate.windows import balance_of, cut_windows
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4
from twin_core.fem.paper import ORBIT_S, SENSORS, paper_spec
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TOLERANCES = tuple(10.0**-n for n in range(3, 13))
"""Relative and absolute (K) tolerances that the adaptive solvers are given, until they are as accurate as ours."""

SAMPLE_S, N_SAMPLES = 20.0, 301
SIDES = ("left", "right", "bottom", "top")


def rollouts() -> str:
    """Return one orbit of nine nodes beside torchdiffeq and SciPy, each at the first tolerance that is as accurate."""
    parts = []
    for kind in ("smooth", "switching"):
        with threadpool_limits(limits=1):
            rows = _beside(kind)
        parts.append(
            f"## Rollout: one orbit, nine nodes, {N_SAMPLES} samples, {kind} inputs\n\n" + markdown_table(HEADER, rows)
        )
    return "\n".join(parts) + (
        "\nThe reference is DOP853 from sample to sample (rtol 1e-12), so that no step goes over a kink of an input."
        " SciPy's solvers run over the whole record at once, and from sample to sample. One thread.\n"
    )


HEADER = ["solver", "milliseconds", "largest error (K)", "over ours"]


def _beside(kind: str) -> list[list[str]]:
    """Return the rows of one table."""
    problem = _problem(kind)
    network, segment = problem.network, problem.segments[0]
    start, values = segment.start_prior_K, network.parameters.values
    matrix, rate = _field(problem)
    exact = _piecewise(rate, start, "DOP853", 1e-12, 1e-10)
    ours = rollout(network, values, start, segment.forcing).at_samples(segment.forcing.sample_step)
    limit = float(np.abs(ours - exact).max())
    ours_s = seconds(lambda: rollout(network, values, start, segment.forcing), 100)
    rows = [["ours (exponential trapezoidal, a step a sample)", f"{1e3 * ours_s:.3f}", f"{limit:.1e}", ""]]
    print(rows[-1], flush=True)
    times = np.arange(N_SAMPLES, dtype=np.float64)
    field = Trainer(problem, Recipe(window_s=1e9, validation_share=0.0)).field.at(torch.as_tensor(matrix))
    at, first = torch.as_tensor(times), torch.as_tensor(start)[None]

    def whole(method: str, rtol: float) -> FloatArray:
        span = (0.0, times[-1])
        return solve_ivp(lambda t, x: rate(_interval(t), t, x), span, start, method, times, rtol=rtol, atol=rtol).y.T

    rivals: dict[str, Callable[[float], FloatArray]] = {
        "torchdiffeq dopri5": lambda r: odeint(field, first, at, rtol=r, atol=r, method="dopri5")[:, 0].numpy(),
        "SciPy RK45": lambda r: whole("RK45", r),
        "SciPy RK45, sample by sample": lambda r: _piecewise(rate, start, "RK45", r, r),
        "SciPy LSODA": lambda r: whole("LSODA", r),
        "SciPy LSODA, sample by sample": lambda r: _piecewise(rate, start, "LSODA", r, r),
    }
    with torch.no_grad():
        for name, solve in rivals.items():
            for rtol in TOLERANCES:
                error = float(np.abs(solve(rtol) - exact).max())
                if error <= limit:
                    break
            theirs = seconds(lambda solve=solve, rtol=rtol: solve(rtol), 2)
            reached = "" if error <= limit else " (no closer)"
            rows.append(
                [f"{name}, rtol {rtol:g}{reached}", f"{1e3 * theirs:.1f}", f"{error:.1e}", f"{theirs / ours_s:.0f}"]
            )
            print(rows[-1], flush=True)
    return rows


def _problem(kind: str) -> Problem:
    """Return the paper's network under inputs that are linear between samples and smooth, or held and switching."""
    spec, rng = paper_spec(), np.random.default_rng(0)
    time_s = SAMPLE_S * np.arange(N_SAMPLES)
    turn = 2.0 * np.pi * time_s / ORBIT_S
    heat = {f"Q_{side}": 300.0 * (1.0 + np.sin(turn + 0.5 * np.pi * i)) for i, side in enumerate(SIDES)}
    heat |= {
        f"Q_{unit}": mean * (1.0 + 0.6 * np.sin(3.0 * turn)) for unit, mean in (("payload", 450.0), ("battery", 350.0))
    }
    if kind == "switching":
        held = {"interpolation": "hold"}
        channels = {n: c.model_copy(update=held) if n in heat else c for n, c in spec.channels.items()}
        spec = spec.model_copy(update={"channels": channels})
        heat = {
            n: np.repeat(rng.choice([0.0, 2.0 * q.mean()], N_SAMPLES // 7 + 1), 7)[:N_SAMPLES] for n, q in heat.items()
        }
    read = {f"T_{name}": np.full(N_SAMPLES, 290.0) for name in SENSORS}
    return build_problem(build_network(spec), [Record(time_s, heat | read)], np.full(9, 0.1), np.inf)


def _interval(tau: float) -> int:
    """Return the interval between samples in which a time lies, in samples."""
    return min(int(tau), N_SAMPLES - 2)


Rate = Callable[[int, float, FloatArray], FloatArray]


def _piecewise(rate: Rate, start: FloatArray, method: str, rtol: float, atol: float) -> FloatArray:
    """Return the states at the samples, integrated from each to the next."""
    found = [start]
    for k in range(N_SAMPLES - 1):
        part = solve_ivp(lambda t, x, k=k: rate(k, t, x), (k, k + 1.0), found[-1], method, rtol=rtol, atol=atol)
        found.append(part.y[:, -1])
    return np.array(found)


def _field(problem: Problem) -> tuple[FloatArray, Rate]:
    """Return the matrix of the balance and its rate per sample within an interval, in NumPy."""
    balance = balance_of(problem)
    values, network = problem.network.parameters.values, problem.network
    matrix = np.tensordot(values, balance.design, axes=1) / values[network.capacity_index][:, None]
    window = cut_windows(problem, balance, 1e9, 0.0)
    given, rise, step = window.given[:, 0], window.rise[:, 0], window.step_s[:, 0]

    def rate(k: int, tau: float, temperature_K: FloatArray) -> FloatArray:
        z = np.concatenate(
            [temperature_K, STEFAN_BOLTZMANN_W_PER_M2_K4 * temperature_K**4, given[k] + (tau - k) * rise[k]]
        )
        return step[k] * (matrix @ z)

    return matrix, rate


SAMPLES = (1_000, 10_000, 100_000, 1_000_000)
SIZES = ((25, 250), (50, 500), (100, 1000), (200, 2000))
"""Lengths of records, and nodes with conductors, whose rollouts are timed."""


def growth() -> str:
    """Return how the cost of a rollout grows with samples, nodes and conductors, and memory at a million samples."""
    from matplotlib.figure import Figure  # the table of rollouts does without

    record, network = _problem("smooth").segments[0].record, build_network(paper_spec())
    long = (build_problem(network, [_repeated(record, n)], np.full(9, 0.1), np.inf) for n in SAMPLES)
    by_samples = [_rollout_seconds(problem, 1 if n > 1e5 else 3) for n, problem in zip(SAMPLES, long, strict=True)]
    by_size = [_rollout_seconds(_random_problem(nodes, edges, 1000), 3) for nodes, edges in SIZES]
    rows = [
        [f"{n:,} samples, 9 nodes, 28 conductors", f"{taken:.4f}", f"{1e6 * taken / n:.1f}"]
        for n, taken in zip(SAMPLES, by_samples, strict=True)
    ] + [
        [f"1,000 samples, {nodes} nodes, {edges} conductors", f"{taken:.4f}", f"{1e6 * taken / (nodes + edges):.1f}"]
        for (nodes, edges), taken in zip(SIZES, by_size, strict=True)
    ]
    header = ["rollout", "seconds", "µs per sample, or per node and conductor"]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    figure = Figure((9.0, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    samples = _growth(left, "samples, 9 nodes", SAMPLES, by_samples)
    size = _growth(right, "nodes and conductors, 1000 samples", [nodes + edges for nodes, edges in SIZES], by_size)
    figure.savefig(TABLES / "paper_a_growth.svg", metadata={"Date": None})
    return (
        f"## Growth\n\n{markdown_table(header, rows)}\n![Cost of a rollout](paper_a_growth.svg)\n\nSeconds grow with the"
        f" power {samples:.2f} of the samples and {size:.2f} of nodes and conductors together (least squares of the"
        f" logarithms). Peak memory of this process until here: {peak:.2f} GiB.\n"
    )


def _rollout_seconds(problem: Problem, repeats: int) -> float:
    """Return the seconds of one rollout of a problem's first segment."""
    network, segment = problem.network, problem.segments[0]
    return seconds(lambda: rollout(network, network.parameters.values, segment.start_prior_K, segment.forcing), repeats)


def _growth(axes: "Axes", of: str, sizes: Sequence[int], taken: Sequence[float]) -> float:
    """Draw seconds over a size and return the power with which they grow."""
    power, factor = np.polyfit(np.log(sizes), np.log(taken), 1)
    axes.loglog(sizes, taken, "o", label="measured")
    axes.loglog(sizes, np.exp(factor) * np.asarray(sizes, dtype=float) ** power, label=f"power {power:.2f}")
    axes.set(xlabel=of, ylabel="seconds of a rollout")
    axes.legend()
    return float(power)


def _repeated(record: Record, n_times: int) -> Record:
    """Return a record of any length: its inputs over and over."""
    index = np.arange(n_times) % record.time_s.size
    return Record(SAMPLE_S * np.arange(n_times), {name: c[index] for name, c in record.values.items()})


def _random_problem(n_nodes: int, n_edges: int, n_times: int) -> Problem:
    """Return a connected random network under a switching load, every fifth node radiating to space."""
    rng = np.random.default_rng(n_nodes)
    pairs = {(i, i + 1) for i in range(n_nodes - 1)}
    while len(pairs) < n_edges:
        a, b = sorted(rng.choice(n_nodes, 2, replace=False).tolist())
        pairs.add((a, b))
    names = [f"n{i}" for i in range(n_nodes)]
    one, kelvin = {"conductance_W_per_K": {"guess": 1.0}}, {"kind": "temperature", "unit": "K"}
    spec = load_spec(
        {
            "twin": "random",
            "boundaries": {"space": {"value_K": 3.0}},
            "channels": {f"T{i}": kelvin for i in range(n_nodes)} | {"Q": {"kind": "power", "unit": "W"}},
            "nodes": [{"id": n, "sensor": f"T{i}", "capacity_J_per_K": {"guess": 5e3}} for i, n in enumerate(names)],
            "conductors": [{"between": [names[a], names[b]]} | one for a, b in sorted(pairs)],
            "radiators": [{"node": n, "emissivity": 0.8, "area_m2": 0.05, "sink": "space"} for n in names[::5]],
            "loads": [{"channel": "Q", "node": "n0"}],
        }
    )
    time_s = 20.0 * np.arange(n_times)
    heat = np.repeat(rng.choice([0.0, 50.0], n_times // 10 + 1), 10)[:n_times]
    values = {f"T{i}": np.full(n_times, 290.0) for i in range(n_nodes)} | {"Q": heat}
    return build_problem(build_network(spec), [Record(time_s, values)], np.full(n_nodes, 0.1), np.inf)
