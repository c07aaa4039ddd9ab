"""Integration in time: a stiffly accurate, L-stable Runge-Kutta method of order two with one factorisation for many steps."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix, diags
from scipy.sparse.linalg import splu

from benchmarks.worlds.field import Field

SIGMA_W_PER_M2_K4 = 5.670374419e-8
SPACE_K = 2.7
GAMMA = 1.0 - 1.0 / np.sqrt(2.0)
"""Diagonal of the method (Alexander 1977, SIAM J. Numer. Anal. 14, 1006, s = 2)."""

TOLERANCE_K = 1e-5
"""Stages are iterated until what is left is less; three orders below any sensor's noise."""
SLOW = 8
"""Iterations of a stage after which the matrix is made anew about the present temperatures."""
MOST = 60
MEASURED_EVERY = 16
"""Steps between two looks at how fast the iteration converges."""


@dataclass(frozen=True)
class Drive:
    """What acts on a field: steps of equal length, and the inputs at both stages of each.

    Attributes
    ----------
    start_s, step_s
        Of the first step; their length.
    inputs_W : channel -> (n_steps, 2)
    boundaries_K : boundary -> (n_steps, 2)
    auxiliary : channel -> (n_steps, 2)
    """

    start_s: float
    step_s: float
    inputs_W: Mapping[str, np.ndarray]
    boundaries_K: Mapping[str, np.ndarray]
    auxiliary: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def n_steps(self) -> int:
        """How many steps there are."""
        return next(iter({**self.inputs_W, **self.boundaries_K}.values())).shape[0]

    @property
    def ends_s(self) -> np.ndarray:
        """Beginning of the first step and end of each, (n_steps + 1,)."""
        return self.start_s + self.step_s * np.arange(self.n_steps + 1)

    def begins_s(self, step: int) -> float:
        """Return when a step begins."""
        return self.start_s + self.step_s * step

    @property
    def stages_s(self) -> np.ndarray:
        """Instants of the stages, (n_steps, 2)."""
        return self.ends_s[:-1, None] + self.step_s * np.array([GAMMA, 1.0])


@dataclass(frozen=True)
class Moment:
    """One stage of one step: which, when, what share of the step lies after an onset, what the channels are."""

    step: int
    stage: int
    time_s: float
    on: float
    drive: Drive


Heat = Callable[[Moment, np.ndarray], np.ndarray]
"""(moment, temperatures of all vertices) -> W into every vertex."""


@dataclass(frozen=True)
class Acting:
    """What a hidden effect adds to the balance of a field.

    Attributes
    ----------
    heat
        Heat that follows from temperatures, time and channels.
    stiffness_W_per_K : (n, n)
        A further linear coupling.
    to_boundary_W_per_K
        Its part that leads to a boundary, (n,).
    stored_J, slope_J_per_K
        Heat that every vertex stores beyond its capacity, and its derivative.
    mass_J_per_K
        Capacity of an added state, which follows the vertices; None where there is none.
    after
        Called with time and temperatures after every step.
    onset_s, stop_s
        Between which it acts; a step in part is weighted.
    """

    heat: Heat | None = None
    stiffness_W_per_K: csr_matrix | None = None
    to_boundary_W_per_K: Mapping[str, np.ndarray] = field(default_factory=dict)
    stored_J: Callable[[np.ndarray], np.ndarray] | None = None
    slope_J_per_K: Callable[[np.ndarray], np.ndarray] | None = None
    mass_J_per_K: float | None = None
    after: Callable[[float, np.ndarray], None] | None = None
    onset_s: float = -np.inf
    stop_s: float = np.inf

    def on(self, start_s: float, step_s: float) -> float:
        """Return the share of a step in which the effect acts."""
        begin, end = max(start_s, self.onset_s), min(start_s + step_s, self.stop_s)
        return float(np.clip((end - begin) / step_s, 0.0, 1.0))


