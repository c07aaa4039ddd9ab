"""The weak forms of heat conduction, as in the textbook, and quadrature of traces."""

from typing import Any

import numpy as np
from scipy.sparse import csr_array
from skfem import Basis, BilinearForm, FacetBasis, LinearForm
from skfem.helpers import dot, grad

from twin_core._typing import FloatArray


@BilinearForm
def conduction(u: Any, v: Any, w: Any) -> Any:
    """Integral of grad u . grad v; times the conductivity it is the conduction matrix."""
    return dot(grad(u), grad(v))


@BilinearForm
def mass(u: Any, v: Any, w: Any) -> Any:
    """Integral of u v; times the volumetric heat capacity it is the capacity matrix."""
    return u * v


@LinearForm
def unit_source(v: Any, w: Any) -> Any:
    """Integral of v: a source or flux of one."""
    return 1.0 * v


def trace(basis: Basis | FacetBasis) -> tuple[csr_array, FloatArray]:
    """Return values at quadrature points as a matrix (n_points, n_unknowns), and the quadrature weights (n_points,)."""
    n_elements, n_points = basis.dx.shape
    rows = np.arange(n_elements * n_points)
    matrix = csr_array((rows.size, basis.N))
    for i, dofs in enumerate(basis.element_dofs):
        values = np.broadcast_to(np.asarray(basis.basis[i][0]), basis.dx.shape).ravel()
        columns = np.repeat(dofs, n_points)
        matrix = matrix + csr_array((values, (rows, columns)), shape=matrix.shape)
    return matrix, basis.dx.ravel()
