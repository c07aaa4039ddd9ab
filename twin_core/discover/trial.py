"""Trials: a model with some effects, refitted in full, in the presence of undeclared heat and along open-loop trajectories."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.calibrate.containment import attempted, those_that_work
from twin_core.calibrate.discrepancy import Discrepancy, discrepancy
from twin_core.calibrate.gradients import WithGradients, with_gradients
from twin_core.calibrate.optimise import Optimum, minimise
from twin_core.calibrate.problem import Problem
from twin_core.calibrate.second_order import Calibration, from_heat_fit, sampling_step_s
from twin_core.calibrate.undeclared.fit import SETTLED_NATS, fit_with_undeclared_heat, loss_at_start
from twin_core.calibrate.undeclared.model import HeatFit, linearise, log_likelihood
from twin_core.calibrate.undeclared.size import first_size
from twin_core.discover import policy
from twin_core.discover.left_out import blocked_errors, forward_error
from twin_core.effects.base import Effect
from twin_core.network.model import build_network
from twin_core.once import once

LN_2, LN_3 = np.log([2.0, 3.0]).tolist()

START_LOSS_NATS = 30.0
"""Loss of likelihood at the start of a fit above which a second one starts from less of the effect; the fit that ends likelier
counts. A limit of time, not of belief: of 214 fits from both starts, the second ended likelier in one of 163 with a loss below
30 nats, in ten of 39 with one of 30 to 1000 nats, in ten of 12 beyond."""

SHORTER_SHARES = (0.3, 0.1, 0.03, 0.01, 0.003, 0.001)
"""Shares of an effect's amplitude for the second start: the first that loses nothing, or the last. Screening takes an amplitude
to which the other parameters give way; where a fit starts they have not yet."""

FAR_MORE = 4.0
"""Gradients within nodes are fitted where no more would stay beside them than so many times what a coarse network may leave, a
misfit of four noises; a limit of time: a quarter of what they explain would be theirs, and heat that wanders describes such
readings better."""

MOST_ROUNDS = 8
"""So often a fit is taken up again until it has converged, a limit of time: declared records took two rounds at most."""


@dataclass(frozen=True)
class Trial:
    """A model with some effects, fitted in the presence of undeclared heat, and what speaks for it.

    Attributes
    ----------
    effects
        At their fitted values.
    fit
        Parameters, undeclared heat and likelihood.
    max_step_s
        Longest time step.
    near
        Open-loop optima of the same problem found otherwise.
    simpler
        The trial that this one extends: its open-loop optimum is a start too, so that a richer model never fits worse.
    below
        A simpler trial whose fit beside gradients is a start of this one's.
    """

    effects: tuple[Effect, ...]
    fit: HeatFit
    max_step_s: float
    near: tuple[Optimum, ...] = ()
    simpler: "Trial | None" = None
    below: "Trial | None" = None

    @once
    def calibration(self) -> Calibration:
        """The same model calibrated on open-loop trajectories."""
        starts = []
        if self.simpler is not None:
            values = self.fit.network.parameters.as_dict()
            simpler = self.simpler.calibration()
            starts.append(carried_over(simpler.problem, simpler.optimum.unknowns, self.fit.problem, values))
        return from_heat_fit(self.fit, self.max_step_s, near=self.near, starts=starts)

    @property
    def present_effects(self) -> tuple[Effect, ...]:
        """The effects at the values of the open-loop calibration."""
        return fitted_effects(self.effects, self.calibration().network.parameters.as_dict())

    @once
    def block_errors(self) -> FloatArray:
        """Sum of squared weighted errors on each block predicted from the others, by two fits, (2, n_blocks)."""
        return blocked_errors(self.calibration())

    @once
    def forward_error(self) -> FloatArray:
        """Mean square of errors on training readings that a refit has not seen, in units of the noise, by two refits, (2,)."""
        return forward_error(self.calibration())

    @once
    def misfit_share(self) -> float:
        """Misfit over noise, rms over sensors: how much the open-loop model leaves beyond the sensors' own noise."""
        models, noise = self.calibration().whitener.models, self.calibration().problem.noise_K
        return float(np.sqrt(np.mean([(m.sigma_ou / n) ** 2 for m, n in zip(models, noise, strict=True)])))

    @once
    def beside_gradients(self) -> WithGradients | None:
        """Trajectories fitted beside temperature gradients within the nodes, which no lumped network describes.

        None where trajectories leave no more than chance, so that gradients have nothing to explain, where far more would
        stay beside them than any coarse network leaves, and where their arithmetic fails.
        """
        return self._with_gradients(FAR_MORE * policy.MOST_COARSENESS)

    @once
    def beside_any_gradients(self) -> WithGradients | None:
        """The same, however much stays beside them: what is missing is looked for there."""
        return self.beside_gradients() or self._with_gradients(np.inf)

    def _with_gradients(self, most_left: float) -> WithGradients | None:
        calibration = self.calibration()
        if self.excess().mean() <= by_chance(self.n_samples):
            return None
        problem, optimum, near = calibration.problem, calibration.optimum, None
        below = None if self.below is None else self.below.beside_gradients()
        if below is not None:
            own = problem.network.parameters.at_free(optimum.unknowns[: problem.n_free]).as_dict()
            near = carried_over(below.problem, below.optimum.unknowns, problem, own)
        return attempted(partial(with_gradients, problem, optimum, near, most_left), "gradients within nodes", [])

    def discrepancy(self) -> Discrepancy | None:
        """What parameters are wrong by because the network is coarse; None where trajectories leave no more than chance.

        Raises
        ------
        ArithmeticError
            Where it cannot be told.
        """
        gradients = self.beside_any_gradients()
        if gradients is None:
            return None
        left = float(np.mean(self._excess(gradients.residuals)))
        return discrepancy(self.calibration(), gradients, max(0.0, 1.0 - left / mean_excess(self)))

    @once
    def along_trajectories(self) -> float:
        """ln of what the readings say where no undeclared heat acts: a misfit wanders at the sensors, beside gradients or not."""
        gradients = self.beside_gradients()
        beside = -np.inf if gradients is None else gradients.log_posterior
        return float(np.logaddexp(self.calibration().log_posterior, beside)) - LN_2

    @once
    def log_evidence(self) -> float:
        """ln of what the readings say for the model, its priors included, in nats.

        What no parameter follows is heat that wanders at the nodes, a misfit that wanders at the sensors, or such a misfit beside
        gradients within the nodes, because a lumped network is coarser than what it describes. Nobody knows beforehand: the mean
        over all three counts, in which the likeliest one leads (Hoeting et al. 1999, Bayesian model averaging).
        """
        return float(np.logaddexp(self.fit.log_posterior, self.along_trajectories() + LN_2)) - LN_3

    @property
    def least_evidence(self) -> float:
        """What :attr:`log_evidence` is at least, from wandering heat alone: open-loop trajectories need not be computed."""
        return self.fit.log_posterior - LN_3

    @once
    def excess(self) -> FloatArray:
        """Variance of each sensor's open-loop residuals beyond its own noise, in units of that noise, (n_sensors,).

        Noise is what one sample does not tell of the next; more than ``LARGEST_NOISE`` of what calibration took for it is misfit.
        """
        return self._excess(self.calibration().residuals)

    def _excess(self, residuals: Sequence[FloatArray]) -> FloatArray:
        calibration = self.calibration()
        interval_s = sampling_step_s([segment.record for segment in calibration.problem.segments])
        own = np.array([model.unforeseen(interval_s) for model in calibration.whitener.models])
        noise = np.maximum(np.minimum(own, policy.LARGEST_NOISE * calibration.problem.noise_K), 1e-300)
        square = np.nanmean((np.concatenate(residuals) / noise) ** 2, axis=0)
        return np.maximum(np.nan_to_num(square) - 1.0, 0.0)

    @once
    def share_of_gradients(self) -> float:
        """Share of what gradients within the nodes explain that is theirs: none where the readings are less likely beside them.

        They are what a coarse network leaves. Where far more stays beside them, a finer network would not have followed the
        readings either: most of what they explain something else may explain as well.
        """
        gradients = self.beside_gradients()
        if gradients is None or gradients.log_posterior <= self.calibration().log_posterior:
            return 0.0
        return min(1.0, policy.MOST_COARSENESS / max(float(np.mean(self._excess(gradients.residuals))), 1e-300))

    def left_beside(self, share: float) -> float:
        """Return the mean of :attr:`excess` over sensors, less a share of what gradients within the nodes explain of it."""
        left = mean_excess(self)
        gradients = self.beside_gradients() if share > 0.0 else None
        if gradients is None:
            return left
        return (1.0 - share) * left + share * float(np.mean(self._excess(gradients.residuals)))

    @once
    def unexplained(self) -> float:
        """The mean of :attr:`excess` over sensors, less what gradients within the nodes explain of it."""
        return self.left_beside(self.share_of_gradients())

    @property
    def n_samples(self) -> int:
        """Number of readings that took part."""
        return int(sum(n.segment.valid.sum() for n in self.fit.nominals))


