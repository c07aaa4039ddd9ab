"""Discretisation against the matrix exponential, quadrature, and the paper's printed approximations."""

import numpy as np
import pytest
from scipy.linalg import expm

from twin_core.errors import ModelError
from twin_core.gp.discretise import discretise, distinct_steps
from twin_core.gp.kernels import Matern


def _network(seed: int, n: int = 4) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    f = rng.normal(size=(n, n)) - 2.0 * np.eye(n)
    root = rng.normal(size=(n, n))
    return f, root @ root.T


def _integral(integrand, stop: float) -> np.ndarray:
    """Gauss-Legendre with 12 points on 20 panels: rounding-level for these smooth integrands."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    panel = stop / 20
    points = [
        (panel * (k + 0.5 * (1 + x)), 0.5 * panel * w) for k in range(20) for x, w in zip(nodes, weights, strict=True)
    ]
    return sum(weight * integrand(point) for point, weight in points)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("step", [1e-3, 0.3, 5.0])
def test_matrices_are_their_integrals(seed, step):
    f, d = _network(seed)
    out = discretise(f, d, np.array([step]))
    q = _integral(lambda s: expm(f * s) @ d @ expm(f * s).T, step)
    hold = _integral(lambda s: expm(f * s), step)
    ramp = _integral(lambda s: expm(f * (step - s)) * s / step, step)
    np.testing.assert_allclose(out.transition[0], expm(f * step), rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(out.process_cov[0], q, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(out.hold[0], hold, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(out.ramp[0], ramp, rtol=1e-9, atol=1e-12)


def test_stiff_node_and_long_step():
    """A fast node and a step of a thousand of its time constants: the stationary covariance, not an overflow."""
    f = np.diag([-1e3, -1e-3])
    out = discretise(f, np.diag([2e3, 2e-3]), np.array([10.0]))
    assert out.process_cov[0, 0, 0] == pytest.approx(1.0, rel=1e-12)
    assert out.process_cov[0, 1, 1] == pytest.approx(-np.expm1(-0.02), rel=1e-12)
    assert out.hold[0, 0, 0] == pytest.approx(1e-3, rel=1e-12)


def test_small_entries_keep_their_digits():
    """Force noise seen through 1e8 J/K: Q_TT ~ 1e-17 Q_ff, against its closed form D h³ / (3 C²)."""
    f = np.array([[0.0, 1e-8], [0.0, 0.0]])
    out = discretise(f, np.diag([0.0, 1.0]), np.array([2.0]))
    assert out.process_cov[0, 0, 0] == pytest.approx(8.0 / 3.0 * 1e-16, rel=1e-12)


def test_singular_network():
    """Two nodes joined to nothing else: F is singular, the mean temperature drifts with the heat."""
    f = np.array([[-0.1, 0.1], [0.1, -0.1]])
    out = discretise(f, np.zeros((2, 2)), np.array([30.0]))
    np.testing.assert_allclose(out.hold[0].sum(axis=0), 30.0, rtol=1e-12)
    np.testing.assert_allclose(out.ramp[0].sum(axis=0), 15.0, rtol=1e-12)


def test_one_step_is_two_halves():
    """Chapman-Kolmogorov, with the input's ramp split in the middle."""
    f, d = _network(7)
    one, half = (discretise(f, d, np.array([h])) for h in (0.8, 0.4))
    a = half.transition[0]
    np.testing.assert_allclose(one.transition[0], a @ a, atol=1e-12)
    np.testing.assert_allclose(one.process_cov[0], a @ half.process_cov[0] @ a.T + half.process_cov[0], atol=1e-12)
    second = 0.5 * half.hold[0] + 0.5 * half.ramp[0]
    np.testing.assert_allclose(one.ramp[0], a @ (0.5 * half.ramp[0]) + second, atol=1e-12)


def test_many_steps_and_many_networks():
    """A stack of matrices gives what each gives alone."""
    pairs = [_network(seed) for seed in range(3)]
    steps = np.array([0.1, 1.0, 4.0])
    stack = discretise(np.array([f for f, _ in pairs]), np.array([d for _, d in pairs]), steps)
    for k, (f, d) in enumerate(pairs):
        alone = discretise(f, d, steps[k : k + 1])
        np.testing.assert_array_equal(stack.process_cov[k], alone.process_cov[0])


def test_complex_step_is_the_derivative():
    f, d = _network(1)
    df, dd = _network(2)
    moved = discretise(f + 1e-30j * df, d + 1e-30j * dd, np.array([0.7]))
    ahead, back = (discretise(f + s * df, d + s * dd, np.array([0.7])) for s in (1e-6, -1e-6))
    for name in ("transition", "process_cov", "hold", "ramp"):
        expected = (getattr(ahead, name) - getattr(back, name)) / 2e-6
        np.testing.assert_allclose(np.imag(getattr(moved, name)) / 1e-30, expected, atol=1e-6)


def test_first_order_is_as_in_the_paper():
    """Kouw et al., eq. 15, one block: Q22 as printed; Q12 with M⁻¹; Q11 with M⁻², which the integral gives."""
    capacity, step, gamma, length = 1000.0, 1.0, 20.0, 300.0
    block = Matern(1, decay=np.sqrt(3.0)).block(np.array([gamma, length]))
    rate = np.sqrt(3.0) / length
    density = 2.0 * rate * gamma**2
    f = np.array([[0.0, 1.0 / capacity], [0.0, block.feedback[0, 0]]])
    q = discretise(f, np.diag([0.0, density]), np.array([step]), scheme="first-order").process_cov[0]
    assert q[1, 1] == pytest.approx((step - rate * step**2 + rate**2 * step**3 / 3) * density)
    assert q[0, 1] == pytest.approx((step**2 / 2 - rate * step**3 / 3) * density / capacity)
    assert q[0, 0] == pytest.approx(step**3 / 3 * density / capacity**2)


def test_distinct_steps_find_the_few():
    time = np.concatenate([[0.0], np.cumsum(np.tile([1.0, 2.0, 1.0 + 1e-13], 5))])
    steps, index = distinct_steps(time)
    np.testing.assert_allclose(steps, [1.0, 2.0])
    np.testing.assert_array_equal(index, np.tile([0, 1, 0], 5))
    np.testing.assert_allclose(steps[index], np.diff(time), rtol=1e-9)
    assert distinct_steps(np.array([3.0]))[1].size == 0


@pytest.mark.parametrize("time", [[0.0, 1.0, 1.0], [0.0, np.nan], [1.0, 0.0]])
def test_time_must_increase(time):
    with pytest.raises(ModelError, match="strictly increasing"):
        distinct_steps(np.array(time))


def test_bad_dynamics_are_told():
    with pytest.raises(ModelError, match="steps must be positive"):
        discretise(np.zeros((1, 1)), np.zeros((1, 1)), np.array([0.0]))
    with pytest.raises(ModelError, match="a parameter is too large or small"):
        discretise(np.array([[np.inf]]), np.zeros((1, 1)), np.array([1.0]))


@pytest.mark.parametrize(
    ("feedback", "diffusion", "scheme", "words"),
    [
        (np.eye(2), np.eye(3), "exact", "square and of one size"),
        (np.zeros((2, 3)), np.zeros((2, 3)), "exact", "square and of one size"),
        (np.eye(2), np.eye(2), "second-order", "scheme: must be one of exact, first-order"),
    ],
)
def test_shapes_and_schemes_are_told(feedback, diffusion, scheme, words):
    with pytest.raises(ModelError, match=words):
        discretise(feedback, diffusion, np.ones(1), scheme=scheme)
