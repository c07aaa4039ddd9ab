"""The record of a linear Gaussian state-space model in discrete time, checked once at its door."""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.errors import ModelError
from twin_core.gp.checked import numbers


class ModelArrays(NamedTuple):
    """The arrays of a :class:`LinearModel`, in the form that compiled code takes."""

    transition: FloatArray
    process_cov: FloatArray
    step_index: IntArray
    offset: FloatArray
    observation: FloatArray
    noise_variance: FloatArray
    prior_mean: FloatArray
    prior_cov: FloatArray


@dataclass(frozen=True)
class LinearModel:
    """x[k+1] = A[k] x[k] + b[k] + w[k], w ~ N(0, Q[k]); y[k] = H x[k] + v[k], v ~ N(0, diag(r)).

    Matrices that repeat are stored once: step k uses ``transition[step_index[k]]``. Build it with :meth:`build`.

    Attributes
    ----------
    transition, process_cov : (n_distinct, n_states, n_states)
    step_index : (n_steps,)
        n_steps = n_times - 1.
    offset : (n_steps, n_states)
    observation : (n_sensors, n_states)
    noise_variance : (n_sensors,)
    prior_mean : (n_states,)
    prior_cov : (n_states, n_states)
        Of the state at the first sample, before that sample is seen.
    """

    transition: FloatArray
    process_cov: FloatArray
    step_index: IntArray
    offset: FloatArray
    observation: FloatArray
    noise_variance: FloatArray
    prior_mean: FloatArray
    prior_cov: FloatArray

    @property
    def n_times(self) -> int:
        """Number of samples."""
        return self.step_index.size + 1

    @property
    def n_states(self) -> int:
        """Number of states."""
        return self.prior_mean.size

    @property
    def n_sensors(self) -> int:
        """Number of rows of the observation."""
        return self.observation.shape[0]

    @property
    def arrays(self) -> ModelArrays:
        """The arrays for compiled code."""
        return ModelArrays(*(getattr(self, name) for name in ModelArrays._fields))

    @classmethod
    def build(
        cls,
        *,
        transition: FloatArray,
        process_cov: FloatArray,
        observation: FloatArray,
        noise_variance: FloatArray,
        prior_mean: FloatArray,
        prior_cov: FloatArray,
        n_times: int,
        offset: FloatArray | None = None,
        step_index: IntArray | None = None,
    ) -> Self:
        """Fill in what may be left out, and check.

        Parameters
        ----------
        transition, process_cov : (n_states, n_states) or (n_distinct, n_states, n_states)
        observation : (n_sensors, n_states)
        noise_variance : (n_sensors,)
        prior_mean : (n_states,)
        prior_cov : (n_states, n_states)
        n_times
            Number of samples.
        offset : (n_states,) or (n_steps, n_states)
            Zero by default.
        step_index : (n_steps,)
            May be left out where n_distinct is 1 or n_steps.

        Raises
        ------
        ModelError
            A shape does not fit, a number is not finite, a variance is negative or infinite.
        """
        mean = numbers(prior_mean, "prior_mean")
        n, n_steps = mean.size, n_times - 1
        if mean.ndim != 1:
            raise ModelError(f"prior_mean: has shape {mean.shape}, it must be (n_states,)")
        if not isinstance(n_times, int | np.integer) or n_times < 1:
            raise ModelError(f"n_times: the model needs at least one sample, not {n_times}")
        a = _stack(transition, n, "transition")
        model = cls(
            a,
            _stack(process_cov, n, "process_cov"),
            _index(step_index, a.shape[0], n_steps),
            numbers(0.0 if offset is None else offset, "offset", (n_steps, n)),
            np.atleast_2d(numbers(observation, "observation")),
            np.atleast_1d(numbers(noise_variance, "noise_variance", lowest=0.0)),
            mean,
            numbers(prior_cov, "prior_cov"),
        )
        model._check()
        return model

    def observed(self, observations: FloatArray) -> FloatArray:
        """Return observations as contiguous (n_times, n_sensors); ModelError where the shape or an infinity is wrong."""
        try:
            y = np.ascontiguousarray(observations, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ModelError(f"observations: must be numbers, NaN where missing ({error})") from error
        if y.ndim == 1 and self.n_sensors == 1:
            y = y[:, None]
        if y.shape != (self.n_times, self.n_sensors):
            raise ModelError(f"observations have shape {y.shape}, the model needs {(self.n_times, self.n_sensors)}")
        if np.isinf(y).any():
            row, sensor = np.argwhere(np.isinf(y))[0]
            raise ModelError(f"observations: row {row}, sensor {sensor} is infinite; a missing sample is NaN")
        return y

    def _check(self) -> None:
        n = self.n_states
        if self.process_cov.shape != self.transition.shape:
            shapes = f"{self.process_cov.shape} and {self.transition.shape}"
            raise ModelError(f"process_cov and transition differ in shape: {shapes}")
        if self.prior_mean.shape != (n,) or self.prior_cov.shape != (n, n) or self.observation.shape[1:] != (n,):
            raise ModelError(f"prior_cov and observation must have {n} columns, as prior_mean has states")
        if self.noise_variance.shape != (self.n_sensors,):
            raise ModelError(f"noise_variance has {self.noise_variance.size} values for {self.n_sensors} sensors")
        if (np.einsum("dii->di", self.process_cov) < 0.0).any():
            raise ModelError("process_cov: a variance is negative")
        largest = float(np.abs(self.prior_cov).max(initial=0.0))
        if np.abs(self.prior_cov - self.prior_cov.T).max(initial=0.0) > 1e-9 * largest:
            raise ModelError("prior_cov: must be symmetric")
        if np.linalg.eigvalsh(self.prior_cov).min(initial=0.0) < -1e-9 * largest:
            raise ModelError("prior_cov: is no covariance, some combination of states has a negative variance")


def _stack(values: FloatArray, n: int, name: str) -> FloatArray:
    array = numbers(values, name)
    array = array[None] if array.ndim == 2 else array
    if array.ndim != 3 or array.shape[1:] != (n, n) or array.shape[0] == 0:
        raise ModelError(f"{name} has shape {array.shape}; it must be (n_distinct, {n}, {n})")
    return array


def _index(step_index: IntArray | None, n_distinct: int, n_steps: int) -> IntArray:
    if step_index is None:
        if n_distinct not in (1, n_steps):
            raise ModelError(
                f"{n_distinct} distinct matrices for {n_steps} steps: step_index must say which is used when"
            )
        return np.zeros(n_steps, dtype=np.int64) if n_distinct == 1 else np.arange(n_steps, dtype=np.int64)
    index = np.ascontiguousarray(step_index, dtype=np.int64)
    if index.shape != (n_steps,):
        raise ModelError(f"step_index has shape {index.shape}, it must be ({n_steps},)")
    if n_steps and not 0 <= index.min() <= index.max() < n_distinct:
        raise ModelError(f"step_index must lie between 0 and {n_distinct - 1}")
    return index
