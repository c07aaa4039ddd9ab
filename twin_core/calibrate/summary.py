"""What is told of a fit: the calibrated model with its uncertainty, its figures, and in words what the data cannot see."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from twin_core._typing import FloatArray, Json
from twin_core.calibrate.containment import attempted
from twin_core.calibrate.covariance import is_open_ended, noise_of_fit, trajectory_covariance
from twin_core.calibrate.criteria import acceptance, with_met
from twin_core.calibrate.identifiability import (
    blurred_levels,
    identified,
    resting_channels,
    strong_correlations,
    unseen_nodes,
    untold_words,
    words,
)
from twin_core.calibrate.optimise import ADVICE
from twin_core.calibrate.restricted import ExpectedNoise, no_longer
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.second_order import Calibration
from twin_core.calibrate.statistics import residual_whiteness, score
from twin_core.effects.base import Effect
from twin_core.network.model import Network, build_network, told_values
from twin_core.simulate.orbit_inputs import orbit_notices

NO_COVARIANCE = "no uncertainty of the parameters is stated; forecasts carry only that of state and misfit"
NO_UNCERTAINTY = "the uncertainty of the parameters could not be computed"


def to_model(
    calibration: Calibration, effects: Sequence[Effect], notices: Sequence[str] = (), *, uncertain: bool = True
) -> CalibratedModel:
    """Return the calibrated model of a fit, with plain words, and with the covariance of its parameters unless told.

    Where it states one, its misfit is that which the fit was made from, else what the fit has left of it.
    """
    problem = calibration.problem
    network, spec = calibration.network, calibration.network.spec
    free, failures = None, list[str]()
    left = [no_longer(model, problem.span_s) for model in calibration.whitener.models]
    misfit = [(float(model.sigma_ou), float(model.length_s)) for model in left]
    if uncertain:
        told = attempted(partial(_uncertainty, calibration), NO_UNCERTAINTY, failures)
        if told is not None:
            free, noise = told
            misfit = [own.misfit or (0.0, length_s) for own, (_, length_s) in zip(noise, misfit, strict=True)]
    values = network.parameters.as_dict()
    return CalibratedModel(
        spec,
        tuple(_carrying(effect.at_parameters(values), network.parameters.free_names, free) for effect in effects),
        values,
        np.zeros((0, 0)) if free is None else free,
        () if free is None else network.parameters.free_names,
        {s: float(n) for s, n in zip(spec.sensors, problem.noise_K, strict=True)},
        {s: std_K for s, (std_K, _) in zip(spec.sensors, misfit, strict=True)},
        {s: length_s for s, (_, length_s) in zip(spec.sensors, misfit, strict=True)},
        calibration.max_step_s,
        dict(network.layout.table_knots),
        _summary(calibration, effects, free, [*notices, *failures]),
    )


def _uncertainty(calibration: Calibration) -> tuple[FloatArray, list[ExpectedNoise]]:
    """Return the covariance of the free parameters and the noise it comes from; ArithmeticError where it is not finite."""
    fit = calibration.problem, calibration.optimum, calibration.whitener
    noise = noise_of_fit(*fit)
    free = trajectory_covariance(*fit, noise)[: calibration.problem.n_free, : calibration.problem.n_free]
    if not np.isfinite(free).all():
        raise ArithmeticError("it is not finite")
    return free, noise


def stated_guesses(network: Network) -> dict[str, float]:
    """Return name -> value of the free parameters that the specification guesses, of a network at its starting values."""
    declared = build_network(network.spec, table_knots=network.layout.table_knots).parameters.parameters
    told = [p.name for p in declared if not (p.guessed or p.frozen) and p.prior_std is not None]
    values = network.parameters.as_dict()
    return {name: values[name] for name in told}


def _carrying(effect: Effect, free_names: Sequence[str], covariance: FloatArray | None) -> Effect:
    """Return an effect with the covariance of its own parameters, where there is one."""
    if covariance is None:
        return effect
    own = [free_names.index(p.name) for p in effect.parameters() if not p.frozen]
    return effect.learned(covariance[np.ix_(own, own)])


def _summary(
    calibration: Calibration, effects: Sequence[Effect], covariance: FloatArray | None, notices: Sequence[str]
) -> Json:
    """Return the plain figures of a fit for people and JSON."""
    problem, optimum, network = calibration.problem, calibration.optimum, calibration.network
    untold = np.flatnonzero(np.diag(optimum.hessian)[: problem.n_free] <= 0.0)
    by_name: dict[str, float | None] = {}
    values = told_values(network)
    told: dict[str, bool] = {}
    if covariance is not None:
        slopes = network.parameters.slopes(network.parameters.free)
        stds = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        stds[untold] = np.inf
        for name in (f"{e.label}.{q.name}" for e in effects for q in e.parameter_specs() if q.open_ended):
            position = network.parameters.free_names.index(name)
            if is_open_ended(problem, optimum, position):
                stds[position] = network.parameters.prior_std[position]
        finite = [std if np.isfinite(std) else None for std in (stds * slopes).tolist()]
        by_name = dict(zip(network.parameters.free_names, finite, strict=True))
        told = identified(network.parameters, stds)
    fit = score(network.spec.sensors, [s.measured_K for s in problem.segments], list(optimum.fit.predicted_K))
    fit = with_met(network.spec, fit)
    first, last = problem.segments[0].record, problem.segments[-1].record
    heard = [n for s in problem.segments for n in s.record.notices]
    heard += blurred_levels(network, [s.record for s in problem.segments])
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
                "mean": values[p.name],
                "std": by_name.get(p.name),
                "identified": told.get(p.name),
                "held": p.frozen,
            }
            for p in network.parameters.parameters
            if p.tied_to is None  # what is tied is told by what it is tied to
        ],
        "words": [
            *unseen_nodes(network.spec, [e.where["nodes"] for e in effects if "nodes" in e.where]),
            *resting_channels(network.spec, [s.record for s in problem.segments]),
            *untold_words(network, [s.record for s in problem.segments], untold),
            *([NO_COVARIANCE] if covariance is None else _words(calibration, covariance)),
        ],
        "correlations": [] if covariance is None else strong_correlations(network.parameters, covariance),
        "notices": list(dict.fromkeys([*notices, *heard])),
    }


def _words(calibration: Calibration, covariance: FloatArray) -> list[str]:
    """Return what the data cannot see, in words; nothing where the arithmetic fails."""
    guesses = stated_guesses(calibration.problem.network)
    return attempted(lambda: words(calibration.network.parameters, covariance, guesses), "words", []) or []
