"""What to do next: the experiment that would tell a finding from what the record cannot tell it from.

The last stretch of the training record is flown again with one input moved at a time, within the limits that are declared for
it. Each option predicts what the sensors would read, as a Gaussian: its trajectory, the uncertainty of its parameters and
initial temperatures, and the coloured noise of the residuals. The gain of an experiment is the mutual information of the
option and the readings, the entropy over the options that it is expected to take away (D. V. Lindley, Ann. Math. Statist. 27
(1956) 986; for rival models G. E. P. Box, W. J. Hill, Technometrics 9 (1967) 57). Options that nobody listed, and a misfit that
the training record did not show, are not counted: the figures are upper bounds.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from scipy.special import logsumexp, softmax

from twin_core._typing import FloatArray, Json
from twin_core.calibrate.covariance import gls_covariance
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.calibrate.residual_noise import Whitener
from twin_core.discover.judge import Finding
from twin_core.discover.trial import Trial
from twin_core.network.spec import TwinSpec
from twin_core.telemetry import Record
from twin_core.units import to_si

MAX_ALTERNATIVES = 3
N_KEPT = 3
N_WEIGHED = 6
"""Experiments whose gain is computed: those in which the mean readings part most, and the same stretch again."""
DECISIVE_STD = 3.0
"""Readings that part by this many standard deviations of the noise, rms over the stretch, tell two models apart."""

PULSE_SHARES = (0.25, 0.5)
"""The part of the stretch in which an input is moved."""

LONG_S = 7200.0
"""From this duration on, in s, words tell it in hours."""

WARMER_K = 10.0
N_DRAWS = 1000
"""Readings that are drawn from each option: the gain is good to some 0.02 bit."""


@dataclass(frozen=True)
class Plan:
    """A stretch of telemetry as it would be with one input moved.

    Attributes
    ----------
    words
        What to do.
    record
        The stretch; its readings are those of the stretch that it repeats.
    channel, value, duration_s
        What is held, at what, in the channel's SI unit, and how long before the end; None where all stays as it was. A
        boundary is moved by ``value``.
    """

    words: str
    record: Record
    channel: str | None = None
    value: float | None = None
    duration_s: float | None = None

    @property
    def row(self) -> Json:
        """Return it for a report."""
        return {"channel": self.channel, "value": self.value, "duration_s": self.duration_s}


@dataclass(frozen=True)
class Experiment:
    """A stretch flown with one input moved, how far apart two models then are, and what it is expected to tell.

    Attributes
    ----------
    words
        What to do.
    sensor
        Where it shows most.
    apart_K, apart_std
        Rms difference of the models there, in kelvin and in standard deviations of its noise.
    gain_bits, entropy_bits
        Expected loss of entropy over the options, and that entropy before.
    plan
        What to do, for machines.
    """

    words: str
    sensor: str
    apart_K: float
    apart_std: float
    gain_bits: float = 0.0
    entropy_bits: float = 0.0
    plan: Json = field(default_factory=dict)

    @property
    def decides(self) -> bool:
        """Whether the difference stands out of the noise."""
        return self.apart_std > DECISIVE_STD

    def row(self) -> Json:
        """Return it for a report."""
        return {
            "experiment": self.words,
            "sensor": self.sensor,
            "apart_K": self.apart_K,
            "apart_std": self.apart_std,
            "decides": self.decides,
            "expected_gain_bits": self.gain_bits,
            "entropy_bits": self.entropy_bits,
            "plan": self.plan,
        }


def separating(finding: Finding) -> list[Experiment]:
    """Return the experiments that would best tell a finding from its alternatives, the most telling first.

    None without alternatives. Where limits are declared, inputs keep to the inner ones and no option may leave those of a
    temperature; an input without limits keeps to what the record has visited.
    """
    options = [finding.judged, *finding.alternatives[:MAX_ALTERNATIVES]]
    if len(options) < 2:
        return []
    trials = [option.trial for option in options]
    weights = softmax([option.evidence.log_bayes_factor for option in options])
    own = trials[0].calibration()
    record = own.problem.segments[-1].record
    flown = []
    for plan in plans(own.problem.network.spec, record):
        models = [_Flight.of(trial, plan.record) for trial in trials]
        if all(model.is_possible for model in models):
            flown.append((_apart(models, own.problem.noise_K), plan, models))
    again, rest = flown[:1], sorted(flown[1:], key=lambda item: -item[0][2])
    covariances = [_covariance(trial) for trial in trials]
    found = []
    for (sensor, apart_K, apart_std), plan, models in [*again, *rest[:N_WEIGHED]]:
        predicted = [model.predicted(cov, own.whitener) for model, cov in zip(models, covariances, strict=True)]
        told = (information_bits(predicted, weights), entropy_bits(weights))
        name = own.problem.network.spec.sensors[sensor]
        found.append(Experiment(plan.words, name, apart_K, apart_std, *told, plan.row))
    return sorted(found, key=lambda e: (-round(e.gain_bits, 2), -e.apart_std))[:N_KEPT]


def plans(spec: TwinSpec, record: Record) -> Iterator[Plan]:
    """Yield what could be done: the stretch again as it was, then with one input moved at a time.

    Where any input has limits, those that have them are what can be commanded. Sunlight never is: loads that are ``solar``,
    and channels that the orbit gives.
    """
    span_s = float(np.ptp(record.time_s))
    yield Plan(f"a further {span_s:.0f} s like the last", record)
    boundaries = {b.channel: name for name, b in spec.boundaries.items() if b.channel is not None}
    limited = any(c.limits is not None for c in spec.channels.values() if c.kind != "temperature")
    sunlit = {load.channel for load in spec.loads if load.solar and load.table is None}
    for name, column in record.values.items():
        channel = spec.channels.get(name)
        if channel is None or not np.isfinite(column).any() or name in spec.sensors or name in sunlit:
            continue
        if limited and channel.limits is None and name not in boundaries:
            continue
        low, high = _range(spec, name, column)
        if name in boundaries:
            mean = float(np.nanmean(column))
            warmer = min(WARMER_K, high - mean) if channel.limits is not None else WARMER_K
            moves = [(f"{boundaries[name]} {warmer:.0f} K warmer", column + warmer, warmer)] if warmer > 0.0 else []
        elif channel.kind == "power":
            moves = [
                ("off" if end == 0.0 else f"held at {end:.4g} W", np.full_like(column, end), end) for end in (low, high)
            ]
            moves = [(f"{name} {words}", values, end) for words, values, end in moves]
        elif channel.kind == "auxiliary":
            moves = [(f"{name} held at {end:.4g}", np.full_like(column, end), end) for end in (low, high)]
        else:
            continue
        for (words, values, end), share in product(moves, PULSE_SHARES):
            during = record.time_s >= record.time_s[-1] - share * span_s
            moved = {**record.values, name: np.where(during, values, column)}
            duration_s = share * span_s
            told = f"{duration_s:.0f} s" if duration_s < LONG_S else f"{duration_s / 3600.0:.3g} h"
            yield Plan(f"{words} for {told}", replace(record, values=moved), name, end, duration_s)


def _range(spec: TwinSpec, name: str, column: FloatArray) -> tuple[float, float]:
    """Return between what a channel may be put: its inner limits, else what it has visited, and off for a power."""
    channel = spec.channels[name]
    low, high = float(np.nanmin(column)), float(np.nanmax(column))
    low = min(low, 0.0) if channel.kind == "power" else low
    return _inner(spec, name, low, high)


def _inner(spec: TwinSpec, name: str, low: float, high: float) -> tuple[float, float]:
    """Return the inner limits of a channel in SI, and the given ends where a side has none."""
    channel, ends = spec.channels[name], [low, high]
    for colour in (channel.limits.red, channel.limits.yellow) if channel.limits is not None else ():
        for side, end in enumerate(colour or ()):
            ends[side] = ends[side] if end is None else float(to_si(np.array([end]), channel.unit)[0])
    return ends[0], ends[1]


def keeps_limits(spec: TwinSpec, readings_K: FloatArray) -> bool:
    """Return whether readings (n_times, n_sensors) are finite and within the inner limits of their channels."""
    low, high = np.array([_inner(spec, sensor, -np.inf, np.inf) for sensor in spec.sensors]).T
    return bool(np.isfinite(readings_K).all() and (readings_K >= low).all() and (readings_K <= high).all())


@dataclass(frozen=True)
class _Flight:
    """One option over one plan, flown from where the last stretch of training began."""

    problem: Problem
    unknowns: FloatArray
    readings_K: FloatArray

    @classmethod
    def of(cls, trial: Trial, record: Record) -> "_Flight":
        """Fly a stretch."""
        calibration = trial.calibration()
        before, network = calibration.problem, calibration.network
        problem = build_problem(network, [record], before.noise_K, trial.max_step_s)
        unknowns = calibration.optimum.unknowns
        own = np.concatenate([unknowns[: before.n_free], unknowns[before.start_columns(len(before.segments) - 1)]])
        return cls(problem, own, problem.solve(own).predicted_K[0])

    @property
    def is_possible(self) -> bool:
        """Whether there is a solution and it keeps to the limits of the temperatures."""
        return keeps_limits(self.problem.network.spec, self.readings_K)

    def predicted(self, covariance: FloatArray, whitener: Whitener) -> tuple[FloatArray, FloatArray]:
        """Return mean and factor of the readings in a metric in which the noise is one, (n,) and (n, n_unknowns)."""
        fit = self.problem.solve(self.unknowns)
        block = self.problem.jacobian_blocks(self.unknowns, fit)[0]
        values, vectors = np.linalg.eigh(covariance)
        factor = block @ (vectors * np.sqrt(np.maximum(values, 0.0)))
        columns = np.concatenate([self.readings_K[:, :, None], factor], axis=2)
        time_s = self.problem.segments[0].record.time_s
        every = np.ones(time_s.size, dtype=np.bool_)
        white = np.concatenate(
            [
                model.whiten(time_s, np.ascontiguousarray(columns[:, sensor]), every)[0]
                for sensor, model in enumerate(whitener.models)
            ]
        )
        return white[:, 0], white[:, 1:]


def _covariance(trial: Trial) -> FloatArray:
    """Return the covariance of the free parameters and of the last segment's initial temperatures."""
    calibration = trial.calibration()
    problem = calibration.problem
    full = gls_covariance(problem, calibration.optimum, calibration.whitener)
    columns = np.r_[0 : problem.n_free, problem.start_columns(len(problem.segments) - 1)]
    return full[np.ix_(columns, columns)]


