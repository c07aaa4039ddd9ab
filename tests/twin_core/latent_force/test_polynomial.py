"""The polynomial heat: recovery, its band, its range, its form as an effect."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.helpers import every_term_network
from twin_core.effects import effect_from_json, effect_to_json
from twin_core.effects.learned_heat_flow import LearnedHeatFlow
from twin_core.errors import ModelError
from twin_core.gp.basis import Basis
from twin_core.gp.polynomial import ForcePolynomial
from twin_core.latent_force.polynomial import regress_pointwise
from twin_core.network.terms import Along

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
    with pytest.raises(ModelError, match="boundary_K is missing"):
        found.predict(T)


def test_vanishing_basis_has_no_heat_without_difference():
    boundary = np.full(41, 280.0)
    found = regress_pointwise(
        T, -0.5 * (T - 280.0) ** 2, np.full(41, 0.1), degree=2, boundary_K=boundary, vanishing=True
    )
    assert found.basis.exponents == ((1, 0), (2, 0))
    np.testing.assert_allclose(found.predict(T, boundary).mean_W, -0.5 * (T - 280.0) ** 2, atol=1e-8)
    moved = found.predict(T + 7.0, boundary + 7.0)
    np.testing.assert_allclose(moved.mean_W, -0.5 * (T - 280.0) ** 2, atol=1e-8)


@pytest.mark.parametrize("form", ["own temperature", "boundary", "still boundary", "vanishing"])
def test_the_effect_is_the_same_polynomial(form):
    """Usable at once: mean, slopes at the edge and doubt beyond it in a network are those of the prediction."""
    network = every_term_network()
    room = np.full(41, 290.0) if form == "still boundary" else np.linspace(285.0, 295.0, 41)
    boundary = None if form == "own temperature" else room
    law = regress_pointwise(
        T,
        _heat(T) + 0.3 * (room - 290.0),
        np.full(41, 0.1),
        degree=3,
        boundary_K=boundary,
        vanishing=form == "vanishing",
    )
    settings, values = law.effect_settings()
    where = {"node": "b"} if boundary is None else {"node": "b", "boundary": "room"}
    effect = effect_from_json(json.loads(json.dumps(effect_to_json(LearnedHeatFlow(where, values, settings)))))
    t, b = np.linspace(280.0, 340.0, 200), np.linspace(280.0, 300.0, 200)
    nodes, ends = np.tile(t[:, None], 3), np.tile(b[:, None], 3)
    along = Along(np.arange(200.0), nodes, ends, {}, np.ones(200))
    term = effect.addition(network.layout).terms[0]
    found = term.evaluate(along, np.array(list(values.values()))).heat_W[:, 0]
    told = law.predict(t, None if boundary is None else b)
    np.testing.assert_allclose(found, told.mean_W, rtol=1e-12)
    beyond = effect.beyond(network.layout, along)
    assert beyond is not None and network.nodes[beyond.node] == "b"
    np.testing.assert_array_equal(beyond.outside, told.outside)
    np.testing.assert_allclose(beyond.std_W, told.beyond_W, rtol=1e-12)
    assert ("room" in beyond.visited) == (boundary is not None)


WEIGHTS = arrays(np.float64, 21, elements=st.floats(-10.0, 10.0))


@given(WEIGHTS, st.integers(0, 5), st.booleans(), st.integers(0, 3), st.floats(0.0, 2.0))
@settings(max_examples=60, deadline=None)
def test_the_band_never_falls_outside_whatever_the_polynomial(weights, degree, vanishing, form, misfit_W):
    """By construction: every degree, every form, on either side, of the node and of the boundary."""
    boundary = (None, np.full(41, 275.0), np.linspace(270.0, 280.0, 41), np.linspace(280.0, 270.0, 41))[form]
    vanishing, degree = vanishing and form > 0, max(degree, 1)
    basis = Basis.over(degree, T, boundary, vanishing=vanishing)
    n = len(basis.exponents)
    law = ForcePolynomial(basis, weights[:n], np.outer(weights[-n:], weights[-n:]) + 1e-3 * np.eye(n), misfit_W)
    at_edge = None if boundary is None else 275.0
    far = np.array([0.0, 1e-3, 0.1, 0.5, 1.0, 2.0, 5.0, 20.0, 100.0])
    edges = np.array([basis.low_K[0], basis.high_K[0]]) + (275.0 if vanishing else 0.0)
    walks = [(edges[0] - far, at_edge), (edges[1] + far, at_edge)]
    if boundary is not None and not vanishing:
        walks += [(310.0, basis.high_K[1] + far), (310.0, basis.low_K[1] - far)]
    for t, b in walks:
        band = law.predict(t, b)
        assert (np.diff(band.std_W) > 0.0).all() and (np.diff(band.beyond_W) > 0.0).all()
        raw = basis.at_scaled(basis.scaled(t, b)) @ law.mean_W
        assert (np.abs(raw - band.mean_W) <= band.std_W * (1.0 + 1e-9)).all()


def test_a_constant_heat_grows_too():
    """Degree nought: one half-range away the heat may be nothing or twice itself."""
    law = ForcePolynomial(Basis.over(0, T), np.array([3.0]), np.array([[16.0]]))
    band = law.predict(np.array([330.0, 350.0, 370.0, 270.0]))
    np.testing.assert_allclose(band.beyond_W, [0.0, 5.0, 10.0, 5.0])
    np.testing.assert_allclose(band.std_W, np.hypot(4.0, [0.0, 5.0, 10.0, 5.0]))


def test_taylor_coefficients_are_the_binomials():
    """The terms at a point apart, from the coefficients at another, in two variables."""
    basis = Basis.over(4, T, np.linspace(270.0, 280.0, 41))
    at, step = np.array([[0.3, -1.0], [0.7, 0.2]]), np.array([0.4, -1.3])
    powers = step[0] ** np.arange(5)[:, None] * step[1] ** np.arange(5)
    moved = np.einsum("nkij,ij->nk", basis.taylor(at), powers)
    np.testing.assert_allclose(moved, basis.at_scaled(at + step[:, None]), rtol=1e-12)


def test_a_boundary_that_stood_still_is_told_once_it_moves():
    law = regress_pointwise(T, _heat(T), np.full(41, 0.1), degree=3, boundary_K=np.full(41, 275.0))
    assert not law.predict(T, np.full(41, 275.0)).outside.any()
    near, far = law.predict(np.array(310.0), np.array(276.0)), law.predict(np.array(310.0), np.array(285.0))
    assert near.outside and near.mean_W == far.mean_W and near.std_W < far.std_W
    alone = regress_pointwise(T, _heat(T), np.full(41, 0.1), degree=3)
    assert not alone.predict(T, np.full(41, 150.0)).outside.any(), "a boundary that takes no part was looked at"


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
        (lambda: regress_pointwise(T, T, T[:3], degree=1), "one shape"),
        (lambda: regress_pointwise(T, T, -T, degree=1), "not negative"),
        (lambda: regress_pointwise(T, T * np.nan, T, degree=1), "must be finite"),
        (lambda: regress_pointwise(T, T, T, degree=1, prior_std_W=0.0), "prior_std_W must be positive"),
        (lambda: Basis(1, False, (290.0,), (280.0,)), "low_K not above high_K"),
        (lambda: Basis(1, True, (290.0,), (300.0,)), "two where a boundary takes part"),
        (lambda: Basis(1, False, (290.0, 3.0), (300.0,)), "one temperature each"),
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
