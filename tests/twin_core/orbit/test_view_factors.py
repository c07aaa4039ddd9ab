"""View factors against sums over directions, against averages of each other, and against the conservation of energy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from twin_core.orbit.view_factors import (
    illumination,
    mean_positive,
    plate_view_factor,
    spinning_view_factor,
    tumbling_view_factor,
)

DISTANCES = st.floats(1.02, 50.0)
COSINES = st.floats(-1.0, 1.0)


def one(value: float) -> np.ndarray:
    return np.array([value])


def integrated_view_factor(distance: float, angle: float) -> float:
    """Return the view factor by summing cosine over the directions that meet the sphere."""
    horizon = np.arcsin(1.0 / distance)
    edges_t, edges_p = np.linspace(0.0, horizon, 801), np.linspace(0.0, 2.0 * np.pi, 801)
    t, p = ((e[:-1] + e[1:]) / 2.0 for e in (edges_t, edges_p))
    polar, azimuth = np.meshgrid(t, p, indexing="ij")
    cosine = np.cos(angle) * np.cos(polar) + np.sin(angle) * np.sin(polar) * np.cos(azimuth)
    solid = np.sin(polar) * (edges_t[1] - edges_t[0]) * (edges_p[1] - edges_p[0])
    return float(np.sum(np.maximum(cosine, 0.0) * solid) / np.pi)


@pytest.mark.parametrize("distance", [1.05, 1.2, 3.0])
@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 75.0, 90.0, 110.0, 150.0, 180.0])
def test_plate_equals_the_sum_over_directions(distance: float, angle_deg: float) -> None:
    """Closed form against the sum, whole, partial and no view."""
    closed = plate_view_factor(one(distance), one(np.cos(np.radians(angle_deg))))[0]
    assert closed == pytest.approx(integrated_view_factor(distance, np.radians(angle_deg)), abs=2e-5)


@settings(deadline=None)
@given(DISTANCES, COSINES)
def test_both_sides_of_a_plate_part_what_falls_on_it(distance: float, cosine: float) -> None:
    """Front minus back is the vector of the whole sphere, cos / H^2: the cosine and its negative are one integral."""
    front, back = plate_view_factor(one(distance), one(cosine)), plate_view_factor(one(distance), one(-cosine))
    np.testing.assert_allclose(front - back, cosine / distance**2, atol=1e-12)
    assert 0.0 <= back[0] <= 1.0 and 0.0 <= front[0] <= 1.0


@settings(deadline=None)
@given(DISTANCES)
def test_tumbling_is_the_mean_over_all_tilts(distance: float) -> None:
    """Every cosine of the tilt is equally likely over the sphere of orientations; kinks are integrated piece by piece."""
    kink = 1.0 / distance
    mean = sum(
        quad(lambda c: float(plate_view_factor(one(distance), one(c))[0]), a, b, epsabs=1e-11)[0]
        for a, b in ((-kink, kink), (kink, 1.0))
    )
    assert tumbling_view_factor(one(distance))[0] == pytest.approx(0.5 * mean, rel=1e-6)


@settings(deadline=None)
@given(DISTANCES, COSINES)
def test_spinning_is_the_mean_over_a_turn(distance: float, cosine: float) -> None:
    """The plate's normal goes round the axis: its cosine to the nadir is that of the phase times the sine of the axis."""
    phase = (np.arange(4000) + 0.5) * np.pi / 4000
    around = np.sqrt(1.0 - cosine**2) * np.cos(phase)
    mean = plate_view_factor(np.full(phase.size, distance), around).mean()
    assert spinning_view_factor(one(distance), one(cosine))[0] == pytest.approx(mean, rel=2e-3, abs=2e-5)


@settings(deadline=None)
@given(st.floats(-5.0, 5.0), st.floats(0.0, 5.0))
def test_half_rectified_cosine(level: float, swing: float) -> None:
    angle = (np.arange(20_000) + 0.5) * np.pi / 20_000
    mean = np.maximum(0.0, level + swing * np.cos(angle)).mean()
    assert mean_positive(one(level), one(swing))[0] == pytest.approx(mean, abs=1e-6)


@settings(deadline=None)
@given(st.floats(1.02, 7.0), st.booleans())
def test_all_the_light_that_the_earth_reflects_passes(distance: float, by_cosine: bool) -> None:
    """Over the whole sphere around the Earth the mean illumination is 1/4: a disc catches what a sphere gives back.

    By cosine this is the conservation of energy; by solid angle it holds as every ground point is seen from everywhere.
    """
    height = np.polynomial.legendre.leggauss(60)
    mean = 0.5 * illumination(np.full(60, distance), height[0], by_cosine=by_cosine) @ height[1]
    assert mean == pytest.approx(0.25, rel=1e-3)


@pytest.mark.parametrize("distance", [1.05, 1.3, 6.6])
@pytest.mark.parametrize("height", [1.0, 0.6, 0.1, -0.1, -0.5, -1.0])
@pytest.mark.parametrize("by_cosine", [True, False])
def test_illumination_equals_the_sum_over_the_ground(distance: float, height: float, by_cosine: bool) -> None:
    """Every visible patch of a unit sphere, weighed by the solid angle that it fills from the spacecraft."""
    x = 1.0 / distance + (1.0 - 1.0 / distance) * (np.arange(600) + 0.5) / 600
    turn = (np.arange(600) + 0.5) * 2.0 * np.pi / 600
    ground = np.stack(np.broadcast_arrays(np.sqrt(1 - x**2)[:, None] * np.cos(turn), 0.0 * turn, x[:, None]), axis=-1)
    ground[..., 1] = np.sqrt(1 - x**2)[:, None] * np.sin(turn)
    ray = np.array([0.0, 0.0, distance]) - ground
    away = np.linalg.norm(ray, axis=-1)
    weight = np.einsum("xti,xti->xt", ray, ground) / away**3
    if by_cosine:
        weight = weight * ray[..., 2] / away
    lit = np.maximum(0.0, ground @ np.array([np.sqrt(1.0 - height**2), 0.0, height]))
    assert illumination(one(distance), one(height), by_cosine=by_cosine)[0] == pytest.approx(
        float((weight * lit).sum() / weight.sum()), abs=1e-3
    )