def carried_over(simpler: Problem, at: FloatArray, problem: Problem, effect_values: Mapping[str, float]) -> FloatArray:
    """Return the unknowns of a richer problem where a simpler one of the same telemetry is, effects at given values.

    Parameters
    ----------
    simpler, at
        The simpler problem, and its unknowns.
    problem
        The richer problem.
    effect_values
        Full parameter name -> value, for what the simpler one lacks.
    """
    parameters = problem.network.parameters.updated(effect_values)
    before = dict(zip(simpler.network.parameters.free_names, at, strict=False))
    unknowns = problem.start()
    unknowns[: problem.n_free] = [
        before.get(name, own) for name, own in zip(parameters.free_names, parameters.free, strict=True)
    ]
    like = {extra.name: extra.like for extra in problem.network.extra}
    nodes = simpler.network.nodes
    source = [nodes.index(n if n in nodes else like[n]) for n in problem.network.nodes]
    for i in range(len(problem.segments)):
        unknowns[problem.start_columns(i)] = at[simpler.start_columns(i)][source]
    return unknowns


def by_chance(n_readings: int) -> float:
    """Return the variance, in units of the sensors' noise, up to which what stays of so many readings is chance."""
    return policy.VISIBLE_COARSENESS * float(np.sqrt(2.0 / n_readings))


