"""A network along a trajectory, as plain arrays: dT/dt = J(t) T + c(t) + q / C."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.errors import ModelError
from twin_core.gp.kernels import Values

SAME = 1e-12
"""Relative difference below which the Jacobians (or capacities) of all steps count as one (a linear network)."""


@dataclass(frozen=True)
class Linearised:
    """dT/dt = J T + c + q / C between the samples of a record; q is missing heat, positive into the node.

    Build it with :meth:`about` from a nominal trajectory, or directly for a network that is linear. Arrays may be complex
    (a derivative by complex step), except time.

    Attributes
    ----------
    time_s : (n_times,)
        Strictly increasing.
    jacobian_per_s : (1 or n_steps, n_nodes, n_nodes)
        J, constant over a step.
    constant_K_per_s : (n_steps, 2, n_nodes)
        c at the start and at the end of each step, linear in between: inputs that jump at a sample are seen exactly.
    capacity_J_per_K : (1 or n_steps, n_nodes)
        C.
    """

    time_s: FloatArray
    jacobian_per_s: Values
    constant_K_per_s: Values
    capacity_J_per_K: Values

    def __post_init__(self) -> None:
        """Check the shapes; ModelError names the first that does not fit."""
        if np.ndim(self.time_s) != 1 or np.size(self.time_s) < 1:
            raise ModelError("time_s must be (n_times,) with at least one sample")
        n, n_steps = self.n_nodes, np.size(self.time_s) - 1
        for name, rows in (("jacobian_per_s", (n, n)), ("capacity_J_per_K", (n,))):
            shape = getattr(self, name).shape
            if shape not in ((1, *rows), (n_steps, *rows)):
                raise ModelError(f"{name} has shape {shape}; it must be (1 or {n_steps}, {', '.join(map(str, rows))})")
        if self.constant_K_per_s.shape != (n_steps, 2, n):
            raise ModelError(f"constant_K_per_s has shape {self.constant_K_per_s.shape}, not {(n_steps, 2, n)}")
        good = (np.real(self.capacity_J_per_K) > 0) & np.isfinite(self.capacity_J_per_K)
        if not good.all():
            raise ModelError(f"node {int(np.argwhere(~good)[0, 1])}: the capacity must be positive and finite")
        for name in ("jacobian_per_s", "constant_K_per_s"):
            if not np.isfinite(getattr(self, name)).all():
                raise ModelError(f"{name} holds a number that is not finite")

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return int(self.jacobian_per_s.shape[-1])

    @classmethod
    def about(
        cls,
        time_s: FloatArray,
        nominal_K: Values,
        rate_K_per_s: Values,
        jacobian_per_s: Values,
        capacity_J_per_K: Values,
    ) -> Self:
        """Linearise about a trajectory: dT/dt = f + J (T - T_nom) + q / C.

        Parameters
        ----------
        time_s : (n_times,)
        nominal_K : (n_times, n_nodes)
            T_nom; any trajectory near the true one, not necessarily a solution.
        rate_K_per_s : (n_times, n_nodes) or (n_steps, 2, n_nodes)
            f, the declared dT/dt at T_nom; the second form tells start and end of each step apart (held inputs).
        jacobian_per_s : (n_nodes, n_nodes), (n_steps, n_nodes, n_nodes) or (n_steps, 2, n_nodes, n_nodes)
            J; the mean of both ends of a step is used.
        capacity_J_per_K : (n_nodes,) or (n_steps, n_nodes)

        Raises
        ------
        ModelError
            A shape does not fit, or a capacity is not positive.
        """
        times = np.asarray(time_s, dtype=np.float64)
        rate = np.asarray(rate_K_per_s)
        rate = np.stack([rate[:-1], rate[1:]], axis=1) if rate.ndim == 2 else rate
        jacobian = np.asarray(jacobian_per_s)
        jacobian = jacobian.mean(axis=1) if jacobian.ndim == 4 else jacobian
        jacobian = jacobian[None] if jacobian.ndim == 2 else _collapse(jacobian)
        ends = np.stack([nominal_K[:-1], nominal_K[1:]], axis=1)
        if rate.shape != ends.shape or ends.ndim != 3:
            raise ModelError(f"rate_K_per_s has shape {rate.shape}, nominal_K asks for {ends.shape}")
        if jacobian.shape[1:] != 2 * ends.shape[2:] or jacobian.shape[0] not in (1, ends.shape[0]):
            raise ModelError(
                f"jacobian_per_s has shape {jacobian.shape} for {ends.shape[0]} steps of {ends.shape[2]} nodes"
            )
        constant = rate - (ends @ np.swapaxes(jacobian, -1, -2))
        return cls(times, jacobian, constant, _collapse(np.atleast_2d(capacity_J_per_K)))


def _collapse(stack: Values) -> Values:
    """Keep one array where all steps share it: a linear network needs one discretisation per distinct step."""
    if stack.shape[0] < 2:
        return stack
    spread = np.abs(stack - stack[0]).max()
    return stack[:1] if spread <= SAME * np.abs(stack[0]).max() else stack
