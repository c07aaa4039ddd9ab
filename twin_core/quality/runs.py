"""Runs of true values in a mask."""

import numpy as np

from twin_core._typing import BoolArray, IntArray


def runs_of(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Return first index and index after the last of every run of true values, (n_runs,) each."""
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0))
    return edges[::2], edges[1::2]
