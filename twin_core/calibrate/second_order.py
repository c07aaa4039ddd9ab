"""The default calibration: trajectory matching by a second-order solver with exact sensitivities."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, TypeVar

import numpy as np

from twin_core._typing import FloatArray, Progress, no_progress
from twin_core.calibrate.approach import approach, coarse_problem
from twin_core.calibrate.containment import NO_DEADLINE, attempted, is_late
from twin_core.calibrate.likeliest import greatest_log_posterior
from twin_core.calibrate.multistart import best_of_starts
from twin_core.calibrate.noise import noise_beside_K, sensor_noise_K
from twin_core.calibrate.optimise import ADVICE, Optimum, minimise
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.calibrate.residual_noise import Whitener, fit_whitener
from twin_core.calibrate.starting import balance_start, table_levels
from twin_core.calibrate.undeclared.fit import fit_with_undeclared_heat
from twin_core.calibrate.undeclared.model import HeatFit
from twin_core.effects.base import Effect
from twin_core.errors import NoSolutionError, TelemetryError
from twin_core.network.model import Network, build_network
from twin_core.network.screened import all_screened
from twin_core.network.spec import TwinSpec
from twin_core.once import once
from twin_core.progress import Part
from twin_core.side_by_side import both
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

STEP_ERROR_SHARE = 0.1
"""Time steps are halved until halving changes no reading by more than this share of the noise."""

STEP_ERROR_FLOOR_K = 1e-3
"""No step is halved for less: no sensor resolves it."""

HUBER = 1.345
"""Residuals, in units of their noise, beyond which Huber's loss is linear: 95 % efficient where there is no outlier."""

Loss = Literal["squared", "huber"]

T = TypeVar("T")

READINGS_PER_UNKNOWN = 2
"""Fewer are refused: any model passes through as many readings as it has unknowns."""

MAX_HALVINGS = 3


@dataclass(frozen=True)
class Calibration:
    """A fitted network: the problem, where the search ended, and the noise of what is left."""

    problem: Problem
    optimum: Optimum
    whitener: Whitener
    max_step_s: float

    @property
    def network(self) -> Network:
        """The network at its calibrated values."""
        return self.problem.network.with_values(self.problem.values(self.optimum.unknowns))

    @property
    @once
    def log_posterior(self) -> float:
        """Greatest log-likelihood of trajectories under their own coloured noise, less what priors hold against parameters."""
        return greatest_log_posterior(self.problem, self.optimum, self.whitener)

    @property
    def residuals(self) -> list[FloatArray]:
        """Measured minus modelled per segment."""
        return self.problem.residuals(self.optimum.fit)


def sampling_step_s(records: Sequence[Record]) -> float:
    """Return the median sampling interval of all records."""
    return float(np.median(np.concatenate([np.diff(r.time_s) for r in records if r.time_s.size > 1] or [np.ones(1)])))


def prepare(
    spec: TwinSpec, records: Sequence[Record], effects: Sequence[Effect] = (), *, loss: Loss = "squared"
) -> tuple[Problem, float]:
    """Return the fitting problem of a declared network, and its longest time step.

    Levels of tables are read from the telemetry, parameters that nobody guessed start from integrated heat balances, and
    the time step is halved until halving changes no reading by more than a tenth of its noise.

    Parameters
    ----------
    spec
        The declared network.
    records
        Segments of telemetry in SI, each with its own initial state.
    effects
        Terms beyond the declaration, at their starting values.
    loss
        ``squared``, or ``huber``: residuals beyond 1.345 times their noise count linearly.

    Raises
    ------
    TelemetryError
        If telemetry lacks a channel that the model needs, or has too few samples.
    """
    records = all_screened(spec, records)
    noise = sensor_noise_K(spec, list(records))
    network = build_network(spec, effects, table_knots=table_levels(spec, records))
    step = 1.5 * sampling_step_s(records)
    problem = build_problem(network, records, noise, step)
    readings = sum(int(segment.valid.sum()) for segment in problem.segments)
    if readings < READINGS_PER_UNKNOWN * problem.n_unknowns:
        raise TelemetryError(
            f"{records[0].name}: {readings} readings are too few to determine {problem.n_unknowns} unknowns (parameters and"
            f" initial temperatures) with their uncertainty; give at least {READINGS_PER_UNKNOWN * problem.n_unknowns} readings,"
            " or declare known values in the specification"
        )
    problem = problem.with_network(network.with_parameters(balance_start(problem)))
    for _ in range(MAX_HALVINGS):
        finer = build_problem(problem.network, records, noise, step / 2.0)
        error = attempted(partial(_step_error, problem, finer), "time step", [])
        if error is None or error < STEP_ERROR_SHARE:
            break
        step, problem = step / 2.0, finer
    return replace(problem, huber=HUBER if loss == "huber" else np.inf), step


