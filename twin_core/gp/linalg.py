"""Compiled dense algebra for the few states of a filter: no temporaries, no library call per step."""

import numpy as np
from numba import njit

from twin_core._typing import FloatArray

SINGULAR = 64.0 * np.finfo(np.float64).eps
"""A Cholesky pivot below this share of its own diagonal element counts as zero."""


@njit(cache=True)
def multiply(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Write a b into ``out``; zeros of ``a`` are skipped, block structure costs nothing."""
    rows, inner, columns = a.shape[0], a.shape[1], b.shape[1]
    for i in range(rows):
        for j in range(columns):
            out[i, j] = 0.0
        for k in range(inner):
            factor = a[i, k]
            if factor != 0.0:
                for j in range(columns):
                    out[i, j] += factor * b[k, j]


@njit(cache=True)
def transpose(a: FloatArray, out: FloatArray) -> None:
    """Write the transpose of ``a`` (no conjugation) into ``out``."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[j, i] = a[i, j]


@njit(cache=True)
def symmetrise(a: FloatArray) -> None:
    """Replace a square matrix by its symmetric part."""
    n = a.shape[0]
    for i in range(n):
        for j in range(i):
            mean = 0.5 * (a[i, j] + a[j, i])
            a[i, j] = mean
            a[j, i] = mean


@njit(cache=True)
def congruence(a: FloatArray, p: FloatArray, work: FloatArray, turned: FloatArray, out: FloatArray) -> None:
    """Write the symmetric a p aᵀ into ``out``; ``work`` and ``turned`` are scratch, ``work`` keeps a p."""
    multiply(a, p, work)
    transpose(a, turned)
    multiply(work, turned, out)
    symmetrise(out)


@njit(cache=True)
def cholesky(matrix: FloatArray, lower: FloatArray) -> None:
    """Write the Cholesky factor of a semidefinite matrix; a null direction gets a zero column."""
    n = matrix.shape[0]
    for j in range(n):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= lower[j, k] * lower[j, k]
        null = not pivot > SINGULAR * n * matrix[j, j]
        root = 0.0 if null else np.sqrt(pivot)
        lower[j, j] = root
        for i in range(j):
            lower[i, j] = 0.0
        for i in range(j + 1, n):
            total = matrix[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = 0.0 if null else total / root


@njit(cache=True)
def solve_cholesky(lower: FloatArray, columns: FloatArray) -> None:
    """Solve L Lᵀ x = columns in place, (n, n_columns); null directions (zero pivots) get a zero."""
    n, n_columns = columns.shape
    for i in range(n):
        for k in range(i):
            factor = lower[i, k]
            if factor != 0.0:
                for c in range(n_columns):
                    columns[i, c] -= factor * columns[k, c]
        inverse = 0.0 if lower[i, i] == 0.0 else 1.0 / lower[i, i]
        for c in range(n_columns):
            columns[i, c] *= inverse
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            factor = lower[k, i]
            if factor != 0.0:
                for c in range(n_columns):
                    columns[i, c] -= factor * columns[k, c]
        inverse = 0.0 if lower[i, i] == 0.0 else 1.0 / lower[i, i]
        for c in range(n_columns):
            columns[i, c] *= inverse


@njit(cache=True)
def alike(a: FloatArray, b: FloatArray, tolerance: float) -> bool:
    """Return whether two covariances agree, each element measured against the variances of its row and column.

    A tolerance that is negative, or no number, is never met.
    """
    n = a.shape[0]
    if not tolerance >= 0.0:
        return False
    for i in range(n):
        for j in range(i + 1):
            change = a[i, j] - b[i, j]
            if change * change > tolerance * tolerance * a[i, i] * a[j, j]:
                return False
    return True
