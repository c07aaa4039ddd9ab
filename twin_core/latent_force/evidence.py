"""Polynomial degrees weighed by evidence: small ridge regressions over one white least-squares problem per misfit."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.special import logsumexp

from twin_core._typing import FloatArray, IntArray
from twin_core.gp.basis import Basis
from twin_core.gp.columns import WhiteRegression

NO_MISFIT = 0.5
"""Probability a priori that the heat is a polynomial and nothing else; the other misfits share the rest."""
EXHAUSTIVE = 300
"""Combinations of degrees up to which all are tried."""


@dataclass(frozen=True)
class Choice:
    """Posterior of the weights for one combination of degrees; ``kept`` are their columns."""

    kept: IntArray
    mean: FloatArray
    cov: FloatArray
    log_evidence: float
    misfit_W: FloatArray


@dataclass(frozen=True)
class Problem:
    """The white regression over all terms of all forces.

    ``owner`` and ``order`` (n_columns,) tell each column's force and total degree; ``scale_W`` its prior deviation.
    """

    white: WhiteRegression
    owner: IntArray
    order: IntArray
    scale_W: FloatArray
    gram: FloatArray
    moment: FloatArray

    @classmethod
    def of(cls, white: WhiteRegression, bases: list[Basis], prior_std_W: FloatArray) -> "Problem":
        """Form the normal equations once, in units of the prior."""
        owner = np.concatenate([np.full(len(b.exponents), k) for k, b in enumerate(bases)])
        order = np.array([sum(e) for b in bases for e in b.exponents], dtype=np.int64)
        columns = white.columns * prior_std_W[owner]
        return cls(white, owner, order, prior_std_W[owner], columns.T @ columns, columns.T @ white.target)

    def solve(self, degrees: tuple[int, ...]) -> Choice:
        """Ridge regression on the terms up to each force's degree, with its exact evidence."""
        kept = np.flatnonzero(self.order <= np.asarray(degrees)[self.owner])
        lower = np.linalg.cholesky(self.gram[np.ix_(kept, kept)] + np.eye(kept.size))
        inverse = np.linalg.inv(lower)
        right = inverse @ self.moment[kept]
        log_evidence = self.white.log_likelihood + 0.5 * float(right @ right) - float(np.log(np.diag(lower)).sum())
        scale = self.scale_W[kept]
        cov = (inverse.T @ inverse) * np.outer(scale, scale)
        return Choice(kept, scale * (inverse.T @ right), cov, log_evidence, np.zeros(0))


@dataclass(frozen=True)
class Family:
    """One problem per misfit; what is learned is their average.

    ``misfits_W`` is (n_problems, n_forces).
    """

    problems: tuple[Problem, ...]
    misfits_W: FloatArray

    def log_evidence(self, degrees: tuple[int, ...]) -> float:
        """Return ln p(y | degrees), averaged over the misfits."""
        return float(logsumexp([p.solve(degrees).log_evidence for p in self.problems] + self._log_prior))

    @property
    def _log_prior(self) -> FloatArray:
        others = len(self.problems) - 1
        return np.log([1.0] if others == 0 else [NO_MISFIT, *[(1.0 - NO_MISFIT) / others] * others])

    def choose(self, degrees: range) -> tuple[int, ...]:
        """Return the combination of degrees of the highest evidence."""
        n_forces = self.misfits_W.shape[1]
        if len(degrees) ** n_forces <= EXHAUSTIVE:
            return max(product(degrees, repeat=n_forces), key=self.log_evidence)
        best = max(((d,) * n_forces for d in degrees), key=self.log_evidence)
        value, improved = self.log_evidence(best), True
        while improved:
            improved = False
            for k, d in product(range(n_forces), degrees):
                other = (*best[:k], d, *best[k + 1 :])
                if self.log_evidence(other) > value + 1e-9:
                    best, value, improved = other, self.log_evidence(other), True
        return best

    def solve(self, degrees: tuple[int, ...]) -> Choice:
        """Return mean and covariance of the weights under the mixture over misfits."""
        each = [problem.solve(degrees) for problem in self.problems]
        evidence = np.array([choice.log_evidence for choice in each]) + self._log_prior
        total = float(logsumexp(evidence))
        shares = np.exp(evidence - total)
        means = np.array([choice.mean for choice in each])
        mean = shares @ means
        away = means - mean
        cov = np.tensordot(shares, [choice.cov for choice in each], 1) + (away.T * shares) @ away
        misfit = np.sqrt(shares @ self.misfits_W**2)
        return Choice(each[0].kept, mean, cov, total, misfit)
