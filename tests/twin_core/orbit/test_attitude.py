"""Attitudes against each other: what turns quickly has on average what a body that spins or tumbles has."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from twin_core._typing import FloatArray
from twin_core.constants import EARTH_RADIUS_M
from twin_core.orbit.attitude import FACES, FRAMES, Commanded, Exposure, Held, Spinning, Tumbling
from twin_core.orbit.path import KeplerOrbit
from twin_core.orbit.sky import Sky, sky_at
from twin_core.units import parse_instant_ns

EPOCH_NS = parse_instant_ns("2026-05-05T00:00:00Z")
ORBIT = KeplerOrbit(EARTH_RADIUS_M + 600e3, 0.001, 97.8, 40.0, 0.0, 0.0, EPOCH_NS)


def sky(n_times: int = 40) -> Sky:
    return sky_at(ORBIT, EPOCH_NS, np.linspace(0.0, ORBIT.period_s, n_times, endpoint=False))


def stacked(exposures: "dict[str, Exposure]") -> FloatArray:
    """Return (n_faces, 3, n_times)."""
    return np.array([exposures[face] for face in FACES])


@pytest.mark.parametrize("frame", FRAMES)
def test_axes_of_a_frame_are_orthonormal_and_right_handed(frame: str) -> None:
    axes = FRAMES[frame](sky())
    np.testing.assert_allclose(
        np.einsum("tij,tik->tjk", axes, axes), np.broadcast_to(np.eye(3), axes.shape), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-12)


def test_frames_point_where_they_say() -> None:
    """Orbit: x with the flight, z down. Sun: z to the Sun. Inertial: the frame itself."""
    around = sky()
    orbital = FRAMES["orbit"](around)
    speed = np.linalg.norm(around.velocity_m_per_s, axis=1)
    forward = np.einsum("ti,ti->t", orbital[:, :, 0], around.velocity_m_per_s) / speed
    np.testing.assert_allclose(forward, 1.0, atol=1e-5)
    np.testing.assert_allclose(orbital[:, :, 2], around.down, atol=1e-12)
    np.testing.assert_allclose(FRAMES["sun"](around)[:, :, 2], around.sun, atol=1e-12)
    assert (FRAMES["inertial"](around) == np.eye(3)).all()


def test_a_quaternion_turns_the_body_into_the_frame() -> None:
    """Scalar first: 90 degrees about z take the body's x to the frame's y, so that px looks along +y."""
    half = np.sqrt(0.5)
    axes = Held("inertial", (half, 0.0, 0.0, half)).axes(sky(3))
    np.testing.assert_allclose(axes[:, :, 0], np.broadcast_to([0.0, 1.0, 0.0], (3, 3)), atol=1e-12)
    np.testing.assert_allclose(axes[:, :, 1], np.broadcast_to([-1.0, 0.0, 0.0], (3, 3)), atol=1e-12)


@settings(deadline=None)
@given(st.integers(0, 10**6))
def test_sunlight_on_a_box_is_that_on_its_three_lit_faces(seed: int) -> None:
    """Squares add to one, opposite faces are never lit together; front and back of the Earth's view are one vector."""
    quaternion = Rotation.random(rng=np.random.default_rng(seed)).as_quat()
    around = sky(20)
    seen = stacked(dict(Held("inertial", tuple(np.roll(quaternion, 1))).exposures(around)))
    np.testing.assert_allclose((seen[:, 0] ** 2).sum(axis=0), 1.0, atol=1e-12)
    assert (seen[::2, 0] * seen[1::2, 0] == 0.0).all()
    vector = seen[::2, 1] - seen[1::2, 1]
    np.testing.assert_allclose((vector**2).sum(axis=0), around.distance**-4.0, rtol=1e-9)


def test_a_nadir_pointing_box_sees_the_earth_below() -> None:
    seen = Held("orbit").exposures(around := sky())
    np.testing.assert_allclose(seen["pz"].earth, around.distance**-2.0, rtol=1e-9)
    assert (seen["mz"].earth == 0.0).all() and (seen["mz"].lit == 0.0).all()
    np.testing.assert_allclose(seen["px"].earth, seen["py"].earth, rtol=1e-9)


@pytest.mark.parametrize("frame", ["inertial", "orbit", "sun"])
@pytest.mark.parametrize("about", ["x", "y", "z"])
def test_spinning_is_the_mean_of_a_commanded_turn(frame: str, about: str) -> None:
    """A body turned step by step about its axis, which points where the spinning one's does."""
    direction = np.array([0.3, -0.5, 0.8])
    own = np.eye(3)["xyz".index(about)]
    aim, _ = Rotation.align_vectors(direction[None] / np.linalg.norm(direction), own[None])
    around = sky(12)
    turns = [
        Held(frame, tuple(np.roll((aim * Rotation.from_rotvec(angle * own)).as_quat(), 1)))
        for angle in 2.0 * np.pi * (np.arange(360) + 0.5) / 360
    ]
    mean = np.mean([stacked(dict(turn.exposures(around))) for turn in turns], axis=0)
    spinning = stacked(dict(Spinning(frame, tuple(direction), about).exposures(around)))
    np.testing.assert_allclose(spinning, mean, rtol=3e-3, atol=1e-4)


def test_tumbling_is_the_mean_over_many_orientations() -> None:
    """Sunlight and view of the Earth: over 6 faces of 500 random attitudes, to the noise of such a mean."""
    around = sky(6)
    some = Rotation.random(500, rng=np.random.default_rng(1)).as_quat()
    each = [stacked(dict(Held("inertial", tuple(np.roll(q, 1))).exposures(around)))[:, :2] for q in some]
    mean = np.mean(each, axis=(0, 1))
    tumbling = np.array(Tumbling().exposures(around)["mean"])[:2]
    np.testing.assert_allclose(tumbling, mean, rtol=0.03)


def test_a_commanded_attitude_turns_evenly_and_holds_beyond_its_samples() -> None:
    """From 0 to 90 degrees about z in 60 s: 45 degrees after 30 s, whatever the sign and length of the quaternions."""
    half = np.sqrt(0.5)
    commanded = Commanded(
        "inertial", np.array([0.0, 60.0]), np.array([[1.0, 0.0, 0.0, 0.0], [-2 * half, 0, 0, -2 * half]])
    )
    around = sky_at(ORBIT, EPOCH_NS, np.array([-10.0, 0.0, 30.0, 60.0, 90.0]))
    seen = stacked(dict(commanded.exposures(around)))
    for k, angle in enumerate([0.0, 0.0, np.pi / 4.0, np.pi / 2.0, np.pi / 2.0]):
        held = Held("inertial", (np.cos(angle / 2.0), 0.0, 0.0, np.sin(angle / 2.0)))
        np.testing.assert_allclose(seen[:, :, k], stacked(dict(held.exposures(around)))[:, :, k], atol=1e-12)


def test_a_single_sample_of_attitude_holds() -> None:
    around = sky(5)
    told = Commanded("orbit", np.array([7.0]), np.array([[1.0, 0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(
        stacked(dict(told.exposures(around))), stacked(dict(Held("orbit").exposures(around))), atol=1e-12
    )
