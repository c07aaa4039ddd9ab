"""The calibration of paper A (Sosta et al., arXiv 2605.28452): a graph neural ODE fitted by Adam. The only use of torch.

The heat balance is linear in z = [T, sigma T^4, x], where x holds boundary temperatures, their fourth powers and inputs:
dT/dt = M(theta) z with M = diag(gamma) sum_k p_k E_k (paper A, section 3.1, eq. 1 and section 2.3). Windows of all
segments advance together as one disconnected graph (eq. 3), in time counted in samples.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torchdiffeq import odeint, odeint_adjoint

from twin_core._typing import FloatArray, Progress, no_progress
from twin_core.calibrate.optimise import Optimum, Status
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.calibrate.residual_noise import fit_whitener
from twin_core.calibrate.second_order import Calibration, prepare, sampling_step_s
from twin_core.calibrate.windows import Windows, balance_of, cut_windows
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4 as SIGMA
from twin_core.errors import ModelError
from twin_core.network.spec import TwinSpec
from twin_core.parameters.parameter import Parameter
from twin_core.parameters.transforms import LogInterval
from twin_core.telemetry import Record

LIMIT_K = 200.0
"""v of the limiter (eq. 4): it leaves 200 to 400 K alone."""

AT_THE_END = 0.02
"""A parameter this near to an end of what Psi reaches, as a share of it, may lie beyond: there Psi hardly moves."""

SCALE_OF_GUESS = 4.0
"""s_p over the guess where no bound is declared; a parameter without a guess gets s_p from its starting value alike."""


@dataclass(frozen=True)
class Recipe:
    """How the paper trains (sections 4.1 and 5.3).

    Attributes
    ----------
    window_s
        T_b, the length of a training window.
    learning_rate
        Of Adam, fixed.
    max_iterations, patience
        Epochs at most, and epochs without a lower validation loss after which training stops.
    validation_share
        Share of each segment's windows, the last ones, that is kept for validation.
    gradients
        ``adjoint``: the adjoint equations, solved backwards; ``direct``: through the unrolled solver.
    solver
        A method of torchdiffeq; those of fixed step take one step per sample.
    """

    window_s: float = 2000.0
    learning_rate: float = 1e-2
    max_iterations: int = 2000
    patience: int = 200
    validation_share: float = 0.25
    gradients: Literal["adjoint", "direct"] = "direct"
    solver: str = "rk4"


def recipe_of(changes: Mapping[str, float]) -> Recipe:
    """Return the paper's recipe with some numbers changed.

    Raises
    ------
    ModelError
        If one is unknown, not positive, or no whole number where only those make sense.
    """
    known = ("learning_rate", "window_s", "max_iterations", "patience")
    for name, value in changes.items():
        if name not in known:
            raise ModelError(f"unknown setting '{name}' of method 'neural-ode' (known: {', '.join(known)})")
        if not 0.0 < value < float("inf"):
            raise ModelError(f"{name}: must be a positive number (got {value:g})")
        if name in known[2:] and value != int(value):
            raise ModelError(f"{name}: must be a whole number (got {value:g})")
    whole = {name: int(value) if name in known[2:] else float(value) for name, value in changes.items()}
    return replace(Recipe(), **whole)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Training:
    """What a training run leaves.

    Attributes
    ----------
    values : (n_parameters,)
        Physical values where the validation loss was lowest.
    train_K2, validation_K2 : (n_iterations,)
        Mean squared errors of every epoch.
    status
        Why it stopped.
    notices
        Parameters that ended at the end of what Psi reaches.
    """

    values: FloatArray
    train_K2: FloatArray
    validation_K2: FloatArray
    status: Status
    notices: tuple[str, ...] = ()


def embed(free: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """Return Psi(p~) = s_p / 2 (tanh(2 p~) + 1), strictly between 0 and s_p (section 4.2)."""
    return 0.5 * scale * (torch.tanh(2.0 * free) + 1.0)


def unembed(value: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """Return p~ of a value between 0 and s_p; one on a bound is moved just inside."""
    return 0.5 * torch.atanh((2.0 * value / scale - 1.0).clamp(-1.0 + 1e-9, 1.0 - 1e-9))


def limit(temperature_K: torch.Tensor, v: float = LIMIT_K) -> torch.Tensor:
    """Return temperatures bent smoothly into 0 to 3 v; the identity between v and 2 v (eq. 4)."""
    scaled = temperature_K / v
    low, high = v * torch.tanh(scaled - 1.0) + v, v * torch.tanh(scaled - 2.0) + 2.0 * v
    return torch.where(scaled < 1.0, low, torch.where(scaled > 2.0, high, temperature_K))


class Embedding:
    """The free parameters as p = p_min + Psi(p~); a capacity enters as gamma = 1/C (section 3.1)."""

    def __init__(self, problem: Problem) -> None:
        self._parameters = problem.network.parameters
        self._index = torch.as_tensor(self._parameters.free_index)
        inverse = np.isin(self._parameters.free_index, problem.network.capacity_index)
        chosen = [self._parameters.parameters[i] for i in self._parameters.free_index]
        ranges = [_range(p, bool(inv)) for p, inv in zip(chosen, inverse, strict=True)]
        self.lower, upper = torch.tensor(ranges, dtype=torch.float64).reshape(-1, 2).T
        self.scale, self._inverse = upper - self.lower, torch.as_tensor(inverse)
        start = torch.tensor([p.value for p in chosen], dtype=torch.float64)
        entered = torch.where(self._inverse, 1.0 / start, start)
        for parameter, value, low, high in zip(
            chosen, entered.tolist(), self.lower.tolist(), upper.tolist(), strict=True
        ):
            if not low < value < high:
                raise ModelError(
                    f"{parameter.name}: the guess {parameter.value:g} is not inside its bounds, between which method"
                    " 'neural-ode' searches; move the guess or the bounds"
                )
        self.start = unembed(entered - self.lower, self.scale)
        self._chosen = chosen

    def values(self, free: torch.Tensor) -> torch.Tensor:
        """Return all physical values, (n_parameters,), of p~ (n_free,)."""
        value = self.lower + embed(free, self.scale)
        value = torch.where(self._inverse, 1.0 / value, value)
        return torch.as_tensor(self._parameters.values).index_put((self._index,), value)

    def beyond(self, free: torch.Tensor) -> tuple[str, ...]:
        """Return a notice for every parameter that ended where Psi ends, which p~ (n_free,) tells."""
        shares = (embed(free, self.scale) / self.scale).tolist()
        found = []
        for parameter, share, low, scale, inverse in zip(
            self._chosen, shares, self.lower.tolist(), self.scale.tolist(), self._inverse.tolist(), strict=True
        ):
            if AT_THE_END <= share <= 1.0 - AT_THE_END:
                continue
            ends = (low, low + scale)
            if inverse:
                ends = (1.0 / ends[1], 1.0 / ends[0] if ends[0] > 0.0 else float("inf"))
            found.append(
                f"{parameter.name}: ended at the end of what method 'neural-ode' reaches, {ends[0]:.3g} to {ends[1]:.3g}"
                f" {parameter.unit}; the truth may lie beyond: give a nearer guess, or wider bounds"
            )
        return tuple(found)


def _range(parameter: Parameter, inverse: bool) -> tuple[float, float]:
    """Return p_min and p_min + s_p of one parameter, of its inverse for a capacity."""
    if not isinstance(parameter.transform, LogInterval):
        return 0.0, SCALE_OF_GUESS * (1.0 / parameter.value if inverse else parameter.value)
    lower, upper = parameter.transform.lower, parameter.transform.upper
    return (1.0 / upper, 1.0 / lower) if inverse else (lower, upper)


class Field(torch.nn.Module):
    """dT/dtau of all windows, (n_windows, n_nodes), with tau counted in samples (eq. 3)."""

    def __init__(self, windows: Windows) -> None:
        super().__init__()
        self.matrix = torch.zeros(0)
        self._given, self._rise = torch.as_tensor(windows.given), torch.as_tensor(windows.rise)
        self._step_s = torch.as_tensor(windows.step_s)[:, :, None]
        self._held = not windows.rise.any()

    def at(self, matrix: torch.Tensor) -> "Field":
        """Return the field itself, now with the matrix M(theta), (n_nodes, n_columns)."""
        self.matrix = matrix
        return self

    def forward(self, tau: torch.Tensor, temperature_K: torch.Tensor) -> torch.Tensor:
        """Return the rates; an input that is held keeps its sample's value up to the next sample."""
        at = float(tau.detach())
        k = min(int(at), self._given.shape[0] - 1)
        given = self._given[k] if self._held else torch.add(self._given[k], self._rise[k], alpha=at - k)
        square = temperature_K * temperature_K
        balance = torch.cat([temperature_K, SIGMA * square * square, given], dim=1) @ self.matrix.T
        return self._step_s[k] * balance


