"""Correlation against several phases at once: thermal balance phases at rest beside transients."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin_core._typing import FloatArray, Json, Progress, no_progress
from twin_core.calibrate.approach import misfit_K
from twin_core.calibrate.choice import by_sensitivity
from twin_core.calibrate.containment import NO_DEADLINE
from twin_core.calibrate.criteria import acceptance, with_met
from twin_core.calibrate.explained import explained
from twin_core.calibrate.noise import sensor_noise_K
from twin_core.calibrate.optimise import minimise
from twin_core.calibrate.problem import Problem
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.second_order import READINGS_PER_UNKNOWN, Calibration, Loss, fit_trajectories
from twin_core.calibrate.starting import table_levels
from twin_core.calibrate.statistics import score, spread_of
from twin_core.calibrate.summary import to_model
from twin_core.errors import ModelError, TelemetryError
from twin_core.network.calibrated import with_values
from twin_core.network.dynamics import evaluate_balance, fill_boundaries
from twin_core.network.model import build_network, told_values
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.network.terms import Along
from twin_core.simulate.forcing import build_forcing
from twin_core.telemetry import Record
from twin_core.units import to_si

SETTLED = 20.0
"""A phase at rest has rested for so many of the slowest time constants of the declared network: what a hidden node began with
is gone, were it slower by a factor of three."""
SAMPLES_AT_REST = (50, 2000)
"""Fewest and most samples that stand for a phase at rest; in between it counts as much as the longest transient."""
MOST_NAMED = 20
"""Names in a message."""
MOST_DRAWN = 3000
"""Samples of a transient in a picture."""
LONGEST_S = 1e9
"""A time constant beyond that is none: the network has no way to lose heat."""


@dataclass(frozen=True)
class Phase:
    """One phase of a test or of a flight.

    Attributes
    ----------
    name
        What it is called in tables.
    record
        Its telemetry in SI; of a phase at rest constant.
    steady
        Whether it is a phase at rest.
    """

    name: str
    record: Record
    steady: bool


@dataclass(frozen=True, repr=False)
class Correlation:
    """A model correlated with several phases, how well it meets each of them, and what is drawn of transients."""

    model: CalibratedModel
    calibration: Calibration
    report: Json
    plots: Json

    def __repr__(self) -> str:
        """Tell what came of it in one line."""
        before, after = self.report["before"]["rmse_K"], self.report["after"]["rmse_K"]
        phases = len(self.report["phases"])
        return f"<Correlation {self.report['twin']}: {phases} phases, rmse {before:.3g} K declared, {after:.3g} K correlated>"


def at_rest(
    spec: TwinSpec,
    name: str,
    values: Mapping[str, float],
    *,
    samples: int = SAMPLES_AT_REST[0],
    epoch_ns: int | None = None,
) -> Phase:
    """Return a thermal balance phase: constant inputs, and the readings to which everything has come to rest.

    It becomes a record of constant readings that is as long as hidden nodes need to come to rest as well. So a phase at rest is
    telemetry like any other: nothing of calibration has another path for it.

    Parameters
    ----------
    spec
        The declared network.
    name
        What the phase is called.
    values
        Channel -> value in the channel's own unit; sensors that were not read are left out.
    samples
        How many samples stand for it: its weight in the fit. They are more where a network has many nodes and few sensors: the
        initial temperature of every node is an unknown, although it leaves no trace.
    epoch_ns
        Unix nanoseconds of the phase, where the other phases are dated.

    Raises
    ------
    TelemetryError
        If an input or boundary is missing, or nothing was read.
    ModelError
        If the network comes from an orbit, or never comes to rest.
    """
    if spec.orbit is not None:
        raise ModelError(
            "orbit: a spacecraft in orbit is at rest nowhere; give a phase at rest a specification without one"
        )
    known = {c: v for c, v in values.items() if c in spec.channels and np.isfinite(v)}
    lacking = sorted(set(spec.driving_channels) - known.keys())
    if lacking:
        raise TelemetryError(
            f"phase '{name}': '{lacking[0]}' is missing; a phase at rest needs every input and boundary"
        )
    read = [sensor for sensor in spec.sensors if sensor in known]
    if not read:
        raise TelemetryError(f"{name}: no sensor was read (known: {', '.join(spec.sensors)})")
    samples = max(samples, SAMPLES_AT_REST[0] + -(-READINGS_PER_UNKNOWN * len(spec.nodes) // len(read)))
    columns = {c: to_si(np.full(samples, v), spec.channels[c].unit) for c, v in known.items()}
    typical_K = float(np.mean([columns[sensor][0] for sensor in read]))
    moment = Record(np.array([0.0, 1.0]), {c: v[:2] for c, v in columns.items()}, epoch_ns, name)
    duration_s = SETTLED * slowest_s(spec, moment, typical_K)
    time_s = np.linspace(0.0, duration_s, samples)
    return Phase(name, Record(time_s, columns, epoch_ns, name, flaws=()), True)


def slowest_s(spec: TwinSpec, record: Record, typical_K: float) -> float:
    """Return the slowest time constant of a declared network at its guesses, about one temperature, in s."""
    network = build_network(spec)
    values, n = network.parameters.values, len(network.nodes)
    forcing = build_forcing(network, record, np.inf)
    along = Along(
        forcing.stage_time_s[0, :1] + forcing.epoch_s,
        np.full((1, n), typical_K),
        fill_boundaries(network, values, forcing.boundaries_K[0, :1]),
        {name: series[0, :1] for name, series in forcing.inputs.items()},
        forcing.sun_factor[0, :1],
        False,
    )
    rates = np.linalg.eigvals(evaluate_balance(network, values, along).jacobian_per_s[0]).real
    moving = rates[: n - len(network.extra)] if network.extra else rates
    slowest = float(-np.max(moving)) if moving.size else 0.0
    if slowest * LONGEST_S <= 1.0:
        raise ModelError("a node has no way to lose heat, so that nothing comes to rest: give it a boundary")
    return 1.0 / slowest


def weight_of(transients: Sequence[Record]) -> int:
    """Return how many samples stand for a phase at rest, so that it counts as much as the longest transient."""
    longest = max((record.time_s.size for record in transients), default=0)
    return int(np.clip(longest, *SAMPLES_AT_REST))


def correlate(
    spec: TwinSpec,
    phases: Sequence[Phase],
    *,
    loss: Loss = "squared",
    most_free: int | None = None,
    deadline: float = NO_DEADLINE,
    progress: Progress = no_progress,
) -> Correlation:
    """Fit a declared network to several phases at once.

    Parameters
    ----------
    spec
        The declared network.
    phases
        At rest or transient; each has its own initial state.
    loss, deadline, progress
        As in ``twin_core.calibrate.calibrate``.
    most_free
        Vary at most so many parameters, those that the sensors tell most of; the others keep their guesses. All by default.

    Returns
    -------
    Correlation
        Its report tells ``before`` (the values and guesses as they are declared, initial states at their best) and ``after``,
        over all phases and under ``phases`` for each: mean, standard deviation and quantiles of the deviations per sensor, and
        whether the criteria are met.

    Raises
    ------
    TelemetryError, ModelError, NoSolutionError
        As ``twin_core.calibrate.calibrate``.
    """
    names = [phase.name for phase in phases]
    twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
    if twice is not None:
        raise TelemetryError(f"phase '{twice}': two phases have this name; each counts once")
    stated = _with_noise(spec, [phase.record for phase in phases if not phase.steady])
    records = [phase.record for phase in phases]
    unseen: tuple[str, ...] = ()
    if all(phase.steady for phase in phases):
        stated, unseen = _with_capacities_held(stated, records)
    held: tuple[str, ...] = ()
    if most_free is not None:
        progress(0.0, "choosing what to vary")
        stated, held = by_sensitivity(stated, records, most_free)
    calibration = fit_trajectories(stated, records, loss=loss, deadline=deadline, progress=progress)
    model = explained(to_model(calibration, ()), calibration, deadline=deadline)
    read_K = {"before": _as_declared(calibration.problem), "after": list(calibration.optimum.fit.predicted_K)}
    measured_K = [segment.measured_K for segment in calibration.problem.segments]
    of_phases = [
        (phase, measured_K[i], {when: table[i] for when, table in read_K.items()}) for i, phase in enumerate(phases)
    ]
    report: Json = {
        "twin": spec.twin,
        "verdict": "correlated",
        **_over_all(spec, measured_K, read_K),
        "phases": [
            {
                "phase": phase.name,
                "steady": phase.steady,
                "samples": int(np.isfinite(measured).any(axis=1).sum()),
                **{when: _of_phase(spec, phase, measured, predicted) for when, predicted in tables.items()},
            }
            for phase, measured, tables in of_phases
        ],
        "parameters": _rows(model, calibration),
        "correlations": model.summary["correlations"],
        "words": [line for line in model.summary["words"] if "never changes" not in line],
        "notices": [*_told_unseen(unseen), *_told_held(held), *model.summary["notices"]],
    }
    plots = {
        phase.name: _series(spec, phase, measured, tables) for phase, measured, tables in of_phases if not phase.steady
    }
    return Correlation(model, calibration, report, plots)


def _over_all(spec: TwinSpec, measured_K: Sequence[FloatArray], read_K: Mapping[str, Sequence[FloatArray]]) -> Json:
    """Return scores over all phases, before and after, and whether they meet the criteria."""
    scores = {when: with_met(spec, score(spec.sensors, measured_K, tables)) for when, tables in read_K.items()}
    return {**scores, "criteria": {when: acceptance(spec, row["per_sensor"]) for when, row in scores.items()}}


def _with_capacities_held(spec: TwinSpec, records: Sequence[Record]) -> tuple[TwinSpec, tuple[str, ...]]:
    """Hold capacities at their guesses; return their names too.

    Readings at rest tell nothing of them, but a fit would make them large where a phase is not met exactly: the model then
    lingers at its initial temperatures, which are fitted.
    """
    network = build_network(spec, table_knots=table_levels(spec, records))
    parameters = network.parameters
    own = {parameters.ties.get(int(index), (int(index), 1.0))[0] for index in network.capacity_index}
    names = [parameters.parameters[int(index)].name for index in parameters.free_index if int(index) in own]
    values = parameters.as_dict()
    return load_spec(with_values(spec, {name: values[name] for name in names})), tuple(names)


def _told_unseen(names: Sequence[str]) -> list[str]:
    """Return what to say of capacities that no transient tells."""
    return [f"capacities keep their guesses, for phases at rest tell nothing of them: {_some(names)}"] if names else []


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:MOST_NAMED]) + (f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else "")


def _told_held(names: Sequence[str]) -> list[str]:
    """Return what to say of parameters that were not varied."""
    if not names:
        return []
    kept = "1 parameter keeps its guess" if len(names) == 1 else f"{len(names)} parameters keep their guesses"
    return [f"{kept}, for the sensors tell more of the others: {_some(names)}"]


def _series(spec: TwinSpec, phase: Phase, measured_K: FloatArray, tables: Mapping[str, FloatArray]) -> Json:
    """Return what a transient's pictures are drawn from: readings and both models by sensor, thinned evenly where many."""
    rows = np.unique(np.linspace(0, measured_K.shape[0] - 1, min(measured_K.shape[0], MOST_DRAWN)).round().astype(int))
    named = {"measured": measured_K, **tables}
    columns = {
        sensor: {
            name: [float(v) if np.isfinite(v) else None for v in table[rows, i].tolist()]
            for name, table in named.items()
        }
        for i, sensor in enumerate(spec.sensors)
        if np.isfinite(measured_K[:, i]).any()
    }
    record = phase.record
    return {"ends": [record.present(record.time_s[0]), record.present(record.time_s[-1])], "sensors": columns}


