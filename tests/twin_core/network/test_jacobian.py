"""The Jacobian as what stays and what moves, against the dense sum written down."""

import numpy as np
import pytest

from twin_core.network.jacobian import JacobianSum
from twin_core.network.terms import Heat


@pytest.mark.parametrize("n_points", [0, 1, 7])
def test_the_parts_add_up_to_the_dense_sum(n_points: int) -> None:
    rng = np.random.default_rng(n_points)
    fixed, local = rng.normal(size=(1, 3, 3)), rng.normal(size=(n_points, 2, 2))
    slope = np.ones((n_points, 3))
    slope[:, 1] = rng.uniform(0.1, 2.0, n_points)
    own = np.array([2.0, 3.0, 5.0])
    total = JacobianSum(3)
    total.add(Heat((0, 1, 2), np.zeros((n_points, 3)), fixed), np.ones((n_points, 3)))
    total.add(Heat((2, 0), np.zeros((n_points, 2)), local), np.ones((n_points, 3)))
    found = total.over(own, n_points).with_columns_scaled([1], slope)
    expected = np.repeat(fixed, n_points, axis=0)
    for point in range(n_points):
        expected[point][np.ix_([2, 0], [2, 0])] += local[point]
        expected[point] = expected[point] / own[:, None] * slope[point]
    np.testing.assert_allclose(found.dense(), expected, rtol=1e-12, atol=1e-14)
