"""Small dense matrices in compiled loops."""

import numpy as np
from numba import njit

from twin_core._typing import FloatArray, IntArray


@njit(cache=True, nogil=True)
def factorise(matrix: FloatArray, pivots: IntArray) -> None:
    """Replace a square matrix by its LU factors with partial pivoting."""
    n = matrix.shape[0]
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(matrix[i, k]) > abs(matrix[best, k]):
                best = i
        pivots[k] = best
        if best != k:
            for j in range(n):
                matrix[k, j], matrix[best, j] = matrix[best, j], matrix[k, j]
        if matrix[k, k] == 0.0:
            matrix[k, k] = np.nan  # singular: what follows is not finite, and says so
        for i in range(k + 1, n):
            if matrix[i, k] != 0.0:
                factor = matrix[i, k] / matrix[k, k]
                matrix[i, k] = factor
                for j in range(k + 1, n):
                    matrix[i, j] -= factor * matrix[k, j]


@njit(cache=True, nogil=True)
def solve_columns(lu: FloatArray, pivots: IntArray, columns: FloatArray) -> None:
    """Solve in place for every column of (n, n_columns)."""
    n, n_columns = columns.shape
    for k in range(n):
        best = pivots[k]
        if best != k:
            for c in range(n_columns):
                columns[k, c], columns[best, c] = columns[best, c], columns[k, c]
    for i in range(n):
        for j in range(i):
            factor = lu[i, j]
            if factor != 0.0:
                for c in range(n_columns):
                    columns[i, c] -= factor * columns[j, c]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            factor = lu[i, j]
            if factor != 0.0:
                for c in range(n_columns):
                    columns[i, c] -= factor * columns[j, c]
        inverse = 1.0 / lu[i, i]
        for c in range(n_columns):
            columns[i, c] *= inverse


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def multiply(matrix: FloatArray, column: FloatArray, out: FloatArray) -> None:
    """Write matrix @ column to ``out``."""
    for i in range(matrix.shape[0]):
        total = 0.0
        for j in range(matrix.shape[1]):
            total += matrix[i, j] * column[j]
        out[i] = total


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def multiply_turned(transposed: FloatArray, column: FloatArray, out: FloatArray) -> None:
    """Write matrix @ column to ``out``, the matrix given by its transpose: sums of rows need no horizontal additions."""
    for i in range(out.size):
        out[i] = transposed[0, i] * column[0]
    for j in range(1, column.size):
        factor = column[j]
        for i in range(out.size):
            out[i] += transposed[j, i] * factor


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def multiply_columns(matrix: FloatArray, columns: FloatArray, out: FloatArray) -> None:
    """Write matrix @ columns to ``out``."""
    out[:] = 0.0
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            factor = matrix[i, j]
            if factor != 0.0:
                for c in range(columns.shape[1]):
                    out[i, c] += factor * columns[j, c]


FEW = 6
"""Rows from which on a product by BLAS is the quicker one: half to 0.8 times as quick at 4, 1.3 to 2.4 times at 6 to 30."""


@njit(cache=True, nogil=True)
def product(matrix: FloatArray, columns: FloatArray, out: FloatArray) -> None:
    """Write matrix @ columns to ``out``, the quicker way; all are contiguous."""
    if columns.shape[0] < FEW:
        multiply_columns(matrix, columns, out)
    else:
        np.dot(matrix, columns, out)