def roll(field: Field, start_K: torch.Tensor, n_steps: int, recipe: Recipe, *, limited: bool) -> torch.Tensor:
    """Return the trajectories of all windows, (n_steps + 1, n_windows, n_nodes).

    ``limited`` bends the temperatures after every step (section 4.3). Where a rollout stays between 200 and 400 K that is
    the identity, so that the whole of it is integrated in one call.
    """
    tau = torch.arange(n_steps + 1, dtype=torch.float64)
    if not limited:
        return _integrate(field, start_K, tau, recipe)
    states = [start_K]
    for k in range(n_steps):
        states.append(limit(_integrate(field, states[-1], tau[k : k + 2], recipe)[-1]))
    return torch.stack(states)


def _integrate(field: Field, start_K: torch.Tensor, tau: torch.Tensor, recipe: Recipe) -> torch.Tensor:
    fixed = recipe.solver in ("euler", "midpoint", "rk4")
    options = {"perturb": True} if fixed else {}
    kind = {"method": recipe.solver, "options": options}
    if recipe.gradients == "direct":
        return odeint(field, start_K, tau, **kind)
    return odeint_adjoint(field, start_K, tau, adjoint_params=(field.matrix,), adjoint_options=options, **kind)


def inside(path: torch.Tensor) -> bool:
    """Return whether the limiter leaves a rollout alone."""
    low, high = torch.aminmax(path.detach())
    return bool(low >= LIMIT_K) and bool(high <= 2.0 * LIMIT_K)


