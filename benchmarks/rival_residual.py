"""Two rivals that regress on the residual of the calibrated declared model: SINDy, and paper B's residual polynomial.

Both see the same residual heat, C dT/dt of the readings less what the declared balance says there, per sampling
interval. Residual and library pass through the same Savitzky-Golay filter, so that smoothing biases neither and no
switching instant is smeared on one side only. Filter, sparsity and degree are chosen by an open-loop rollout over the last
30 % of the training part, everything (the declared parameters too) fitted to what comes before; the choice is then fitted
to the whole of it. Not correcting at all is among the choices, and the simplest within 2 % of the best wins.
"""

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice, product

import numpy as np
from pysindy import STLSQ
from scipy.signal import savgol_filter

from benchmarks.rival_features import Feature, FeatureHeat, constant, library, powers
from twin_core.calibrate.optimise import minimise
from twin_core.calibrate.residual_noise import fit_whitener
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.second_order import Calibration
from twin_core.calibrate.starting import channel_levels
from twin_core.calibrate.summary import to_model
from twin_core.effects import REGISTRY
from twin_core.errors import TwinError
from twin_core.holdout import HeldOut, predict, split_fraction
from twin_core.network.dynamics import fill_boundaries
from twin_core.network.terms import Along
from twin_core.simulate.stages import balance_along
from twin_core.telemetry import Record

VALIDATED_SHARE = 0.3
SIMPLER_WITHIN = 1.02
WINDOWS = (11, 31, 61)
"""Samples of the Savitzky-Golay filter, second order."""

THRESHOLDS = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Of STLSQ, in standard deviations of the residual heat: of the largest one, or of each node's own."""

RIDGES = (1e-4, 1e-2)
"""Of STLSQ, per row: columns are scaled."""

DEGREES = (1, 2, 3)
IN_LIBRARY = (
    "constant_heat_load",
    "radiation_to_sink",
    "missing_conductor",
    "leak_to_boundary",
    "input_gain",
    "channel_heat_load",
    "periodic_heat_load",
)
"""Effects that a term of SINDy's library is."""