NOTHING = Acting()


class Stepper:
    """One field under one drive, with what is hidden in it."""

    def __init__(self, field_: Field, drive: Drive, acting: Acting = NOTHING) -> None:
        self.drive, self.acting, self.n = drive, acting, field_.n
        extra = 0 if acting.mass_J_per_K is None else 1
        self.size = field_.n + extra
        self.capacity = np.concatenate([field_.capacity_J_per_K, np.full(extra, acting.mass_J_per_K or 0.0)])
        self.stiffness = _widened(field_.stiffness_W_per_K, self.size)
        more = acting.stiffness_W_per_K
        self.more = None if more is None else csc_matrix(more)
        area = sum(field_.radiating_m2.values(), np.zeros(field_.n))
        self.faces = np.flatnonzero(area)
        self.area = SIGMA_W_PER_M2_K4 * area[self.faces]
        channels, boundaries = list(field_.inputs), list(drive.boundaries_K)
        none = np.zeros(field_.n)
        self.rows = np.stack([_longer(field_.inputs[c], self.size) for c in channels])
        self.boundary_rows = np.stack(
            [_longer(field_.to_boundary_W_per_K.get(b, none), self.size) for b in boundaries]
        ).reshape(len(boundaries), self.size)
        self.more_rows = np.stack(
            [_longer(acting.to_boundary_W_per_K.get(b, none), self.size) for b in boundaries]
        ).reshape(len(boundaries), self.size)
        self.inputs = np.stack([drive.inputs_W[c] for c in channels], axis=-1)
        self.sinks = np.stack([drive.boundaries_K[b] for b in boundaries], axis=-1)
        self.rate, self.on = 1.0, 0.0
        # What depends on temperature by itself may wake up between two looks at how fast the iteration converges.
        self.least_rate = 1e-6 if acting.heat is None and acting.stored_J is None else 0.05

    def _make(self, about_K: np.ndarray) -> None:
        """Factorise about given temperatures."""
        self.about = about_K
        self.slope = 4.0 * self.area * about_K[self.faces] ** 3
        diagonal = self.capacity / (GAMMA * self.drive.step_s)
        self.extra_slope = None
        if self.acting.slope_J_per_K is not None:
            self.extra_slope = self.acting.slope_J_per_K(about_K) / (GAMMA * self.drive.step_s)
            diagonal = diagonal + self.extra_slope
        diagonal[self.faces] += self.slope
        matrix = self.stiffness + diags(diagonal)
        if self.more is not None and self.on:
            matrix = matrix + self.on * self.more
        self.solve = splu(csc_matrix(matrix), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve

    def _rest(self, moment: Moment, temperatures: np.ndarray) -> np.ndarray:
        """Return what the matrix leaves to iteration, as heat into every state."""
        rest = np.zeros(self.size)
        here = temperatures[self.faces]
        square = here * here
        rest[self.faces] = self.area * (SPACE_K**4 - square * square) + self.slope * here
        if self.acting.heat is not None and moment.on:
            rest[: self.n] += moment.on * self.acting.heat(moment, temperatures[: self.n])
        if self.acting.stored_J is not None:
            rest -= self.acting.stored_J(temperatures) / (GAMMA * self.drive.step_s)
            rest += self.extra_slope * temperatures
        return rest

    def _enthalpy(self, temperatures: np.ndarray) -> np.ndarray:
        own = self.capacity * temperatures
        return own if self.acting.stored_J is None else own + self.acting.stored_J(temperatures)

    def _stage(self, moment: Moment, stored: np.ndarray, guess: np.ndarray) -> np.ndarray:
        """Return the temperatures of a stage whose heat balance begins with ``stored`` joules."""
        sinks = self.sinks[moment.step, moment.stage]
        given = stored / (GAMMA * self.drive.step_s) + self.inputs[moment.step, moment.stage] @ self.rows
        given += sinks @ (
            self.boundary_rows + moment.on * self.more_rows if self.more is not None else self.boundary_rows
        )
        now, before = guess, np.inf
        for iteration in range(MOST):
            new = self.solve(given + self._rest(moment, now))
            change = float(np.abs(new - now).max())
            if np.isfinite(before):
                self.rate = min(max(change / max(before, 1e-300), self.least_rate), 1.0)
            if not np.isfinite(change) or change > 1e3:
                break
            now, before = new, change
            if 2.0 * self.rate * change < TOLERANCE_K or change < 0.1 * TOLERANCE_K:
                return now
            if iteration % SLOW == SLOW - 1:
                self._make(now)
        raise ArithmeticError(f"no solution at {moment.time_s:.0f} s: temperatures changed by {change:.2g} K at last")

    def run(self, start_K: np.ndarray, watch: np.ndarray) -> np.ndarray:
        """Return what ``watch``, (n_watched, n), sees after every step from given temperatures, (n_steps + 1, n_watched)."""
        drive, h = self.drive, self.drive.step_s
        state = _longer(np.asarray(start_K, dtype=float), self.size)
        state[self.n :] = float(start_K.mean())
        watch = np.stack([_longer(row, self.size) for row in watch])
        seen = np.empty((drive.n_steps + 1, watch.shape[0]))
        seen[0] = watch @ state
        self._make(state)
        slope = np.zeros(self.size)
        for k in range(drive.n_steps):
            on = self.acting.on(drive.begins_s(k), h)
            if on != self.on:
                self.on, self.rate = on, 1.0
                self._make(state)
            if k % MEASURED_EVERY == 0:
                self.rate = 1.0
            times = drive.begins_s(k) + h * np.array([GAMMA, 1.0])
            moments = [Moment(k, stage, float(times[stage]), on, drive) for stage in (0, 1)]
            stored = self._enthalpy(state)
            first = self._stage(moments[0], stored, state + GAMMA * h * slope)
            flow = (self._enthalpy(first) - stored) / (GAMMA * h)
            guess = first + (1.0 - GAMMA) / GAMMA * (first - state)
            last = self._stage(moments[1], stored + (1.0 - GAMMA) * h * flow, guess)
            slope, state = (last - first) / ((1.0 - GAMMA) * h), last
            seen[k + 1] = watch @ state
            if self.acting.after is not None:
                self.acting.after(float(times[1]), state[: self.n])
        return seen


def _longer(row: np.ndarray, size: int) -> np.ndarray:
    return np.concatenate([row, np.zeros(size - row.size)])


def _widened(matrix: csr_matrix, size: int) -> csc_matrix:
    entries = matrix.tocoo()
    return csc_matrix((entries.data, (entries.row, entries.col)), shape=(size, size))


def steady(field_: Field, inputs_W: Mapping[str, float], boundaries_K: Mapping[str, float]) -> np.ndarray:
    """Return the temperatures at which constant inputs are balanced, (n,), by Newton's method."""
    given = sum((q * field_.inputs[c] for c, q in inputs_W.items()), np.zeros(field_.n))
    given = given + sum(
        (t * field_.to_boundary_W_per_K[b] for b, t in boundaries_K.items() if b in field_.to_boundary_W_per_K),
        np.zeros(field_.n),
    )
    area = SIGMA_W_PER_M2_K4 * sum(field_.radiating_m2.values(), np.zeros(field_.n))
    now = np.full(field_.n, 290.0)
    for _ in range(50):
        balance = given - field_.stiffness_W_per_K @ now + area * (SPACE_K**4 - now**4)
        step = splu(csc_matrix(field_.stiffness_W_per_K + diags(4.0 * area * now**3))).solve(balance)
        now = now + np.clip(step, -40.0, 40.0)
        if np.abs(step).max() < 1e-6:  # Newton squares it: what a further step would change is rounding
            return now
    raise ArithmeticError("the steady balance does not converge")
