"""The default calibration: trajectory matching by a second-order solver with exact sensitivities."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from twin_core._typing import FloatArray, Json, Progress, no_progress
from twin_core.calibrate.approach import approach, coarse_problem
from twin_core.calibrate.covariance import is_open_ended, trajectory_covariance
from twin_core.calibrate.identifiability import identified, resting_channels, strong_correlations, unseen_nodes, words
from twin_core.calibrate.latent_fit import fit_with_latent_heat
from twin_core.calibrate.latent_heat import HeatFit
from twin_core.calibrate.noise import sensor_noise_K
from twin_core.calibrate.optimise import ADVICE, Optimum, minimise
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.calibrate.residual_noise import Whitener, fit_whitener
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.starting import balance_start, table_levels
from twin_core.calibrate.statistics import residual_whiteness, score
from twin_core.effects.base import Effect
from twin_core.errors import ModelError, TelemetryError
from twin_core.network.model import Network, build_network
from twin_core.network.screened import screened
from twin_core.network.spec import TwinSpec
from twin_core.simulate.orbit_inputs import orbit_notices
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

STEP_ERROR_SHARE = 0.1
"""Time steps are halved until halving changes no reading by more than this share of the noise."""

NO_COVARIANCE = "this method states no uncertainty of the parameters; forecasts carry only that of state and misfit"

STEP_ERROR_FLOOR_K = 1e-3
"""No step is halved for less: no sensor resolves it."""

HUBER = 1.345
"""Residuals, in units of their noise, beyond which Huber's loss is linear: 95 % efficient where there is no outlier."""

Loss = Literal["squared", "huber"]

READINGS_PER_UNKNOWN = 2
"""Fewer are refused: any model passes through as many readings as it has unknowns."""

MAX_HALVINGS = 3
N_STARTS = 4


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
    records = [screened(spec, record) for record in records]
    noise = sensor_noise_K(spec, list(records))
    network = build_network(spec, effects, table_knots=table_levels(spec, records))
    step = 1.5 * sampling_step_s(records)
    problem = build_problem(network, records, noise, step)
    readings = sum(int(segment.valid.sum()) for segment in problem.segments)
    if readings < READINGS_PER_UNKNOWN * problem.n_unknowns:
        raise TelemetryError(
            f"{records[0].name}: {readings} readings cannot tell {problem.n_unknowns} unknowns (parameters and initial"
            f" temperatures) and their uncertainty; give at least {READINGS_PER_UNKNOWN * problem.n_unknowns} readings, or"
            " values that are known"
        )
    problem = problem.with_network(network.with_parameters(balance_start(problem)))
    for _ in range(MAX_HALVINGS):
        finer = build_problem(problem.network, records, noise, step / 2.0)
        if _step_error(problem, finer) < STEP_ERROR_SHARE:
            break
        step, problem = step / 2.0, finer
    return replace(problem, huber=HUBER if loss == "huber" else np.inf), step


def fit_network(
    spec: TwinSpec, records: Sequence[Record], effects: Sequence[Effect] = (), *, progress: Progress = no_progress
) -> tuple[HeatFit, Calibration]:
    """Calibrate a declared network, with effects if any, against telemetry.

    Parameters
    ----------
    spec, records, effects
        As in :func:`prepare`.
    progress
        Called with the fraction done.

    Returns
    -------
    HeatFit, Calibration
        The fit in the presence of latent heat, and the best open-loop trajectories found from it and from the guesses.

    Raises
    ------
    TelemetryError
        If the telemetry cannot be used.
    ModelError
        If the heat balance has no solution at any start.
    """
    progress(0.0, "reading noise and levels")
    problem, step = prepare(spec, records, effects)
    progress(0.1, "fitting in the presence of latent heat")
    fit = fit_with_latent_heat(problem)
    progress(0.4, "fitting open-loop trajectories")
    optimum = _best_start(fit, progress)
    if optimum.status == "no_solution":
        raise ModelError(f"calibration failed: {ADVICE[optimum.status]}")
    progress(0.8, "fitting again in the presence of latent heat")
    again = fit_with_latent_heat(problem, optimum.unknowns[: problem.n_free], leashes=(np.inf,) * 3)
    fit = max(fit, again, key=lambda f: f.log_posterior)
    progress(0.95, "weighing what is left")
    return fit, Calibration(problem, optimum, fit_whitener(problem, problem.residuals(optimum.fit)), step)


