"""Which of many hypotheses fall, when each is watched by an e-process and anyone may look at any time.

References
----------
R. Wang, A. Ramdas, False discovery rate control with e-values, J. R. Stat. Soc. B 84 (2022) 822: e-BH.
Y. Tavyrikov, J. J. Goeman, R. de Heide, Carefree multiple testing with e-processes, arXiv 2501.19360: maxima need an adjuster.
"""

import math
from collections.abc import Sequence

import numpy as np

from twin_core._typing import BoolArray

LARGEST_LOG = 600.0
"""Evidence beyond e to this counts no further: it stays a number that can be multiplied."""


def adjusted(log_most: float) -> float:
    """Return an e-value from the greatest value that an e-process has ever had, given as its natural logarithm.

    A maximum is no e-value. A(M) = (M - 1 - log M) / log² M is one, since its integral over M⁻² from 1 is one, and it gives
    away less than any power of M (arXiv 2501.19360; G. Shafer, A. Shen, N. Vereshchagin, V. Vovk, Statist. Sci. 26 (2011)
    84).
    """
    log_most = min(max(log_most, 0.0), LARGEST_LOG)
    if log_most < 1e-4:
        return 0.5 + log_most / 6.0  # the series about M = 1
    return (math.expm1(log_most) - log_most) / log_most**2


def discoveries(e_values: Sequence[float], rate: float) -> BoolArray:
    """Return which hypotheses fall at a false discovery rate, (n,): Benjamini and Hochberg's rule for e-values.

    Whatever the dependence, at most ``rate`` of those named are true nulls, in expectation: the k largest fall where the
    k-th is at least n / (k rate), for the largest such k. Adjusted maxima may be looked at again and again.
    """
    values = np.asarray(e_values, dtype=np.float64)
    order = np.argsort(-values, kind="stable")
    passes = np.flatnonzero(values[order] * (np.arange(values.size) + 1) * rate >= values.size)
    fallen = np.zeros(values.size, dtype=np.bool_)
    fallen[order[: passes[-1] + 1 if passes.size else 0]] = True
    return fallen