def fit_network(
    spec: TwinSpec,
    records: Sequence[Record],
    effects: Sequence[Effect] = (),
    *,
    deadline: float = NO_DEADLINE,
    progress: Progress = no_progress,
) -> tuple[HeatFit, Calibration]:
    """Calibrate a declared network, with effects if any, against telemetry.

    Parameters
    ----------
    spec, records, effects
        As in :func:`prepare`.
    deadline
        On the clock of ``time.monotonic``: what is there by then counts; one trajectory and one fit in the presence of
        undeclared heat are made in any case.
    progress
        Called with the fraction done.

    Returns
    -------
    HeatFit, Calibration
        The fit in the presence of undeclared heat, and the best open-loop trajectories found from it and from the guesses.

    Raises
    ------
    TelemetryError
        If the telemetry cannot be used.
    NoSolutionError
        If the heat balance has no solution at any start.
    """
    progress(0.0, "reading noise and levels")
    problem, step = prepare(spec, records, effects)
    progress(0.1, "fitting open-loop trajectories")
    failures: list[str] = []
    coarse = coarse_problem(problem, step)
    search = best_of_starts(
        coarse,
        stands_for=problem.n_samples / coarse.n_samples,
        deadline=deadline,
        progress=Part(progress).part(0.1, 0.4),
    )
    problem = recentred(problem, search.best)
    problem = with_noise_beside(problem, search.best.unknowns)
    on_trajectories = partial(minimise, problem, deadline=deadline)

    progress(0.4, "fitting in the presence of undeclared heat")
    (first, why), (fit, and_why) = both(
        partial(_attempted_apart, partial(on_trajectories, search.best.unknowns), "open-loop trajectories"),
        partial(_attempted_apart, partial(fit_with_undeclared_heat, problem, deadline=deadline), "undeclared heat"),
    )
    failures += [*why, *and_why]
    found, fits = [first], [fit]
    found += [attempted(partial(on_trajectories, f.unknowns()), "open-loop trajectories", failures) for f in fits if f]
    optima = [o for o in found if o is not None and o.status != "no_solution"]
    if not optima:
        raise NoSolutionError(f"calibration failed: {'; '.join(failures) or ADVICE['no_solution']}")
    optimum = min(optima, key=lambda o: o.fit.cost)
    if fits == [None] or not is_late(deadline):
        progress(0.8, "fitting again in the presence of undeclared heat")
        free, early_prior_std = optimum.unknowns[: problem.n_free], (np.inf,) * 3
        again = partial(fit_with_undeclared_heat, problem, free, early_prior_std=early_prior_std, deadline=deadline)
        fits.append(attempted(again, "undeclared heat", failures))
    heat_fits = [f for f in fits if f is not None]
    if not heat_fits:
        raise NoSolutionError(f"calibration failed: {'; '.join(failures)}: check the units of loads and known values")
    progress(0.95, "weighing what is left")
    whitener = fit_whitener(problem, problem.residuals(optimum.fit))
    return max(heat_fits, key=lambda f: f.log_posterior), Calibration(problem, optimum, whitener, step)


def _attempted_apart(work: Callable[[], T], what: str) -> tuple[T | None, list[str]]:
    """Return what :func:`attempted` returns, and the failure if there is one."""
    failures: list[str] = []
    return attempted(work, what, failures), failures