def mean_excess(trial: Trial) -> float:
    """Return the variance of open-loop residuals beyond the sensors' noise, in units of that noise, mean over sensors."""
    return float(np.mean(trial.excess()))


def explained(simple: Trial, rich: Trial, found: Trial | None = None) -> float:
    """Return how much of what a simpler trial leaves a richer one explains, in units of the sensors' noise, mean over sensors.

    Gradients within the nodes explain the same share of both: that of the richer one, or of another trial that was found. They
    are credited with no more in the simpler one than they explain in the richer one, or any coarse network leaves: where they
    explain more, they stand in for what the richer one names.
    """
    share = (found or rich).share_of_gradients()
    left = rich.left_beside(share)
    credited = max(policy.MOST_COARSENESS, mean_excess(rich) - left)
    return max(simple.left_beside(share), mean_excess(simple) - credited) - left


def shared_unknowns(rich: Problem, problem: Problem) -> IntArray:
    """Return where a richer problem has each unknown of a simpler one of the same telemetry, (n_unknowns,)."""
    names = rich.network.parameters.free_names
    own = [names.index(name) for name in problem.network.parameters.free_names]
    source = [rich.network.nodes.index(node) for node in problem.network.nodes]
    starts = [np.arange(rich.n_unknowns)[rich.start_columns(i)][source] for i in range(len(problem.segments))]
    return np.concatenate([np.array(own, dtype=np.int64), *starts])


def fitted_effects(effects: Sequence[Effect], values: dict[str, float]) -> tuple[Effect, ...]:
    """Return effects at the values of a fitted network."""
    return tuple(effect.at_parameters(values) for effect in effects)


