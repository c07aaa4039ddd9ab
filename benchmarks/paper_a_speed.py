"""Paper A's speed beside ours: calibration and finite elements, side by side in one run."""

import time
from collections.abc import Callable

import numpy as np

from benchmarks.markdown import markdown_table
from benchmarks.paper_a_cases import every_second, score_of, simulations, training
from benchmarks.paper_a_tables import recipe_run, timed_fit
from twin_core._typing import FloatArray
from twin_core.calibrate.neural_ode import Recipe, Trainer
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.fem.paper import ORBIT_S, paper_scenario, paper_spec
from twin_core.fem.simulate import simulate


def seconds(job: Callable[[], object], repeats: int = 5) -> float:
    """Return the least processor time of a job over some repeats."""
    times = []
    for _ in range(repeats):
        begun = time.process_time()
        job()
        times.append(time.process_time() - begun)
    return min(times)


def calibration(iterations: int, budget_s: float) -> str:
    """Return our default solver beside the paper's recipe on the same data, table 3 test A."""
    record = simulations()["combined", "A"].record
    timed_fit(paper_spec(), [training(record)])  # compiled code is read from its cache once
    rows = []
    for label, data in (("20 s", record), ("1 s", every_second(record))):
        fit, ours_s = timed_fit(paper_spec(), [training(data)])
        ours = score_of(fit, data)
        problem = build_problem(fit.problem.network, [training(data)], fit.problem.noise_K, np.inf)
        epoch_s = _epoch_seconds(problem, 3 if label == "1 s" else 20)
        if label == "20 s" and iterations * epoch_s < budget_s:
            theirs, taken_s = recipe_run("combined", "A", iterations)
            test, spent = f"{theirs.test:.2e}", f"{taken_s:.0f}"
        else:
            taken_s = iterations * epoch_s
            test, spent = "not run", f"{taken_s:.0f} ({iterations} times the measured {epoch_s:.2f} s of one iteration)"
        ratio = taken_s / ours_s
        rows.append([label, f"{ours_s:.2f}", f"{ours.test:.2e}", spent, test, f"{ratio:.0f}"])
        print(rows[-1], flush=True)
    header = [
        "samples every",
        "ours (s)",
        "our test RMSE",
        f"the paper's recipe, {iterations} iterations (s)",
        "its test RMSE",
        "ratio",
    ]
    return "## Calibration: table 3, test A\n\n" + markdown_table(header, rows)


def _epoch_seconds(problem: Problem, repeats: int) -> float:
    """Return the seconds of one epoch of the recipe: one Adam step on all windows of 2000 s."""
    trainer = Trainer(problem, Recipe())
    free = trainer.embedding.start.clone().requires_grad_(True)

    def epoch() -> None:
        trainer.losses(free)[0].backward()  # type: ignore[no-untyped-call]

    epoch()
    return seconds(epoch, repeats)


def finite_elements() -> str:
    """Return the default scheme beside the paper's, which factorises in every step."""
    n_orbits, sample_s = 2.0, 240.0

    def run(step_s: float, scheme: str) -> tuple[FloatArray, float]:
        scenario = paper_scenario("A", duration_s=n_orbits * ORBIT_S, sample_s=sample_s, scheme=scheme)
        scenario = scenario.model_copy(update={"time": scenario.time.model_copy(update={"step_s": step_s})})
        begun = time.process_time()
        truth = simulate(scenario).truth
        taken = time.process_time() - begun
        stride = round(sample_s / step_s)
        return np.stack(list(truth.temperature_K.values()))[:, ::stride], taken

    reference, _ = run(5.0, "sdirk2")
    rows, cost = [], {}
    for scheme, steps in (("imex", (20.0,)), ("sdirk2", (20.0, 60.0, 120.0, 240.0))):
        for step_s in steps:
            found, taken = run(step_s, scheme)
            worst = float(np.abs(found - reference).max())
            cost[scheme, step_s] = (worst, taken)
            rows.append([scheme, f"{step_s:g}", f"{taken:.2f}", f"{worst:.1e}"])
            print(rows[-1], flush=True)
    limit, theirs = cost["imex", 20.0]
    best = min(taken for (scheme, _), (worst, taken) in cost.items() if scheme == "sdirk2" and worst <= limit)
    header = ["scheme", "step (s)", "seconds", "largest error at a sensor (K)"]
    return (
        f"## Finite elements: 4225 unknowns, {n_orbits + 2:g} orbits with assembly\n\n{markdown_table(header, rows)}\n"
        f"Error against sdirk2 with steps of 5 s. The default is {theirs / best:.0f} times faster than the paper's scheme"
        " (imex, steps of 20 s) at no larger error.\n"
    )