def fit_trajectories(
    spec: TwinSpec,
    records: Sequence[Record],
    *,
    loss: Loss = "squared",
    deadline: float = NO_DEADLINE,
    progress: Progress = no_progress,
) -> Calibration:
    """Calibrate a declared network by trajectories alone (paper A, eq. 2).

    Starts from the guesses, and where some are missing or no start has a solution there from several places about what
    the heat balance tells; on a thinned record first, where it is long.

    Parameters
    ----------
    spec, records, loss
        As in :func:`prepare`.
    deadline
        On the clock of ``time.monotonic``: the search ends there with the best so far, whose status says so.
    progress
        Called with the fraction done.

    Raises
    ------
    TelemetryError
        If the telemetry cannot be used.
    NoSolutionError
        If the heat balance has no solution at any start.
    """
    progress(0.0, "reading noise and levels")
    problem, step_s = prepare(spec, records, loss=loss)
    coarse = coarse_problem(problem, step_s)
    search = best_of_starts(
        coarse,
        stands_for=problem.n_samples / coarse.n_samples,
        deadline=deadline,
        progress=Part(progress).part(0.1, 0.6),
    )
    best = search.best
    problem = with_noise_beside(recentred(problem, best), best.unknowns)
    progress(0.6, "fitting all samples")
    failures: list[str] = []
    fine = attempted(partial(approach, problem, best.unknowns, rounds=1, deadline=deadline), "refinement", failures)
    if fine is None or fine.status == "no_solution":
        fine = minimise(problem, best.unknowns, max_iterations=0)
    if fine.status == "no_solution":
        raise NoSolutionError(f"calibration failed: {'; '.join(failures) or ADVICE[fine.status]}")
    late = not search.complete or "deadline" in (best.status, fine.status)
    status = "deadline" if late else fine.status
    best = replace(fine, iterations=best.iterations + fine.iterations, status=status)
    progress(0.9, "weighing what is left")
    return Calibration(problem, best, fit_whitener(problem, problem.residuals(best.fit)), step_s)


def recentred(problem: Problem, optimum: Optimum) -> Problem:
    """Return the problem with the flat priors of what nobody guessed about where it was found.

    They have no centre of their own. About a first look they would pull the scale that the stated guesses set.
    """
    parameters, found = problem.network.parameters, problem.values(optimum.unknowns)
    guessed = np.array([p.guessed for p in parameters.parameters])
    return problem.with_network(problem.network.with_values(np.where(guessed, found, parameters.values)))


def with_noise_beside(problem: Problem, unknowns: FloatArray) -> Problem:
    """Return the problem with the noise that is left of its readings beside a first fit, where that is far less."""
    fit = attempted(partial(problem.solve, unknowns), "noise beside a first fit", [])
    if fit is None or not np.isfinite(fit.cost):
        return problem
    records = [segment.record for segment in problem.segments]
    left_K = problem.residuals(fit)
    return replace(problem, noise_K=noise_beside_K(problem.network.spec, records, problem.noise_K, left_K))


def from_heat_fit(
    fit: HeatFit, max_step_s: float, *, near: Sequence[Optimum] = (), starts: Sequence[FloatArray] = ()
) -> Calibration:
    """Return the open-loop calibration that starts from a fit in the presence of undeclared heat, the best of all that it finds.

    Parameters
    ----------
    fit, max_step_s
        The fit, and the longest time step.
    near
        Optima of the same problem found otherwise.
    starts
        Unknowns to start from too, (n_unknowns,) each. Where one of all these has converged, the fit's own are no start.

    Raises
    ------
    ArithmeticError
        Where the heat balance has a solution from none of them.
    """
    optima = [*near, *(minimise(fit.problem, start) for start in starts)]
    if not any(optimum.status == "converged" for optimum in optima):
        optima.append(minimise(fit.problem, fit.unknowns()))
    best = min(reversed(optima), key=lambda o: o.fit.cost)
    if not np.isfinite(best.fit.cost):
        raise ArithmeticError("the heat balance has no open-loop solution at the fitted parameters")
    return Calibration(fit.problem, best, fit_whitener(fit.problem, fit.problem.residuals(best.fit)), max_step_s)


def _step_error(problem: Problem, finer: Problem) -> float:
    """Return the largest change of a reading at the start values, in units of its noise, when the step is halved."""
    values = problem.network.parameters.values
    worst = 0.0
    for coarse, fine in zip(problem.segments, finer.segments, strict=True):
        paths = [rollout(problem.network, values, s.start_prior_K, s.forcing) for s in (coarse, fine)]
        if not all(path.converged for path in paths):
            continue
        read = [p.at_samples(s.forcing.sample_step) for p, s in zip(paths, (coarse, fine), strict=True)]
        change = np.abs(read[0] - read[1])[:, problem.network.sensor_node]
        worst = max(worst, float((change / np.maximum(problem.noise_K, STEP_ERROR_FLOOR_K / STEP_ERROR_SHARE)).max()))
    return worst