def try_effects(base: Trial, effects: Sequence[Effect], *, n_passes: int = 3) -> Trial:
    """Return the trial of a set of effects, fitted with all parameters from a trial close by.

    Parameters
    ----------
    base
        Where to start from: the same telemetry, with or without some of the effects.
    effects
        All effects of the new trial, at their starting values.
    n_passes
        Passes of the fit at most: few to rank, many to settle.
    """
    problem = extended(base.fit.problem, effects)
    names = base.fit.problem.network.parameters.free_names
    before = dict(zip(names, base.fit.free, strict=True))
    own = {p.name for effect in effects for p in effect.parameters()}

    def start(of: Problem) -> FloatArray:
        free = zip(of.network.parameters.free_names, of.network.parameters.free, strict=True)
        return np.array([value if name in own else before.get(name, value) for name, value in free])

    starts = [start(problem)]
    if loss_at_start(problem, starts[0], base.fit) > START_LOSS_NATS:
        there = {effect.place for effect in base.effects}
        for share in SHORTER_SHARES:
            less = [e if e.place in there else e.shortened(share) for e in effects]
            shorter = start(extended(base.fit.problem, less))
            if loss_at_start(problem, shorter, base.fit) <= 0.0:
                break
        starts.append(shorter)
    fitted = partial(fit_with_undeclared_heat, problem, near=base.fit, n_passes=n_passes)
    fits = those_that_work([partial(fitted, start) for start in starts])
    fit = max(fits, key=lambda f: f.log_posterior)
    return Trial(
        fitted_effects(effects, fit.network.parameters.as_dict()), fit, base.max_step_s, simpler=base, below=base
    )


def try_on_trajectories(
    base: Trial, effects: Sequence[Effect], *starts: Calibration, beside_heat: bool = False, goal: float = np.inf
) -> Trial | None:
    """Return the trial of a set of effects fitted on open-loop trajectories, started from the simpler one's optimum.

    Or from other ``starts`` of the simpler problem; with ``beside_heat`` from its fit beside undeclared heat too, and
    the best one counts: where much is missing, parameters that are to follow long trajectories alone lie far from where the
    effect belongs. Where the balance has no solution there, what is new starts smaller; None where it has none even so. The
    undeclared heat is sized about the result, for a later look. Fits that would not come to the cost of ``goal`` are given up.
    """
    problem = extended(base.fit.problem, effects)
    along = [(start.problem, start.optimum.unknowns) for start in starts or (base.calibration(),)]
    along += [(base.fit.problem, base.fit.unknowns())] if beside_heat else []
    there = {effect.place for effect in base.effects}
    for share in (1.0, *SHORTER_SHARES):
        some = [e if share == 1.0 or e.place in there else e.shortened(share) for e in effects]
        own = {p.name: p.value for effect in some for p in effect.parameters()}
        optima = [minimise(problem, carried_over(*simpler, problem, own), goal=goal) for simpler in along]
        optimum = min(optima, key=lambda o: np.inf if o.status == "no_solution" else o.fit.cost)
        if optimum.status != "no_solution":
            break
    else:
        return None
    fit = about_trajectory(problem, optimum)
    values = fit.network.parameters.as_dict()
    return Trial(fitted_effects(effects, values), fit, base.max_step_s, (optimum,), below=base)


def bare(simple: Trial, found: Calibration) -> Calibration:
    """Return the model without a finding at the parameters that it has with it: all that is missing there is what was found.

    Fitted without it, parameters make up for it as well as they can, and far from there nothing answers linearly.

    Raises
    ------
    ArithmeticError
        Where it has no solution there.
    """
    problem = simple.fit.problem
    unknowns = found.optimum.unknowns[shared_unknowns(found.problem, problem)]
    fit = problem.solve(unknowns)
    if not np.isfinite(fit.cost):
        raise ArithmeticError("the heat balance has no solution there")
    return replace(found, problem=problem, optimum=replace(found.optimum, unknowns=unknowns, fit=fit))


