"""Quaternions against SciPy's rotations."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from twin_core.orbit.quaternions import interpolated, matrices


@settings(deadline=None)
@given(st.integers(0, 10**6))
def test_matrices_and_turns_are_scipys(seed: int) -> None:
    """Random attitudes of random sign and length; also a turn by nearly nothing and one by nearly half a circle."""
    rng = np.random.default_rng(seed)
    told = Rotation.random(6, rng=rng)
    told = Rotation.concatenate([told, told[-1:] * Rotation.from_rotvec([1e-10, 0, 0]), told[-1:]])
    told = Rotation.concatenate([told, told[-1:] * Rotation.from_rotvec([0, 0, 3.14])])
    scalar_first = np.roll(told.as_quat(), 1, axis=1) * rng.uniform(0.1, 9.0, (9, 1)) * rng.choice([-1.0, 1.0], (9, 1))
    np.testing.assert_allclose(matrices(scalar_first), told.as_matrix(), atol=1e-12)
    sample_s = np.cumsum(rng.uniform(1.0, 100.0, 9))
    time_s = rng.uniform(sample_s[0], sample_s[-1], 50)
    found = matrices(interpolated(time_s, sample_s, scalar_first))
    np.testing.assert_allclose(found, Slerp(sample_s, told)(time_s).as_matrix(), atol=1e-7)


def test_attitude_rests_beyond_its_samples() -> None:
    told = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0]])
    np.testing.assert_allclose(
        interpolated(np.array([-5.0, 0.0, 10.0, 99.0]), np.array([0.0, 10.0]), told),
        [told[0], told[0], told[1] / 2.0, told[1] / 2.0],
        atol=1e-15,
    )
    np.testing.assert_array_equal(interpolated(np.zeros(3), np.array([7.0]), told[:1]), np.repeat(told[:1], 3, axis=0))
