"""A latent heat on every node over the steps of a rollout: the model in which parameters are fitted and effects weighed.

    states   x = [T_1 ... T_n | q_1 ... q_n]
    a step   T <- A T + B q + b,   q <- exp(-h / length) q + w,   Var w = (1 - exp(-2 h / length)) std²

The heat is the paper's, Matérn-1/2 (Kouw et al., CCTA 2024, eqs. 5-10), held over the step like the inputs of a rollout. A
and B are those of the rollout's own scheme, so that what is fitted here holds along trajectories;
:mod:`twin_core.latent_force.model` is the same model with exact steps, any kernel and any subset of nodes.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from twin_core._typing import BoolArray, FloatArray, IntArray
from twin_core.gp.state_space import LinearModel
from twin_core.latent_force.size_score import size_score
from twin_core.latent_force.whitening import whiten_columns
from twin_core.simulate.one_step import Steps

COLUMNS_AT_ONCE = 192
SAME_LENGTH = 1e-6
"""Steps whose lengths differ by less than this share are of one kind."""


@dataclass(frozen=True)
class Grid:
    """How the steps of a record repeat.

    Attributes
    ----------
    step_s : (n_kinds,)
        Lengths that differ.
    kind : (n_steps,)
        Which of them each step has.
    interval : (n_steps,)
        As in :func:`intervals`.
    """

    step_s: FloatArray
    kind: IntArray
    interval: IntArray

    def means(self, matrices: FloatArray) -> FloatArray:
        """Return the mean over all steps of a kind, (n_kinds, n, n), of (n_steps, n, n)."""
        if self.step_s.size == 1:
            return matrices.mean(axis=0, keepdims=True)
        counts = np.bincount(self.kind)
        begins = np.cumsum(counts) - counts
        gathered = np.add.reduceat(matrices[np.argsort(self.kind, kind="stable")], begins, axis=0)
        return np.asarray(gathered / counts[:, None, None])

    def means_of(self, steps: Steps) -> tuple[FloatArray, FloatArray]:
        """Return the means of A and of B."""
        return self.means(steps.transition), self.means(steps.heat_response_K_per_W)


def grid_of(step_s: FloatArray, sample_of: IntArray, valid: BoolArray) -> Grid:
    """Return how steps repeat: (n_steps,) lengths, (n_steps + 1,) samples on them, (n_samples, n_sensors) readings."""
    rounded = np.round(np.log(step_s) / SAME_LENGTH)
    _, first, kind = np.unique(rounded, return_index=True, return_inverse=True)
    kind = kind.ravel().astype(np.int64)
    return Grid(step_s[first], kind, intervals(kind, sample_of, valid))


def intervals(kind: IntArray, sample_of: IntArray, valid: BoolArray) -> IntArray:
    """Return for each step which kind of interval between samples it belongs to, (n_steps,); -1 where it is like no other.

    Alike are intervals of equally many steps of one kind that end with readings of the same sensors.
    """
    ends = np.flatnonzero(sample_of[1:] >= 0)  # steps that end in a sample
    if ends.size == 0:
        return np.full(kind.size, -1, dtype=np.int64)
    begins = np.concatenate([[0], ends[:-1] + 1])
    least, greatest = np.minimum.reduceat(kind, begins), np.maximum.reduceat(kind, begins)
    greatest[-1] = kind[begins[-1] : ends[-1] + 1].max()
    least[-1] = kind[begins[-1] : ends[-1] + 1].min()
    _, pattern = np.unique(valid[sample_of[ends + 1]], axis=0, return_inverse=True)
    table = np.stack([kind[ends], ends - begins, pattern.ravel()], axis=1)
    _, alike = np.unique(table, axis=0, return_inverse=True)
    alike = np.where(least == greatest, alike.ravel(), -1)
    found = np.full(kind.size, -1, dtype=np.int64)
    found[: ends[-1] + 1] = np.repeat(alike, ends - begins + 1)
    return found


@dataclass(frozen=True)
class HeldForce:
    """The model of one record.

    Attributes
    ----------
    step_s : (n_steps,)
    std_W : (n_nodes,)
        Stationary standard deviation of the heat on each node.
    length_s
        Its correlation length, shared.
    floor_K2 : (n_nodes,)
        Variance that every step adds to the temperatures: a filter that is certain of itself goes deaf.
    sensor_node : (n_sensors,)
        Node that each sensor reads.
    noise_K : (n_sensors,)
    start_std_K : (n_nodes,)
        Of the temperatures before the first sample.
    """

    step_s: FloatArray
    std_W: FloatArray
    length_s: float
    floor_K2: FloatArray
    sensor_node: IntArray
    noise_K: FloatArray
    start_std_K: FloatArray

    @property
    def decay(self) -> FloatArray:
        """Share of the heat that is left after each step, (n_steps,)."""
        return np.exp(-self.step_s / self.length_s)

    def whiten(
        self,
        columns: FloatArray,
        means: tuple[FloatArray, FloatArray],
        sample_of: IntArray,
        valid: BoolArray,
        grid: Grid | None = None,
    ) -> tuple[FloatArray, float]:
        """Return columns of readings in the metric of the model, and ln det of the readings' covariance.

        Undeclared heat reaches the sensors through the mean of A and B over all steps of the same length: how it spreads is a
        matter of its prior, and a filter whose steps are alike settles, so that a long record costs little.

        Parameters
        ----------
        columns : (n_samples, n_sensors, n_columns)
            Anything that adds to the readings, away from the model's own mean; NaN where not ``valid``.
        means : (n_kinds, n_nodes, n_nodes) each
            Of A and of B, d end / d start and d end / d heat, over each kind of step.
        sample_of : (n_steps + 1,)
            Sample at each point of the grid, -1 where there is none.
        valid : (n_samples, n_sensors)
        grid
            How the steps repeat, where it is known already.
        """
        model = self._prepared(means, sample_of, valid, grid)
        parts, log_det = [], 0.0
        for first in range(0, max(columns.shape[2], 1), COLUMNS_AT_ONCE):
            some = columns[:, :, first : first + COLUMNS_AT_ONCE]
            whitened, log_det = whiten_columns(*model, _without_gaps(some))
            parts.append(whitened)
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=2), log_det

    def score(
        self,
        residual: FloatArray,
        means: tuple[FloatArray, FloatArray],
        sample_of: IntArray,
        valid: BoolArray,
        grid: Grid | None = None,
    ) -> tuple[float, FloatArray]:
        """Return the log-likelihood of (n_samples, n_sensors) residuals, less its constant, and its slope in ln ``std_W``.

        The other parameters are those of :meth:`whiten`.
        """
        value, slope = size_score(*self._prepared(means, sample_of, valid, grid), _without_gaps(residual[:, :, None]))
        return float(value), slope

    def _prepared(
        self, means: tuple[FloatArray, FloatArray], sample_of: IntArray, valid: BoolArray, grid: Grid | None
    ) -> tuple[Any, ...]:
        """Return what the compiled filter takes before the columns."""
        grid = grid or grid_of(self.step_s, sample_of, valid)
        return (
            *means,
            np.exp(-grid.step_s / self.length_s),
            grid.kind,
            self.std_W**2,
            self.floor_K2,
            self.sensor_node,
            self.noise_K**2,
            self.start_std_K**2,
            sample_of,
            grid.interval,
            valid,
        )

    def linear_model(self, steps: Steps, drift_K: FloatArray, prior_mean_K: FloatArray) -> LinearModel:
        """Return the same model for filter and smoother, with A, B, b (n_steps, n_nodes) and a mean of the start (n_nodes,)."""
        n_steps, n = drift_K.shape
        own, heat = np.arange(n), np.arange(n, 2 * n)
        transition, process = np.zeros((n_steps, 2 * n, 2 * n)), np.zeros((n_steps, 2 * n, 2 * n))
        transition[:, :n, :n], transition[:, :n, n:] = steps.transition, steps.heat_response_K_per_W
        transition[:, heat, heat] = self.decay[:, None]
        process[:, own, own] = self.floor_K2
        process[:, heat, heat] = (1.0 - self.decay**2)[:, None] * self.std_W**2
        observation = np.zeros((self.noise_K.size, 2 * n))
        observation[np.arange(self.noise_K.size), self.sensor_node] = 1.0
        return LinearModel.build(
            transition=transition,
            process_cov=process,
            offset=np.hstack([drift_K, np.zeros((n_steps, n))]),
            observation=observation,
            noise_variance=self.noise_K**2,
            prior_mean=np.concatenate([prior_mean_K, np.zeros(n)]),
            prior_cov=np.diag(np.concatenate([self.start_std_K**2, self.std_W**2])),
            n_times=n_steps + 1,
        )


def _without_gaps(columns: FloatArray) -> FloatArray:
    """Return columns with zeros where there are no readings, laid out as the compiled filter takes them."""
    return np.ascontiguousarray(np.where(np.isnan(columns), 0.0, columns))
