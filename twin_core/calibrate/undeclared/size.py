"""How large the undeclared heat is: its size on each node and its correlation length, by maximum likelihood."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin_core._typing import FloatArray
from twin_core.calibrate.containment import check_time
from twin_core.calibrate.problem import Problem
from twin_core.calibrate.undeclared.model import Nominal, UndeclaredHeat, log_likelihood

LENGTH_SHARES = (0.004, 0.02, 0.08)
"""Correlation lengths that are compared at first, as shares of the longest segment."""

LONGEST_SHARE = 0.1
"""The correlation length is at most this share of the record, so that lasting heat stays improbable."""

ALL_NODES = -1
"""Stands for the sizes on all nodes, moved by one factor."""

SMALLEST_LOG_STEP, LARGEST_LOG_STEP = 0.1, 2.5


@dataclass
class SizeSearch:
    """A pattern search of the undeclared heat's size, whose steps shrink from pass to pass.

    Attributes
    ----------
    log_step : (n_nodes + 2,)
        Next change to be tried, in ln: of the size on each node, of the correlation length, and of all sizes together.
    """

    log_step: FloatArray

    def positions(self, nodes: Sequence[int] | None) -> tuple[int, ...]:
        """Return what is tried: every node's size and the length, or with ``nodes`` the size of all and of these."""
        return tuple(range(self.log_step.size - 1)) if nodes is None else (ALL_NODES, *nodes)

    def improve(
        self,
        problem: Problem,
        undeclared: UndeclaredHeat,
        nominals: Sequence[Nominal],
        nodes: Sequence[int] | None = None,
    ) -> tuple[UndeclaredHeat, float]:
        """Return a more likely size of the undeclared heat, and its log-likelihood.

        Sizes and correlation length are tried in turn; with ``nodes`` only the sizes on these, and of all together.
        """
        best, value = undeclared, log_likelihood(problem, undeclared, nominals)
        for position in self.positions(nodes):
            check_time()
            moved = False
            for sign in (-1.0, 1.0):
                trial = self._changed(best, position, sign, nominals)
                found = log_likelihood(problem, trial, nominals)
                if found > value:
                    best, value, moved = trial, found, True
                    break
            self.log_step[position] *= 1.4 if moved else 0.5
        self.log_step = np.clip(self.log_step, SMALLEST_LOG_STEP, LARGEST_LOG_STEP)
        return best, value

    def _changed(
        self, undeclared: UndeclaredHeat, position: int, sign: float, nominals: Sequence[Nominal]
    ) -> UndeclaredHeat:
        factor = float(np.exp(sign * self.log_step[position]))
        if position == undeclared.std_W.size:
            shortest = float(np.median(nominals[0].segment.forcing.step_s))
            length = np.clip(undeclared.length_s * factor, shortest, LONGEST_SHARE * span_s(nominals))
            return replace(undeclared, length_s=float(length))
        std = undeclared.std_W.copy()
        std[slice(None) if position == ALL_NODES else position] *= factor
        return replace(undeclared, std_W=std)


def span_s(nominals: Sequence[Nominal]) -> float:
    """Return the length of the longest segment."""
    return max(float(n.segment.record.time_s[-1] - n.segment.record.time_s[0]) for n in nominals)


def new_search(n_nodes: int, log_step: float) -> SizeSearch:
    """Return a search whose first steps are ``log_step``; that of the length is gentler."""
    return SizeSearch(np.append(np.full(n_nodes, log_step), [0.7, log_step]))


def first_size(problem: Problem, nominals: Sequence[Nominal]) -> UndeclaredHeat:
    """Return a starting size: the heat that the linearised model lacks from sample to sample, and the best length."""
    span = span_s(nominals)
    values = problem.network.parameters.values
    capacity = values[problem.network.capacity_index]
    swing = np.array([np.nanstd(n.starts_K, axis=0) for n in nominals]).max(axis=0)
    typical = 0.3 * capacity * np.maximum(swing, 0.1) / (0.02 * span)
    options = [UndeclaredHeat(typical, share * span) for share in LENGTH_SHARES]
    scored = [(fit_common(problem, option, nominals)) for option in options]
    return max(scored, key=lambda item: item[1])[0]


def fit_common(
    problem: Problem, undeclared: UndeclaredHeat, nominals: Sequence[Nominal]
) -> tuple[UndeclaredHeat, float]:
    """Return the best common factor of the undeclared heat, and its likelihood."""
    check_time()
    trials = [replace(undeclared, std_W=undeclared.std_W * f) for f in (10.0, 2.0, 0.4, 0.08, 0.016)]
    return max(((t, log_likelihood(problem, t, nominals)) for t in trials), key=lambda item: item[1])
