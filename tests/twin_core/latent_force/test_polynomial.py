"""The polynomial heat: recovery, its band, its range, its form as an effect."""

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from twin_core.errors import ModelError
from twin_core.latent_force.polynomial import Basis, ForcePolynomial, regress_pointwise

T = np.linspace(290.0, 330.0, 41)


def _heat(t):
    return 5.0 - 0.4 * (t - 300.0) + 0.002 * (t - 300.0) ** 3


def test_weights_are_least_squares():
    found = regress_pointwise(T, _heat(T), np.full(41, 0.1), degree=3)
    np.testing.assert_allclose(found.predict(T).mean_W, _heat(T), atol=1e-9)
    basis = found.basis.terms(T)
    np.testing.assert_allclose(found.cov_W2, 0.01 * np.linalg.inv(basis.T @ basis), rtol=1e-9, atol=1e-15)


def test_prior_pulls_towards_zero():
    """Equations 37-38 with a finite prior, written out."""
    found = regress_pointwise(T, _heat(T), np.full(41, 2.0), degree=2, prior_std_W=3.0)
    phi = found.basis.terms(T)
    precision = np.eye(3) / 9.0 + phi.T @ phi / 4.0
    np.testing.assert_allclose(found.mean_W, np.linalg.solve(precision, phi.T @ _heat(T) / 4.0), rtol=1e-9)


def test_outside_the_range_the_mean_is_held_and_the_band_grows():
    found = regress_pointwise(T, _heat(T), np.full(41, 0.1), degree=3)
    inside, outside = found.predict(T), found.predict(np.array([330.0, 331.0, 335.0, 350.0, 280.0]))
    assert not inside.outside.any()
    np.testing.assert_array_equal(outside.outside, [False, True, True, True, True])
    np.testing.assert_allclose(outside.mean_W[:4], _heat(330.0), rtol=1e-6)
    assert (np.diff(outside.std_W[:4]) > 0).all()
    # The band takes in what the polynomial itself would have said.
    assert (np.abs(outside.mean_W - _heat(np.array([330.0, 331.0, 335.0, 350.0, 280.0]))) <= outside.std_W).all()


def test_boundary_is_a_second_variable():
    rng = np.random.default_rng(0)
    boundary = rng.uniform(270.0, 280.0, 41)
    heat = 0.3 * (boundary - T) + 0.01 * (boundary - 275.0) * (T - 310.0)
    found = regress_pointwise(T, heat, np.full(41, 0.1), degree=2, boundary_K=boundary)
    assert len(found.basis.exponents) == 6
    np.testing.assert_allclose(found.predict(T, boundary).mean_W, heat, atol=1e-8)
    assert found.predict(np.array(310.0), np.array(300.0)).outside
    with pytest.raises(ModelError, match="own temperature"):
        found.effect_settings()


def test_vanishing_basis_has_no_heat_without_difference():
    boundary = np.full(41, 280.0)
    found = regress_pointwise(
        T, -0.5 * (T - 280.0) ** 2, np.full(41, 0.1), degree=2, boundary_K=boundary, vanishing=True
    )
    assert found.basis.exponents == ((1, 0), (2, 0))
    np.testing.assert_allclose(found.predict(T, boundary).mean_W, -0.5 * (T - 280.0) ** 2, atol=1e-8)
    moved = found.predict(T + 7.0, boundary + 7.0)
    np.testing.assert_allclose(moved.mean_W, -0.5 * (T - 280.0) ** 2, atol=1e-8)


@pytest.mark.parametrize("vanishing", [False, True])
def test_the_effect_is_the_same_polynomial(vanishing):
    """c_k ((T - centre) / scale)^k with |x| <= reach = 1 over the visited range."""
    found = regress_pointwise(
        T, _heat(T), np.full(41, 0.1), degree=3, boundary_K=np.full(41, 275.0), vanishing=vanishing
    )
    settings, values = found.effect_settings()
    x = (T - settings["centre_K"]) / settings["scale_K"]
    assert (settings["degree"], settings["reach"]) == (3, 1.0)
    assert x.min() == pytest.approx(-1.0) and x.max() == pytest.approx(1.0)
    curve = Polynomial([values[f"coefficients[{k}]"] for k in range(4)])
    np.testing.assert_allclose(curve(x), found.predict(T).mean_W, atol=1e-8)


def test_uncertain_temperature_is_averaged():
    """E[((T + s e - c) / w)^k], e ~ N(0, 1), from the moments 0, 1, 0, 3."""
    basis = Basis.over(4, T)
    x, s = basis.scaled(T)[0], 3.0 / basis.scale_K[0]
    expected = np.stack([np.ones_like(x), x, x**2 + s**2, x**3 + 3 * x * s**2, x**4 + 6 * x**2 * s**2 + 3 * s**4], 1)
    np.testing.assert_allclose(basis.terms(T, std_K=np.full(41, 3.0)), expected, atol=1e-12)


def test_a_node_that_does_not_move_has_a_constant_heat():
    found = regress_pointwise(np.full(5, 300.0), np.full(5, 7.0), np.ones(5), degree=0)
    assert found.predict(np.array(300.0)).mean_W == pytest.approx(7.0)
    assert found.predict(np.array(301.0)).outside


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Basis.over(-1, T), "at least 0, it is -1"),
        (lambda: Basis.over(0, T, T, vanishing=True), "at least 1, it is 0"),
        (lambda: Basis.over(2, T, vanishing=True), "needs the boundary temperature"),
        (lambda: Basis.over(2, np.array([np.nan])), "finite temperatures"),
        (lambda: regress_pointwise(T, T, 0.0 * T, degree=1), "no variance"),
    ],
)
def test_bad_input_is_told(call, words):
    with pytest.raises(ModelError, match=words):
        call()


def test_misfit_is_part_of_the_band():
    basis = Basis.over(1, T)
    sharp = ForcePolynomial(basis, np.array([1.0, 2.0]), np.zeros((2, 2)))
    loose = ForcePolynomial(basis, np.array([1.0, 2.0]), np.zeros((2, 2)), misfit_W=0.7)
    np.testing.assert_allclose(sharp.predict(T).std_W, 0.0)
    np.testing.assert_allclose(loose.predict(T).std_W, 0.7)