@dataclass(frozen=True)
class Residual:
    """What the calibrated declared model leaves of the rates of one record.

    Attributes
    ----------
    calibration
        Of the declared model, on one segment.
    window
        Samples of the filter.
    """

    calibration: Calibration
    window: int

    @cached_property
    def sensed(self) -> tuple[int, ...]:
        """Nodes with a sensor: nobody sees the rates of the others."""
        return tuple(dict.fromkeys(self.calibration.problem.network.sensor_node.tolist()))

    @cached_property
    def n_rows(self) -> int:
        """Intervals up to the last reading; the filter sees nothing beyond it."""
        seen = np.flatnonzero(self.calibration.problem.segments[0].valid.any(axis=1))
        last, n_samples = int(seen[-1]), self.readings_K.shape[0]
        return last if last == n_samples - 1 else max(last - self.window // 2, 1)

    @cached_property
    def readings_K(self) -> np.ndarray:
        """Readings per node, gaps bridged; of an unsensed node what the declared model says, (n_samples, n_nodes)."""
        problem, segment = self.calibration.problem, self.calibration.problem.segments[0]
        path = self.calibration.optimum.fit.trajectories[0]
        read = path.at_samples(segment.forcing.sample_step).copy()
        for sensor in reversed(range(problem.network.sensor_node.size)):
            seen, time_s = segment.valid[:, sensor], segment.record.time_s
            if seen.any():
                column = np.interp(time_s, time_s[seen], segment.measured_K[seen, sensor])
                read[:, problem.network.sensor_node[sensor]] = column
        return read

    @cached_property
    def stages_K(self) -> np.ndarray:
        """Smoothed temperatures at the stage points, (n_steps, 2, n_nodes)."""
        segment = self.calibration.problem.segments[0]
        smoothed = self.readings_K.copy()
        for node in self.sensed:
            smoothed[:, node] = self.filtered(smoothed[:, node])
        at = segment.forcing.stage_time_s
        columns = [np.interp(at, segment.record.time_s, column) for column in smoothed.T]
        return np.stack(columns, axis=-1)

    @cached_property
    def along(self) -> Along:
        """The stage points."""
        network, forcing = self.calibration.network, self.calibration.problem.segments[0].forcing
        flat = fill_boundaries(network, network.parameters.values, forcing.boundaries_flat_K(0, forcing.n_steps))
        return forcing.along(self.stages_K.reshape(-1, self.stages_K.shape[2]), flat, 0, forcing.n_steps)

    @cached_property
    def capacity_J_per_K(self) -> np.ndarray:
        """Calibrated capacities, (n_nodes,)."""
        network = self.calibration.network
        return network.parameters.values[network.capacity_index]

    @cached_property
    def heat_W(self) -> np.ndarray:
        """Heat that the readings need beyond the declared one, per interval, smoothed, (n_intervals, n_nodes)."""
        network, segment = self.calibration.network, self.calibration.problem.segments[0]
        forcing = segment.forcing
        declared = balance_along(network, network.parameters.values, forcing, self.stages_K, 0, forcing.n_steps)
        measured = np.diff(self.readings_K, axis=0) / np.diff(segment.record.time_s)[:, None]
        return self.capacity_J_per_K * self.filtered(measured - self.per_interval(declared.rate_K_per_s))

    def per_interval(self, points: np.ndarray) -> np.ndarray:
        """Return the mean over every sampling interval of what is given at the stage points."""
        forcing = self.calibration.problem.segments[0].forcing
        steps = points.reshape(forcing.n_steps, 2, -1)
        mean = steps.mean(axis=1)
        first = forcing.sample_step[:-1]
        total = np.add.reduceat(forcing.step_s[:, None] * mean, first, axis=0)
        return total / np.add.reduceat(forcing.step_s, first)[:, None]

    def filtered(self, series: np.ndarray) -> np.ndarray:
        """Return series smoothed along the samples."""
        size = min(self.window, (series.shape[0] - 1) // 2 * 2 + 1)
        return savgol_filter(series, size, 2, axis=0) if size > 2 else series

    def dominant_period_s(self, node: int) -> float:
        """Return the period that stands out most in a node's residual: at least two of them fit in the record."""
        heat = self.heat_W[:, node]
        power = np.abs(np.fft.rfft(heat - heat.mean())) ** 2
        power[:2] = 0.0
        return float(np.ptp(self.along.time_s)) / max(int(power.argmax()), 2)


@dataclass(frozen=True)
class Columns:
    """A library on the residual of one node, its columns scaled to one and, where wanted, centred.

    Centred, nearly constant columns are told apart, but the constant takes the mean of every other term.
    """

    residual: Residual
    node: int
    features: Sequence[Feature]
    centred: bool = True

    @cached_property
    def raw(self) -> np.ndarray:
        """The library, filtered as the residual is, (n_intervals, n_features)."""
        along = self.residual.along
        points = np.stack([feature.value(along) for feature in self.features], axis=-1)
        return self.residual.filtered(self.residual.per_interval(points))

    @cached_property
    def scale(self) -> tuple[np.ndarray, np.ndarray]:
        """What is subtracted from the columns and what divides them; infinite where one is constant: it weighs nothing."""
        middle = self.raw.mean(axis=0) if self.centred else np.zeros(self.raw.shape[1])
        moves = self.raw.std(axis=0) > 1e-9 * np.abs(self.raw).max(axis=0)
        return middle, np.where(moves, np.sqrt(np.mean((self.raw - middle) ** 2, axis=0)), np.inf)

    @cached_property
    def design(self) -> np.ndarray:
        """Ones and the scaled columns."""
        mean, std = self.scale
        return np.hstack([np.ones((self.raw.shape[0], 1)), (self.raw - mean) / std])

    @property
    def target(self) -> np.ndarray:
        """The residual heat, (n_intervals,)."""
        return self.residual.heat_W[:, self.node]

    def heat(self, coefficients: np.ndarray) -> FeatureHeat:
        """Return what was regressed, in W per scaled column, as a heat into the node."""
        mean, std = self.scale
        weights = coefficients[1:] / std
        kept = np.flatnonzero(weights)
        settings = {
            "features": [self.features[k] for k in kept],
            "weights": weights[kept],
            "offset_W": float(coefficients[0] - weights @ mean),
        }
        return FeatureHeat({"node": self.residual.calibration.network.nodes[self.node]}, {}, settings)


Coefficients = tuple[np.ndarray, ...]
"""Per sensed node (1 + n_features,)."""


@dataclass(frozen=True)
class Option:
    """One way to regress: the columns of every sensed node, and how their coefficients follow from rows."""

    columns: Sequence[Columns]
    regress: Callable[[Sequence[Columns], int], Coefficients]

    def fitted(self) -> Coefficients:
        """Return the coefficients from the intervals that are read."""
        return self.regress(self.columns, self.columns[0].residual.n_rows)

    def effects(self, coefficients: Coefficients) -> tuple[FeatureHeat, ...]:
        """Return the heats that are not nothing."""
        return tuple(c.heat(b) for c, b in zip(self.columns, coefficients, strict=True) if b.any())


def rms_error_K(model: CalibratedModel, held: Iterable[HeldOut]) -> float:
    """Return the error of an open-loop rollout over all sensors; infinite where it runs away."""
    try:
        predictions = [predict(model, h) for h in held]
    except TwinError:
        return float("inf")
    errors = np.concatenate([(p.measured_K - p.predicted_K)[np.isfinite(p.measured_K)] for p in predictions])
    return float(np.sqrt(np.mean(errors**2))) if np.isfinite(errors).all() else float("inf")


def _stlsq(threshold: float, ridge: float, *, shared: bool) -> Callable[[Sequence[Columns], int], Coefficients]:
    """Return the sequentially thresholded regression of all nodes, under one threshold or each under its own."""

    def regress(columns: Sequence[Columns], n_rows: int) -> Coefficients:
        sizes = np.array([c.target[:n_rows].std() for c in columns])
        sizes = np.maximum(np.full(sizes.size, sizes.max()) if shared else sizes, 1e-12)
        found = []
        for c, size in zip(columns, sizes, strict=True):
            solver = STLSQ(threshold=threshold, alpha=ridge * n_rows)
            solver.fit(c.design[:n_rows], c.target[:n_rows, None] / size)
            found.append(size * np.ravel(solver.coef_))
        return tuple(found)

    return regress


def _least_squares(columns: Sequence[Columns], n_rows: int) -> Coefficients:
    return tuple(np.linalg.lstsq(c.design[:n_rows], c.target[:n_rows], rcond=1e-10)[0] for c in columns)


def _sindy_options(calibration: Calibration) -> Iterable[Option]:
    layout, records = calibration.network.layout, [s.record for s in calibration.problem.segments]
    levels = {n: channel_levels(records, n) for n, c in calibration.network.spec.channels.items() if c.levels}
    for window in WINDOWS:
        residual = Residual(calibration, window)
        libraries = {
            i: library(layout, layout.nodes[i], levels, residual.dominant_period_s(i)) for i in residual.sensed
        }
        for centred in (True, False):
            columns = [Columns(residual, i, features, centred) for i, features in libraries.items()]
            for shared, ridge, threshold in product((True, False), RIDGES, THRESHOLDS):
                yield Option(columns, _stlsq(threshold, ridge, shared=shared))


def _polynomial_options(calibration: Calibration) -> Iterable[Option]:
    for window in WINDOWS:
        residual = Residual(calibration, window)
        low, high = residual.stages_K.min(axis=(0, 1)), residual.stages_K.max(axis=(0, 1))
        for degree in DEGREES:
            columns = [Columns(residual, i, powers(i, low[i], high[i], degree)) for i in residual.sensed]
            yield Option(columns, _least_squares)


def shortened(calibration: Calibration, share: float) -> Calibration:
    """Return the declared model calibrated on the first share of its record; the rest is there, unread."""
    problem = calibration.problem
    segment = problem.segments[0]
    unread = np.arange(segment.measured_K.shape[0])[:, None] >= share * segment.measured_K.shape[0]
    early = replace(segment, measured_K=np.where(unread, np.nan, segment.measured_K))
    problem = replace(problem, segments=(early,))
    optimum = minimise(problem, calibration.optimum.unknowns, near=calibration.optimum.fit)
    return Calibration(problem, optimum, fit_whitener(problem, problem.residuals(optimum.fit)), calibration.max_step_s)


def _chosen(
    calibration: Calibration, record: Record, options: Callable[[Calibration], Iterable[Option]]
) -> tuple[Option, Coefficients] | None:
    """Return the simplest option close to the best on the validation part, fitted to all; None to leave the model alone."""
    inner = split_fraction([record], VALIDATED_SHARE)[1]
    early = shortened(calibration, 1.0 - VALIDATED_SHARE)
    model = to_model(early, (), uncertain=False)
    weighed: dict[object, tuple[float, int, int | None]] = {"nothing": (rms_error_K(model, inner), 0, None)}
    for k, option in enumerate(options(early)):
        coefficients = option.fitted()
        support = np.concatenate([b != 0.0 for b in coefficients])
        key = (option.columns[0].residual.window, support.tobytes())
        if support.any() and key not in weighed:
            corrected = replace(model, effects=option.effects(coefficients))
            weighed[key] = (rms_error_K(corrected, inner), int(support.sum()), k)
    best = min(error for error, _, _ in weighed.values())
    near = (w for w in weighed.values() if w[0] <= SIMPLER_WITHIN * best)
    chosen = min(near, key=lambda w: (w[1], w[0]))[2]
    if chosen is None:
        return None
    option = next(islice(options(calibration), chosen, None))
    return option, option.fitted()


@dataclass(frozen=True)
class Regressed:
    """A rival's answer: the names it gives, the most important first, and its model."""

    named: list[dict[str, object]]
    model: CalibratedModel


def residual_polynomial(calibration: Calibration, model: CalibratedModel, record: Record) -> Regressed:
    """Correct every sensed node by a polynomial of its own temperature; it names nothing.

    Kouw et al. take y - m for a rate, which it is only where samples are a second apart; here the residual is a heat.
    """
    found = _chosen(calibration, record, _polynomial_options)
    return Regressed([], model if found is None else replace(model, effects=found[0].effects(found[1])))


def sindy(calibration: Calibration, model: CalibratedModel, record: Record) -> Regressed:
    """Correct every sensed node by sequentially thresholded least squares on a physical library (pysindy's STLSQ)."""
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", UserWarning
        )  # it warns of thresholds that leave nothing: a choice like any other
        found = _chosen(calibration, record, _sindy_options)
    if found is None:
        return Regressed([], model)
    return Regressed(names(*found), replace(model, effects=found[0].effects(found[1])))


def names(option: Option, coefficients: Coefficients) -> list[dict[str, object]]:
    """Return what the vocabulary calls the terms, largest contribution first: terms of one effect and place count together."""
    sizes: dict[object, float] = {}
    rows: dict[object, dict[str, object]] = {}
    for columns, own in zip(option.columns, coefficients, strict=True):
        node = columns.residual.calibration.network.nodes[columns.node]
        terms = [Feature(constant(), {}, "constant_heat_load", {"node": node}), *columns.features]
        here: dict[object, float] = {}
        for feature, size in zip(terms, own, strict=True):
            if feature.effect is not None and size != 0.0:
                key = REGISTRY[feature.effect](feature.where, {}).place
                rows.setdefault(key, {"effect": feature.effect, "where": feature.where})
                here[key] = float(np.hypot(here.get(key, 0.0), size))
        for key, size in here.items():
            sizes[key] = max(sizes.get(key, 0.0), size)
    return [rows[key] for key in sorted(sizes, key=lambda k: -sizes[k])]