def _with_noise(spec: TwinSpec, transients: list[Record]) -> TwinSpec:
    """Return a specification that states the noise of its sensors: constant readings of a phase at rest tell nothing of it."""
    noise = dict(zip(spec.sensors, sensor_noise_K(spec, transients), strict=True))
    channels = {
        name: channel.model_copy(update={"noise_std": float(noise[name])}) if name in noise else channel
        for name, channel in spec.channels.items()
    }
    return spec.model_copy(update={"channels": channels})


def _as_declared(problem: Problem) -> list[FloatArray]:
    """Return what the model reads at the declared values, its initial states fitted alone; NaN where it has no solution.

    The misfit counts as noise: weighed by that of the sensors alone, initial temperatures that no sensor reads would go to any
    length to make up for values that are wrong.
    """
    parameters = problem.network.parameters
    held = tuple(replace(p, frozen=True) for p in parameters.parameters)
    fixed = problem.with_network(problem.network.with_parameters(replace(parameters, parameters=held)))
    start = fixed.start()
    fit = fixed.solve(start)
    if np.isfinite(fit.cost):
        weighed = replace(fixed, noise_K=np.hypot(fixed.noise_K, misfit_K(fixed, fit)))
        return list(minimise(weighed, start, near=fit).fit.predicted_K)
    return [np.full(segment.measured_K.shape, np.nan) for segment in problem.segments]