def resettled(simple: Trial, rich: Trial) -> Trial:
    """Return a trial that was fitted on trajectories with its parameters fitted in the presence of undeclared heat too.

    Started from its own optimum, about the measured temperatures and about its own trajectory (where the simpler model's
    undeclared heat has taken over a node that nobody reads, only the latter is near), and from the simpler trial's fit: the
    likeliest one counts.
    """
    calibration = rich.calibration()
    free = calibration.optimum.unknowns[: calibration.problem.n_free]
    own: Callable[[], HeatFit] = partial(
        fit_with_undeclared_heat, calibration.problem, free, early_prior_std=(np.inf,) * 3
    )
    along: Callable[[], HeatFit] = partial(fit_with_undeclared_heat, calibration.problem, free, near=rich.fit)
    fits: list[HeatFit] = those_that_work([own, along, partial(_fit_near, simple, rich)])
    return _settled_at(simple, rich, max(fits, key=lambda f: f.log_posterior))


def resettled_near(simple: Trial, rich: Trial) -> Trial:
    """Return the same from the simpler trial's fit alone, which takes a quarter of the time and is mostly as likely."""
    return _settled_at(simple, rich, _fit_near(simple, rich))


def _fit_near(simple: Trial, rich: Trial) -> HeatFit:
    return try_effects(simple, rich.present_effects, n_passes=15).fit


def _settled_at(simple: Trial, rich: Trial, fit: HeatFit) -> Trial:
    effects = fitted_effects(rich.effects, fit.network.parameters.as_dict())
    return replace(rich, effects=effects, fit=fit, near=(rich.calibration().optimum,), simpler=None, below=simple)


def converged(trial: Trial) -> Trial:
    """Return a trial whose fit in the presence of undeclared heat takes passes until its likelihood no longer grows.

    A few passes rank candidates, but leave the size of the undeclared heat and its correlation length on their way: whatever
    is added then, of no size even, seems to gain what the next passes add anyhow.
    """
    fit = trial.fit
    for _ in range(MOST_ROUNDS):
        before, fit = fit, fit_with_undeclared_heat(fit.problem, fit.free, near=fit)
        if fit.log_posterior - before.log_posterior < SETTLED_NATS:
            break
    if fit.log_posterior - trial.fit.log_posterior < SETTLED_NATS:
        return trial
    effects = fitted_effects(trial.effects, fit.network.parameters.as_dict())
    return replace(trial, effects=effects, fit=fit, near=(trial.calibration().optimum,), simpler=None)


def about_trajectory(problem: Problem, optimum: Optimum, along: Calibration | None = None) -> HeatFit:
    """Return a problem linearised about its open-loop optimum, or about the trajectories of a richer calibration, ``along``."""
    free = optimum.unknowns[: problem.n_free]
    values = problem.network.parameters.to_values(free)
    followed, nodes = optimum.fit.trajectories, problem.network.nodes
    own = list(range(problem.n_nodes))
    if along is not None:
        followed = along.optimum.fit.trajectories
        own = [along.problem.network.nodes.index(node) for node in nodes]
    nominals = tuple(
        linearise(
            problem,
            values,
            segment,
            np.concatenate([path.start_K[None], path.stages_K[:, 1]])[:, own],
            np.zeros((segment.forcing.n_steps, problem.n_nodes)),
        )
        for segment, path in zip(problem.segments, followed, strict=True)
    )
    undeclared = first_size(problem, values, nominals)
    return HeatFit(problem, free, undeclared, nominals, log_likelihood(problem, undeclared, nominals))


def extended(declared: Problem, effects: Sequence[Effect]) -> Problem:
    """Return the problem of the declared network with effects; its priors are those of the declaration."""
    before = declared.network
    network = build_network(before.spec, effects, table_knots=before.layout.table_knots)
    own = {p.name for effect in effects for p in effect.parameters()}
    kept = {p.name: p.value for p in before.parameters.parameters if p.name not in own}
    return declared.with_network(network.with_parameters(network.parameters.updated(kept)))