def _apart(models: Sequence[_Flight], noise_K: FloatArray) -> tuple[int, float, float]:
    """Return where the first option parts most from the one that it parts least from, in K and in standard deviations."""
    parted = []
    for rival in models[1:]:
        apart = np.sqrt(np.mean((models[0].readings_K - rival.readings_K) ** 2, axis=0))
        at = int(np.argmax(apart / noise_K))
        parted.append((at, float(apart[at]), float(apart[at] / noise_K[at])))
    return min(parted, key=lambda item: item[2])


def entropy_bits(weights: FloatArray) -> float:
    """Return the entropy of probabilities, (n_options,)."""
    seen = weights[weights > 0.0]
    return float(-(seen * np.log2(seen)).sum())


def information_bits(
    predicted: Sequence[tuple[FloatArray, FloatArray]], weights: FloatArray, *, n_draws: int = N_DRAWS
) -> float:
    """Return the mutual information of an option and the readings that it predicts.

    Parameters
    ----------
    predicted
        Mean (n,) and factor F (n, k) of each option: readings are normal with covariance 1 + F Fᵀ.
    weights : (n_options,)
        Probabilities of the options.
    n_draws
        Readings drawn from each option.

    Returns
    -------
    float
        In bits, between zero and the entropy of the weights.

    Raises
    ------
    ArithmeticError
        If what is predicted is not finite.
    """
    if not all(np.isfinite(part).all() for option in predicted for part in option):
        raise ArithmeticError("what an experiment would show is not finite")
    mean = predicted[0][0]
    every = np.column_stack([*(m - mean for m, _ in predicted[1:]), *(f for _, f in predicted)])
    # Outside what these columns span, readings are the same noise under every option; R holds the columns in a basis of it.
    turned: FloatArray = np.asarray(np.linalg.qr(every, mode="r"), dtype=np.float64)
    n_basis, first = turned.shape[0], len(predicted) - 1
    rng = np.random.default_rng(0)
    options: list[tuple[FloatArray, FloatArray]] = []
    for k, (_, factor) in enumerate(predicted):
        own = turned[:, first : first + factor.shape[1]]
        first += factor.shape[1]
        # A factor of 1 + F Fᵀ that never forms it: what the record hardly determines would drown the noise in rounding.
        root = np.asarray(np.linalg.qr(np.vstack([np.eye(n_basis), own.T]), mode="r"), dtype=np.float64).T
        options.append((np.zeros(n_basis) if k == 0 else turned[:, k - 1], root))
    total = 0.0
    with np.errstate(divide="ignore"):
        log_weights = np.log(weights)
    for k, (centre, root) in enumerate(options):
        half = rng.normal(size=(n_basis, n_draws // 2))
        drawn = centre[:, None] + root @ np.hstack([half, -half])
        log = np.stack([_log_density(drawn, *option) for option in options])
        total += weights[k] * float(np.mean(log[k] - logsumexp(log + log_weights[:, None], axis=0)))
    return float(np.clip(total / np.log(2.0), 0.0, entropy_bits(weights)))


def _log_density(drawn: FloatArray, centre: FloatArray, root: FloatArray) -> FloatArray:
    """Return the log density of normal readings (r, n_draws) but for a constant, (n_draws,)."""
    scaled = np.linalg.solve(root, drawn - centre[:, None])
    return np.asarray(-0.5 * (scaled**2).sum(axis=0) - np.log(np.abs(np.diag(root))).sum())