def fit_trajectories(
    spec: TwinSpec, records: Sequence[Record], *, loss: Loss = "squared", progress: Progress = no_progress
) -> Calibration:
    """Calibrate a declared network by trajectories alone (paper A, eq. 2).

    Starts from the guesses, and where some are missing from several places about what the heat balance tells; on a
    thinned record first, where it is long.

    Parameters
    ----------
    spec, records, loss
        As in :func:`prepare`.
    progress
        Called with the fraction done.

    Raises
    ------
    TelemetryError
        If the telemetry cannot be used.
    ModelError
        If the heat balance has no solution at any start.
    """
    progress(0.0, "reading noise and levels")
    problem, step_s = prepare(spec, records, loss=loss)
    coarse = coarse_problem(problem, step_s)
    starts = [problem.start(), *_scattered(problem, problem.start())]
    found = []
    for trial, start in enumerate(starts):
        progress(0.1 + 0.5 * trial / len(starts), "fitting trajectories")
        found.append(approach(coarse, start, stands_for=problem.n_samples / coarse.n_samples))
    progress(0.6, "fitting all samples")
    best = min(found, key=lambda o: coarse.solve(o.unknowns, o.fit).cost)
    if coarse is not problem and best.status != "no_solution":
        fine = approach(problem, best.unknowns, rounds=1)
        best = replace(fine, iterations=best.iterations + fine.iterations)
    if best.status == "no_solution":
        raise ModelError(f"calibration failed: {ADVICE[best.status]}")
    progress(0.9, "weighing what is left")
    return Calibration(problem, best, fit_whitener(problem, problem.residuals(best.fit)), step_s)


def _scattered(problem: Problem, unknowns: FloatArray) -> list[FloatArray]:
    """Return further starts, in which the parameters that nobody guessed are scattered by a factor e."""
    parameters = problem.network.parameters
    guessed = np.flatnonzero([parameters.parameters[i].guessed for i in parameters.free_index])
    generator = np.random.default_rng(0)
    starts = []
    for _ in range(1, N_STARTS if guessed.size else 1):
        scattered = unknowns.copy()
        scattered[guessed] += generator.normal(0.0, 1.0, guessed.size)
        starts.append(scattered)
    return starts


def from_heat_fit(fit: HeatFit, max_step_s: float, *, near: Sequence[Optimum] = ()) -> Calibration:
    """Return the open-loop calibration that starts from a fit in the presence of latent heat.

    ``near`` are optima of the same problem found otherwise: the best of all is kept.
    """
    best = min([minimise(fit.problem, fit.unknowns()), *near], key=lambda o: o.fit.cost)
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


def _best_start(fit: HeatFit, progress: Progress) -> Optimum:
    """Return the best optimum from the heat fit, from the declared guesses, and where those are missing from others."""
    problem = fit.problem
    near = minimise(problem, approach(problem).unknowns)
    best = min(minimise(problem, fit.unknowns()), near, key=lambda o: o.fit.cost)
    for trial, scattered in enumerate(_scattered(problem, fit.unknowns()), start=1):
        progress(0.4 + 0.15 * trial, "fitting from other starting points")
        best = min(best, minimise(problem, scattered, max_iterations=40), key=lambda o: o.fit.cost)
    return best