class Trainer:
    """One training: the windows, the embedding and the losses of the trajectory-matching problem (eq. 2)."""

    def __init__(self, problem: Problem, recipe: Recipe) -> None:
        self.recipe, self.embedding = recipe, Embedding(problem)
        balance = balance_of(problem)
        self.windows = cut_windows(problem, balance, recipe.window_s, recipe.validation_share)
        self.field = Field(self.windows)
        self._design = torch.as_tensor(balance.design)
        self._capacity = torch.as_tensor(problem.network.capacity_index)
        self._measured = torch.as_tensor(np.nan_to_num(self.windows.measured_K))
        self._counts = torch.as_tensor(np.isfinite(self.windows.measured_K))
        self._validation = torch.as_tensor(self.windows.validation)[None, :, None]
        self._node = torch.as_tensor(problem.network.sensor_node)

    def matrix(self, free: torch.Tensor) -> torch.Tensor:
        """Return M(theta), (n_nodes, n_columns)."""
        values = self.embedding.values(free)
        return torch.tensordot(values, self._design, dims=1) / values[self._capacity][:, None]

    def losses(self, free: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the mean squared errors in K^2 of the training windows, limited, and of validation, not limited."""
        field, start = self.field.at(self.matrix(free)), torch.as_tensor(self.windows.start_K)
        n_steps = self.windows.n_steps
        path = roll(field, start, n_steps, self.recipe, limited=False)
        validation = self._mean_square(path.detach(), self._counts & self._validation)
        if not inside(path):
            path = roll(field, start, n_steps, self.recipe, limited=True)
        return self._mean_square(path, self._counts & ~self._validation), validation

    def _mean_square(self, path: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
        error = torch.where(counted, path[:, :, self._node] - self._measured, 0.0)
        return (error * error).sum() / counted.sum().clamp(min=1)

    def train(self, progress: Progress = no_progress) -> Training:
        """Run Adam until the validation loss has not fallen for the patience window, or to the last iteration."""
        recipe = self.recipe
        free = self.embedding.start.clone().requires_grad_(True)
        adam = torch.optim.Adam([free], lr=recipe.learning_rate)
        history: list[tuple[float, float]] = []
        best, best_at, lowest = free.detach().clone(), 0, np.inf
        status: Status = "iteration_limit"
        for iteration in range(recipe.max_iterations):
            adam.zero_grad()
            train, validation = self.losses(free)
            history.append((float(train.detach()), float(validation)))
            judged = history[-1][1] if bool(self._validation.any()) else history[-1][0]
            if judged < lowest:
                best, best_at, lowest = free.detach().clone(), iteration, judged
            elif iteration - best_at >= recipe.patience:
                status = "early_stopping"
                break
            train.backward()  # type: ignore[no-untyped-call]
            adam.step()
            if iteration % 10 == 0:
                progress(iteration / recipe.max_iterations, f"epoch {iteration}, rms {history[-1][0] ** 0.5:.3g} K")
        train_K2, validation_K2 = np.array(history).reshape(-1, 2).T
        notices = self.embedding.beyond(best)
        return Training(self.embedding.values(best).numpy(), train_K2, validation_K2, status, notices)


def fit_neural_ode(
    spec: TwinSpec, records: Sequence[Record], recipe: Recipe | None = None, *, progress: Progress = no_progress
) -> tuple[Training, Calibration]:
    """Calibrate a declared network by the paper's method.

    Parameters
    ----------
    spec, records
        As in :func:`twin_core.calibrate.second_order.prepare`.
    recipe
        How to train; the paper's by default.
    progress
        Called with the fraction done.

    Returns
    -------
    Training, Calibration
        The training, and its open-loop trajectories from the first readings, without limiter (section 5.3).

    Raises
    ------
    TelemetryError
        If the telemetry cannot be used.
    ModelError
        If the network has what the method does not know: nodes without a sensor, unknown boundaries, tables.
    """
    problem, step_s = prepare(spec, records)
    coarse = build_problem(problem.network, records, problem.noise_K, 1.5 * sampling_step_s(records))
    training = Trainer(coarse, recipe or Recipe()).train(lambda f, m: progress(0.95 * f, m))
    parameters = problem.network.parameters.at_values(training.values)
    unknowns = np.concatenate([parameters.free, *(s.start_prior_K for s in problem.segments)])
    fit = problem.solve(unknowns)
    if not np.isfinite(fit.cost):
        raise ModelError("the trained network has no open-loop trajectory; check the order of magnitude of the guesses")
    optimum = Optimum(unknowns, fit, np.eye(unknowns.size), training.status, training.train_K2.size)
    return training, Calibration(problem, optimum, fit_whitener(problem, problem.residuals(fit)), step_s)
