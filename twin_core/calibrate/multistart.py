"""The trajectory fit from several starts: until the readings are explained, or two starts agree.

A start whose arithmetic fails, or whose balance has no solution, is one start less. Only where all of them have failed does
the declared model have no solution.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from twin_core._typing import FloatArray, Progress, no_progress
from twin_core.calibrate.approach import CAUTION, approach, misfit_K
from twin_core.calibrate.containment import NO_DEADLINE, attempted, is_late
from twin_core.calibrate.optimise import Optimum
from twin_core.calibrate.problem import Fit, Problem
from twin_core.calibrate.starting import balance_starts
from twin_core.calibrate.suspicions import MANY_NOISES
from twin_core.errors import NoSolutionError
from twin_core.parameters.parameter import GUESS_LOG_STD, NO_GUESS_LOG_STD
from twin_core.parameters.transforms import is_logarithmic
from twin_core.parameters.vector import ParameterSet

MOST_STARTS = 12
"""Starts that are refined at most."""

FEWEST_STARTS = 3
"""Agreement counts from so many on: the best of the first two is often found twice by chance of their common origin."""

EXPLAINED = 1.2
"""Mean squared residual, in units of the noise, below which no other start can explain the readings better."""

AGREEMENT = 0.01
"""Two starts that end at costs this near to each other, as a share, have found the same optimum."""

N_UNGUIDED = 3
"""Starts from heat balances alone where every parameter has a guess and the fit from the guesses leaves many noises."""

UNGUIDED_NATS = 3.0
"""By so much it must be likelier than the fit from the guesses: positive evidence (Kass and Raftery 1995). On 14 splits of
measured sets none gained more than 0.3; from guesses 30 times off and more one gained at least 143. So half and double decide
alike."""

SCATTER_LOG_STD = (1.0, 2.0)
"""Further starts: parameters that nobody guessed scattered by factors e and e²."""


@dataclass(frozen=True)
class Search:
    """What several starts have come to.

    Attributes
    ----------
    best
        The best of them, by the cost of all samples that were searched on.
    tried
        How many were refined.
    failures
        Why the others ended.
    complete
        False where the deadline came first.
    """

    best: Optimum
    tried: int
    failures: tuple[str, ...]
    complete: bool


def start_vectors(problem: Problem) -> Iterator[FloatArray]:
    """Yield unknown vectors to start from: the guesses, then the balances, nearest to the telemetry first, then others."""
    yield problem.start()
    network, states = problem.network, problem.start()[problem.n_free :]
    balanced = [np.concatenate([p.free, states]) for p in balance_starts(problem, always=True)]
    balanced.sort(key=lambda x: _cost(problem, x))
    yield from balanced
    guessed = np.flatnonzero([network.parameters.parameters[i].guessed for i in network.parameters.free_index])
    moved = guessed if guessed.size else problem.logarithmic
    generator = np.random.default_rng(0)
    while moved.size:
        for spread in SCATTER_LOG_STD:
            for centre in balanced[:2]:
                scattered = centre.copy()
                scattered[moved] += generator.normal(0.0, spread, moved.size)
                yield scattered


def _cost(problem: Problem, unknowns: FloatArray) -> float:
    """Return the cost of a start; infinite where it cannot be computed."""
    fit = attempted(partial(problem.solve, unknowns), "start", [])
    return np.inf if fit is None or not np.isfinite(fit.cost) else fit.cost


def mean_square(problem: Problem, fit: Fit) -> float:
    """Return the mean squared residual in units of the noise, all readings together."""
    return float(np.nanmean(np.concatenate(problem.residuals(fit)) ** 2 / problem.noise_K**2))


def best_of_starts(
    problem: Problem,
    *,
    stands_for: float = 1.0,
    deadline: float = NO_DEADLINE,
    progress: Progress = no_progress,
) -> Search:
    """Return the best trajectory fit of several starts.

    Parameters
    ----------
    problem
        What is fitted to what. Where every parameter has a guess, the first start that has a solution is the only one.
    stands_for
        As in :func:`approach`.
    deadline
        On the clock of ``time.monotonic``: no further start is begun afterwards.
    progress
        Called with the share of the starts that are done.

    Raises
    ------
    NoSolutionError
        If every start has failed.
    """
    guided = _is_guided(problem)
    failures: list[str] = []
    found: list[tuple[float, Optimum]] = []
    tried, complete = 0, True
    for start in start_vectors(problem):
        if tried >= MOST_STARTS:
            break
        if found and is_late(deadline):
            complete = False
            break
        tried += 1
        progress(min(1.0, tried / (FEWEST_STARTS + 1)), "fitting trajectories")
        work = partial(approach, problem, start, stands_for=stands_for, deadline=deadline)
        optimum = attempted(work, f"start {tried}", failures)
        if optimum is None:
            continue
        if optimum.status == "no_solution":
            failures.append(f"start {tried}: the heat balance has no solution")
            continue
        if optimum.status == "numerical_failure" and optimum.iterations == 0:
            failures.append(f"start {tried}: the sensitivities cannot be computed")
            continue
        found.append((_cost_of(problem, optimum), optimum))
        found.sort(key=lambda item: item[0])
        if (guided and optimum.status != "numerical_failure") or mean_square(problem, found[0][1].fit) < EXPLAINED:
            break
        if len(found) >= FEWEST_STARTS and found[1][0] - found[0][0] < AGREEMENT * found[0][0]:
            break
    if not found:
        raise NoSolutionError(no_solution_words(failures))
    best = found[0][1]
    if guided and not is_late(deadline):
        best = _unless_likelier_unguided(problem, best, stands_for, deadline)
    return Search(replace(best, iterations=sum(o.iterations for _, o in found)), tried, tuple(failures), complete)


def _is_guided(problem: Problem) -> bool:
    """Return whether every free parameter has a guess."""
    return not any(p.guessed and not p.frozen for p in problem.network.parameters.parameters)


def _unless_likelier_unguided(problem: Problem, guided: Optimum, stands_for: float, deadline: float) -> Optimum:
    """Return a fit from the guesses, or the best of those from heat balances alone where the guesses were no guesses of this.

    The misfit counts as noise, so that far from the telemetry the priors of wrong guesses hold the search where it began. A fit
    that nobody guided is followed where the readings, weighed by its misfit, gain more by it than the guesses lose.
    """
    if mean_square(problem, guided.fit) <= MANY_NOISES**2:
        return guided
    unguided = problem.with_network(problem.network.with_parameters(unguessed(problem.network.parameters)))
    states, best = problem.start()[problem.n_free :], guided
    for balanced in balance_starts(unguided, always=True)[:N_UNGUIDED]:
        about = unguided.with_network(problem.network.with_parameters(balanced))
        start = np.concatenate([balanced.free, states])
        work = partial(approach, about, start, stands_for=stands_for, deadline=deadline)
        found = attempted(work, "a start without guesses", [])
        if found is None or found.status in ("no_solution", "numerical_failure"):
            continue
        misfit = misfit_K(problem, found.fit)
        weighed = replace(problem, noise_K=np.hypot(problem.noise_K, CAUTION * misfit) / np.sqrt(stands_for))
        gained = weighed.solve(best.unknowns, best.fit).cost - weighed.solve(found.unknowns, found.fit).cost
        if gained > UNGUIDED_NATS:
            best = found
    return best


def unguessed(parameters: ParameterSet) -> ParameterSet:
    """Return parameters as if nobody had guessed the free ones; a stated spread, and bounds, are kept."""
    return replace(
        parameters,
        parameters=tuple(
            replace(p, guessed=True, prior_std=NO_GUESS_LOG_STD)
            if not p.frozen and p.prior_std == GUESS_LOG_STD and is_logarithmic(p.transform)
            else p
            for p in parameters.parameters
        ),
    )


def _cost_of(problem: Problem, optimum: Optimum) -> float:
    return problem.solve(optimum.unknowns, optimum.fit).cost


def no_solution_words(failures: list[str]) -> str:
    """Return one line: that every start failed, why, and what to do."""
    reasons = "; ".join(dict.fromkeys(f.split(": ", 1)[1] for f in failures[:MOST_STARTS]))
    return (
        f"calibration failed from all {len(failures)} starting points ({reasons}): check the units of loads, the areas of"
        " radiators and the known values, give every node a way to lose heat, and guess one capacity or conductance"
    )