def to_model(
    calibration: Calibration, effects: Sequence[Effect], notices: Sequence[str] = (), *, uncertain: bool = True
) -> CalibratedModel:
    """Return the calibrated model of a fit, with plain words, and with the covariance of its parameters unless told."""
    problem, optimum = calibration.problem, calibration.optimum
    network, spec = calibration.network, calibration.network.spec
    free = None
    if uncertain:
        free = trajectory_covariance(problem, optimum, calibration.whitener)[: problem.n_free, : problem.n_free]
    values = network.parameters.as_dict()
    misfit = dict(zip(spec.sensors, calibration.whitener.models, strict=True))
    return CalibratedModel(
        spec,
        tuple(_carrying(effect.at_parameters(values), network.parameters.free_names, free) for effect in effects),
        values,
        np.zeros((0, 0)) if free is None else free,
        () if free is None else network.parameters.free_names,
        {s: float(n) for s, n in zip(spec.sensors, problem.noise_K, strict=True)},
        {s: float(m.sigma_ou) for s, m in misfit.items()},
        {s: float(m.length_s) for s, m in misfit.items()},
        calibration.max_step_s,
        dict(network.layout.table_knots),
        _summary(calibration, effects, free, notices),
    )


def _carrying(effect: Effect, free_names: Sequence[str], covariance: FloatArray | None) -> Effect:
    """Return an effect with the covariance of its own parameters, where there is one."""
    if covariance is None:
        return effect
    own = [free_names.index(p.name) for p in effect.parameters()]
    return effect.learned(covariance[np.ix_(own, own)])


def _summary(
    calibration: Calibration, effects: Sequence[Effect], covariance: FloatArray | None, notices: Sequence[str]
) -> Json:
    """Return the plain figures of a fit for people and JSON."""
    problem, optimum, network = calibration.problem, calibration.optimum, calibration.network
    by_name: dict[str, float] = {}
    told: dict[str, bool] = {}
    if covariance is not None:
        slopes = network.parameters.slopes(network.parameters.free)
        stds = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        for name in (f"{e.label}.{q.name}" for e in effects for q in e.qualities() if q.open_ended):
            position = network.parameters.free_names.index(name)
            if is_open_ended(problem, optimum, position):
                stds[position] = network.parameters.prior_std[position]
        by_name = dict(zip(network.parameters.free_names, (stds * slopes).tolist(), strict=True))
        told = identified(network.parameters, stds)
    fit = score(network.spec.sensors, [s.measured_K for s in problem.segments], list(optimum.fit.predicted_K))
    first, last = problem.segments[0].record, problem.segments[-1].record
    heard = [n for s in problem.segments for n in s.record.notices]
    heard += orbit_notices(network.spec, [s.record for s in problem.segments])
    return {
        "train": {
            "start": first.present(first.time_s[0]),
            "stop": last.present(last.time_s[-1]),
            "samples": int(sum(s.valid.any(axis=1).sum() for s in problem.segments)),
            "segments": len(problem.segments),
        },
        "status": optimum.status,
        "advice": ADVICE[optimum.status],
        "iterations": optimum.iterations,
        **fit,
        "residual_whiteness": residual_whiteness(calibration.residuals),
        "criteria": acceptance(network.spec, fit["per_sensor"]),
        "parameters": [
            {
                "name": p.name,
                "unit": p.unit,
                "mean": p.value,
                "std": by_name.get(p.name),
                "identified": told.get(p.name),
                "held": p.frozen,
            }
            for p in network.parameters.parameters
        ],
        "words": [
            *unseen_nodes(network.spec, [e.where["nodes"] for e in effects if "nodes" in e.where]),
            *resting_channels(network.spec, [s.record for s in problem.segments]),
            *([NO_COVARIANCE] if covariance is None else words(network.parameters, covariance)),
        ],
        "correlations": [] if covariance is None else strong_correlations(network.parameters, covariance),
        "notices": list(dict.fromkeys([*notices, *heard])),
    }


def acceptance(spec: TwinSpec, per_sensor: Json) -> Json:
    """Return the correlation acceptance: worst bias and worst 99 % error over the sensors, and whether both are met."""
    bias = max((abs(row["bias_K"]) for row in per_sensor.values()), default=0.0)
    spread = max((row["q99_abs_K"] for row in per_sensor.values()), default=0.0)
    limits = spec.criteria
    met = bias <= limits.bias_K and spread <= limits.q99_abs_K
    return {
        "bias_K": bias,
        "q99_abs_K": spread,
        "limit_bias_K": limits.bias_K,
        "limit_q99_abs_K": limits.q99_abs_K,
        "met": bool(met),
    }
