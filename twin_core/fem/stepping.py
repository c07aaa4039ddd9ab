"""Time schemes: a second-order one with a single frozen factorisation, and the paper's IMEX."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import SuperLU, splu

from twin_core._typing import FloatArray
from twin_core.errors import ModelError
from twin_core.fem.field import Field

GAMMA = 1.0 - 1.0 / np.sqrt(2.0)
"""Diagonal of the L-stable two-stage SDIRK method of order two (Alexander 1977, SIAM J. Numer. Anal. 14, eq. 1.9)."""

_RESIDUAL = 1e-10
"""A stage is solved when its unbalanced heat is this part of all heat that moves: the energy balance of a step."""

_ROUNDING_K = 1e-6
"""Changes that stay below this without solving the stage are rounding, as in a very stiff conductor."""

_PATIENCE = 12

_MOST_ITERATIONS = 25

ExtraHeat = Callable[[float, FloatArray, FloatArray, int], FloatArray]
"""(time_s, temperature_K, rate_K_per_s, stage) -> further heat into every unknown, (n_unknowns, n_cases)."""


@dataclass(frozen=True)
class Drive:
    """What drives one step: values at the scheme's stages.

    Attributes
    ----------
    inputs_W : (n_stages, n_inputs, n_cases)
    boundary_K : (n_stages, n_boundaries, n_cases)
    extra
        Hidden heat, None where there is none.
    """

    inputs_W: FloatArray
    boundary_K: FloatArray
    extra: ExtraHeat | None = None


class Scheme(Protocol):
    """A time scheme on one field with one step size."""

    stage_fractions: tuple[float, ...]
    """When in a step the inputs are asked for."""
    input_weights: tuple[float, ...] | None
    """How the stages' inputs add to a step's; None where the printed scheme knows one instant only."""

    def step(self, time_s: float, temperature_K: FloatArray, drive: Drive) -> FloatArray:
        """Return the temperatures one step later, (n_unknowns, n_cases)."""

    @property
    def heat_in_J(self) -> FloatArray:
        """Heat that the last step let into the field, (n_cases,), for the energy balance."""

    @property
    def heat_moved_J(self) -> FloatArray:
        """Heat that came and went in the last step, all counted positive, (n_cases,)."""


class Sdirk2:
    """Two implicit stages per step, radiation and all, solved with one factorisation for the whole run.

    Each stage solves M (T - base) / (gamma dt) = heat(T) by iterating with the frozen matrix
    A = M / (gamma dt) + K + 4 sigma eps T_ref^3, so that a step costs a few back-substitutions.
    """

    stage_fractions = (float(GAMMA), 1.0)
    input_weights: tuple[float, ...] | None = (float(1.0 - GAMMA), float(GAMMA))

    def __init__(self, field: Field, step_s: float, reference_K: FloatArray) -> None:
        self.field, self.step_s = field, step_s
        self._inertia = csr_array(field.capacity_matrix / (GAMMA * step_s))
        self._linear = csr_array(self._inertia + field.conductance_matrix)
        self._solver = _factorise(csc_array(self._linear + field.radiation.slope_W_per_K(reference_K)))
        self._rate: FloatArray | None = None
        self._stage_heat: list[FloatArray] = []
        self._heat_moved_J = np.zeros(1)

    def step(self, time_s: float, temperature_K: FloatArray, drive: Drive) -> FloatArray:
        """Return the temperatures one step later, (n_unknowns, n_cases)."""
        long, short = GAMMA * self.step_s, (1.0 - GAMMA) * self.step_s
        start_rate = self._rate if self._rate is not None else np.zeros_like(temperature_K)
        first = self._stage(time_s, 0, temperature_K, start_rate, drive)
        rate = (first - temperature_K) / long
        base = temperature_K + short * rate
        second = self._stage(time_s, 1, base, rate, drive)
        self._rate = (second - base) / long
        return second

    def _stage(
        self, start_s: float, stage: int, base_K: FloatArray, rate_K_per_s: FloatArray, drive: Drive
    ) -> FloatArray:
        """Solve one stage by quasi-Newton iteration with the frozen factors, from an extrapolated guess."""
        field = self.field
        given = field.inputs @ drive.inputs_W[stage] + field.boundary_inputs @ drive.boundary_K[stage]
        fixed = given + self._inertia @ base_K
        temperature_K = base_K + GAMMA * self.step_s * rate_K_per_s
        steps: list[FloatArray] = []
        for _ in range(_MOST_ITERATIONS):
            bent = self._bent_heat(start_s, stage, temperature_K, base_K, drive)
            residual_W = fixed + bent - self._linear @ temperature_K
            moved_W = np.abs(given).sum(axis=0) + np.abs(bent).sum(axis=0)
            if (np.abs(residual_W).sum(axis=0) <= _RESIDUAL * moved_W).all() or _at_rounding(steps):
                heat_W = given + bent - field.conductance_matrix @ temperature_K
                self._stage_heat = [*self._stage_heat[:stage], heat_W.sum(axis=0)]
                self._heat_moved_J = self.step_s * moved_W
                return temperature_K
            _extend(steps, self._solver.solve(residual_W))
            temperature_K = temperature_K + steps[-1]
        raise ModelError(f"the step at {start_s:g} s did not converge; use a smaller step_s")

    def _bent_heat(
        self, start_s: float, stage: int, temperature_K: FloatArray, base_K: FloatArray, drive: Drive
    ) -> FloatArray:
        """Return the heat that is not linear in temperature: radiation and hidden effects."""
        heat = self.field.radiation.heat_W(temperature_K, drive.boundary_K[stage])
        if drive.extra is not None:
            rate = (temperature_K - base_K) / (GAMMA * self.step_s)
            heat = heat + drive.extra(start_s + self.stage_fractions[stage] * self.step_s, temperature_K, rate, stage)
        return heat

    @property
    def heat_in_J(self) -> FloatArray:
        """Heat that the last step let into the field, (n_cases,)."""
        first, second = self._stage_heat
        return self.step_s * ((1.0 - GAMMA) * first + GAMMA * second)

    @property
    def heat_moved_J(self) -> FloatArray:
        """Heat that came and went in the last step, (n_cases,), by its end."""
        return self._heat_moved_J


def _at_rounding(steps: list[FloatArray]) -> bool:
    """Return whether many steps have been taken and the last is so small that it is rounding."""
    return len(steps) >= _PATIENCE and float(np.abs(steps[-1]).max()) < _ROUNDING_K


def _extend(steps: list[FloatArray], change_K: FloatArray) -> None:
    """Append the next step of Broyden's method, each case for itself.

    ``change_K`` is what the frozen factors alone would do; earlier steps correct them along the directions seen, which
    is what a strong hidden heat in one region needs (Kelley, Iterative Methods for Linear and Nonlinear Equations,
    1995, algorithm brsol, section 7.3).
    """
    for before, after in itertools.pairwise(steps):
        change_K = change_K + after * _along(before, change_K)
    if steps:
        change_K = change_K / np.maximum(1.0 - _along(steps[-1], change_K), 0.1)
    steps.append(change_K)


def _along(step_K: FloatArray, change_K: FloatArray) -> FloatArray:
    """Return the part of a change along a step, (n_cases,); 0 where the step is nothing."""
    square = np.einsum("nc,nc->c", step_K, step_K)
    return np.einsum("nc,nc->c", step_K, change_K) / np.where(square > 0.0, square, 1.0)


class Imex:
    """The paper's scheme: first order, radiation as sigma eps T_old^3 T, a new factorisation every step.

    The weak form of section 5.1 of "LPTM calibration" (arXiv 2605.28452) carries a minus before the radiative
    term on the left-hand side, which would heat the boundary; with outward heat counted as in its equation (13)
    the term must be added there, and so it is here. The sink is kept (the paper sets it to 0 K).
    """

    stage_fractions = (1.0,)
    input_weights: tuple[float, ...] | None = None

    def __init__(self, field: Field, step_s: float, reference_K: FloatArray) -> None:
        self.field, self.step_s = field, step_s
        self._inertia = csc_array(field.capacity_matrix / step_s)
        self._heat_in_J, self._heat_moved_J = np.zeros(1), np.zeros(1)

    def step(self, time_s: float, temperature_K: FloatArray, drive: Drive) -> FloatArray:
        """Return the temperatures one step later, (n_unknowns, n_cases)."""
        field, radiation = self.field, self.field.radiation
        given = field.inputs @ drive.inputs_W[0] + field.boundary_inputs @ drive.boundary_K[0]
        given = given + radiation.heat_W(np.zeros_like(temperature_K), drive.boundary_K[0])
        if drive.extra is not None:
            given = given + drive.extra(time_s + self.step_s, temperature_K, np.zeros_like(temperature_K), 0)
        after = np.empty_like(temperature_K)
        outflow = np.empty_like(temperature_K)
        for case in range(temperature_K.shape[1]):
            slope = radiation.slope_W_per_K(temperature_K[:, case]) / 4.0
            matrix = csc_array(self._inertia + field.conductance_matrix + slope)
            right = given[:, case] + self._inertia @ temperature_K[:, case]
            after[:, case] = _factorise(matrix).solve(right)
            outflow[:, case] = field.conductance_matrix @ after[:, case] + slope @ after[:, case]
        self._heat_in_J = self.step_s * (given - outflow).sum(axis=0)
        self._heat_moved_J = self.step_s * (np.abs(given).sum(axis=0) + np.abs(outflow).sum(axis=0))
        return after

    @property
    def heat_in_J(self) -> FloatArray:
        """Heat that the last step let into the field, (n_cases,)."""
        return self._heat_in_J

    @property
    def heat_moved_J(self) -> FloatArray:
        """Heat that came and went in the last step, (n_cases,)."""
        return self._heat_moved_J


SCHEMES: dict[str, type[Sdirk2] | type[Imex]] = {"sdirk2": Sdirk2, "imex": Imex}
"""Time schemes by the name that a scenario gives."""


def _factorise(matrix: csc_array) -> SuperLU:
    """Return the LU factors of a symmetric matrix, ordered for few fill-ins."""
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0)