def _of_phase(spec: TwinSpec, phase: Phase, measured_K: FloatArray, predicted_K: FloatArray) -> Json:
    """Return the figures of one phase: per sensor and over all, a phase at rest by the temperatures at which it ends."""
    deviation = (measured_K - predicted_K)[-1:] if phase.steady else measured_K - predicted_K
    per_sensor = {}
    for i, sensor in enumerate(spec.sensors):
        finite = deviation[:, i][np.isfinite(deviation[:, i])]
        if finite.size:
            per_sensor[sensor] = {**spread_of(finite), "rmse_K": float(np.sqrt(np.mean(finite**2)))}
    if not per_sensor:
        return {}
    rows = acceptance(spec, per_sensor)["per_sensor"]
    everything = deviation[np.isfinite(deviation)]
    return {
        **spread_of(everything),
        "rmse_K": float(np.sqrt(np.mean(everything**2))),
        "met": all(row["met"] for row in rows.values()),
        "per_sensor": {sensor: {**row, "met": rows[sensor]["met"]} for sensor, row in per_sensor.items()},
    }


def _rows(model: CalibratedModel, calibration: Calibration) -> list[Json]:
    """Return every parameter as it was declared and as it was correlated."""
    declared = build_network(model.spec, table_knots=model.table_knots)
    values = told_values(declared)
    stated = {p.name: values[p.name] for p in declared.parameters.parameters if not p.guessed}
    return [
        {
            "name": row["name"],
            "unit": row["unit"],
            "declared": stated.get(row["name"]),
            "corrected": {"mean": row["mean"], "std": row["std"]},
            "identified": row["identified"],
        }
        for row in model.summary["parameters"]
    ]
