"""The compiled recursions against SciPy's matrix exponential, dense solves and central differences."""

import numpy as np
import pytest
from scipy.linalg import expm

from twin_core.simulate.derivatives import march_sensitivities, transitions
from twin_core.simulate.kernels import NOT_NEAR, Remainder, march
from twin_core.simulate.matrices import FEW, product
from twin_core.simulate.modes import Modes, Turning, phi
from twin_core.simulate.relays import N_KICK, NO_RELAYS
from twin_core.simulate.splitting import entries, modes_of

N, N_STEPS = 4, 12
LOW, HIGH = np.full(N, -1e9), np.full(N, 1e9)
NO_KICKS = np.zeros((N_STEPS, 0, N_KICK))


def coupling(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a symmetric coupling with losses, and capacities."""
    rng = np.random.default_rng(seed)
    pairs = np.triu(rng.uniform(0.0, 2.0, (N, N)), 1)
    conductance = pairs + pairs.T
    return conductance - np.diag(conductance.sum(axis=1) + rng.uniform(0.1, 1.0, N)), rng.uniform(50.0, 500.0, N)


def dense_phi(matrix: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return e^(hA), h phi_1(hA) and h phi_2(hA) from one exponential (Al-Mohy and Higham 2011, theorem 2.1)."""
    n = len(matrix)
    big = np.zeros((3 * n, 3 * n))
    big[:n, :n], big[:n, n : 2 * n], big[n : 2 * n, 2 * n :] = h * matrix, np.eye(n), np.eye(n)
    found = expm(big)
    return found[:n, :n], h * found[:n, n : 2 * n], h * found[:n, 2 * n :]


def remainder(linear: np.ndarray, moving: np.ndarray, fourth: float = 0.0) -> Remainder:
    """Return a remainder with full matrices, linear (N, N) and moving (N_STEPS, 2, N, N), and a fourth power on node 1."""
    row, column = (index.ravel() for index in np.indices((N, N)))
    one = np.array([1])
    flat = np.ascontiguousarray(moving.reshape(len(moving), 2, N * N))
    return Remainder(row, column, linear.ravel(), one, one, np.array([fourth]), row, column, flat)


def problem(seed: int, size: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return (
        rng.choice([5.0, 20.0, 60.0, 61.3], N_STEPS),
        rng.normal(0.0, 0.1, (N_STEPS, 2, N)),
        size * (rng.normal(0.0, 1e-3, (N, N)) - 3e-3 * np.eye(N)),
        size * rng.normal(0.0, 1e-3, (N_STEPS, 2, N, N)),
        rng.normal(300.0, 20.0, N),
    )


@pytest.mark.parametrize("cells", [[], [(1, 2)], [(0, 1), (2, 0), (3, 3)]])
def test_entries_have_one_layout_however_many_they_are(cells: list[tuple[int, int]]) -> None:
    """The compiled loops are compiled once for each layout."""
    present = np.zeros((N, N), dtype=bool)
    for cell in cells:
        present[cell] = True
    row, column = entries(present)
    assert list(zip(row.tolist(), column.tolist(), strict=True)) == cells
    assert row.flags.c_contiguous and column.flags.c_contiguous


@pytest.mark.parametrize("z", [-1e4, -30.0, -1.0001, -0.9999, -1e-3, 0.0, 1e-9, 0.5, 3.0])
def test_phi_is_what_one_large_exponential_says(z: float) -> None:
    jordan = np.diag(np.ones(3), 1)
    jordan[0, 0] = z
    np.testing.assert_allclose(phi(z), expm(jordan)[0], rtol=1e-12, atol=1e-300)


@pytest.mark.parametrize("size", [0.0, 1.0, 8.0])
def test_march_is_the_exponential_trapezoidal_rule(size: float) -> None:
    """Small remainders go by fixed point, large ones by Newton's method: both to the solution of the linear step."""
    slope, capacity = coupling(1)
    step, given, linear, moving, start = problem(2, size)
    modes, a = modes_of(slope, capacity), slope / capacity[:, None]
    found, _, bad = march(step, modes, remainder(linear, moving), NO_RELAYS, given, start[None], NOT_NEAR, LOW, HIGH)
    assert bad == N_STEPS
    state = start
    for k in range(N_STEPS):
        keep, whole, late = dense_phi(a, step[k])
        r0, r1 = (linear + moving[k, side] for side in (0, 1))
        right = keep @ state + (whole - late) @ (given[k, 0] + r0 @ state) + late @ given[k, 1]
        end = np.linalg.solve(np.eye(N) - late @ r1, right)
        np.testing.assert_allclose(found[k], [state, end], rtol=1e-11, atol=1e-8)
        state = end


def test_steps_from_their_own_starts_are_single_steps() -> None:
    slope, capacity = coupling(3)
    step, given, linear, moving, _ = problem(4, 1.0)
    modes, left = modes_of(slope, capacity), remainder(linear, moving, -1e-11)
    starts = np.random.default_rng(5).normal(300.0, 20.0, (N_STEPS, N))
    found, _, _ = march(step, modes, left, NO_RELAYS, given, starts, NOT_NEAR, LOW, HIGH)
    for k in range(N_STEPS):
        alone = left._replace(moving=left.moving[k : k + 1])
        single, _, _ = march(
            step[k : k + 1], modes, alone, NO_RELAYS, given[k : k + 1], starts[k : k + 1], NOT_NEAR, LOW, HIGH
        )
        np.testing.assert_allclose(found[k], single[0], atol=1e-8)


@pytest.mark.parametrize("chained", [True, False])
@pytest.mark.parametrize("off_K", [0.0, 1e-3, 5.0, np.nan])
def test_states_close_by_change_where_it_starts_and_not_where_it_ends(off_K: float, chained: bool) -> None:
    slope, capacity = coupling(3)
    step, given, linear, moving, start = problem(4, 1.0)
    modes, left = modes_of(slope, capacity), remainder(linear, moving, -1e-11)
    rng = np.random.default_rng(5)
    starts = start[None] if chained else rng.normal(300.0, 20.0, (N_STEPS, N))
    found, _, bad = march(step, modes, left, NO_RELAYS, given, starts, NOT_NEAR, LOW, HIGH)
    near = found + off_K * rng.normal(size=found.shape)
    again, _, bad_again = march(step, modes, left, NO_RELAYS, given, starts, near, LOW, HIGH)
    np.testing.assert_allclose(again, found, rtol=0.0, atol=1e-8)
    assert bad == bad_again == N_STEPS


def test_what_leaves_the_limits_is_told() -> None:
    slope, capacity = coupling(6)
    step, given, linear, moving, start = problem(7, 0.0)
    given[5:] += 1e6
    left = remainder(linear, moving)
    found, _, bad = march(
        step, modes_of(slope, capacity), left, NO_RELAYS, given, start[None], NOT_NEAR, LOW, np.full(N, 1e3)
    )
    assert bad == 5
    assert np.nanmax(found) <= 1e3


def rolled(x: np.ndarray) -> tuple[np.ndarray, Modes, np.ndarray, Remainder, np.ndarray, np.ndarray]:
    """Return a trajectory as a function of a coupling, a capacity, a heat, a remainder and a start."""
    slope, capacity = coupling(8)
    link = np.zeros((N, N))
    link[np.ix_([0, 2], [0, 2])] = [[-1.0, 1.0], [1.0, -1.0]]
    slope, capacity = slope + x[0] * link, capacity + x[1] * np.eye(N)[1]
    step, given, linear, moving, start = problem(9, 1.0)
    given = given + x[2] * np.eye(N)[3]
    modes, left = modes_of(slope, capacity), remainder(linear, moving, -1e-10)
    path, _, bad = march(step, modes, left, NO_RELAYS, given, (start + x[3] * np.eye(N)[0])[None], NOT_NEAR, LOW, HIGH)
    assert bad == N_STEPS
    return path, modes, slope / capacity[:, None], left, step, given


def test_sensitivities_are_the_derivative_of_the_scheme_that_of_a_included() -> None:
    """d A by a coupling and by a capacity; the remainder's own parameters stay."""
    at = np.zeros(4)
    path, modes, a, left, step, given = rolled(at)
    _, capacity = coupling(8)
    turns = np.zeros((2, N, N))
    turns[0][np.ix_([0, 2], [0, 2])] = [[-1.0, 1.0], [1.0, -1.0]]
    turns[0] /= capacity[:, None]
    turns[1, 1] = -a[1] / capacity[1]
    row, column = np.indices((N, N)).reshape(2, -1)
    entry = left.linear + left.moving
    entry[:, :, 5] += 4.0 * left.fourth[0] * path[:, :, 1] ** 3  # row 1, column 1
    r = entry.reshape(N_STEPS, 2, N, N)
    fourth = np.zeros_like(path)
    fourth[:, :, 1] = -3.0 * left.fourth[0] * path[:, :, 1] ** 4  # u^4 is its slope times u less this
    rate = path @ a.T + given + np.einsum("ksij,ksj->ksi", r, path) + fourth
    series_node, series_column = np.array([0, 2, 1, 3]), np.array([0, 0, 1, 2])
    series = np.stack(
        [
            (path[:, :, 2] - path[:, :, 0]) / capacity[0],
            (path[:, :, 0] - path[:, :, 2]) / capacity[2],
            (path @ turns[1].T)[:, :, 1],
            np.ones((N_STEPS, 2)),
        ]
    )
    start = np.zeros((N, 4))
    start[0, 3] = 1.0
    samples, observed = np.array([0, 2, 2, N_STEPS]), np.array([3, 0, 1])
    found, end = march_sensitivities(
        step,
        modes,
        row,
        column,
        entry,
        path,
        rate,
        NO_RELAYS,
        NO_KICKS,
        np.zeros((4, 0), dtype=np.int64),
        np.zeros((4, 0)),
        Turning(np.array([0, 1]), *np.nonzero(turns), turns[np.nonzero(turns)]),
        series_column,
        series_node,
        series,
        start,
        samples,
        observed,
    )
    for c, h in enumerate((1e-4, 1e-2, 1e-4, 1e-2)):
        up, down = (rolled(sign * h * np.eye(4)[c])[0] for sign in (1.0, -1.0))
        whole = (up - down) / (2.0 * h)
        states = np.concatenate([whole[:1, 0], whole[:, 1]])
        scale = np.abs(states).max()
        np.testing.assert_allclose(found[:, :, c], states[samples][:, observed], atol=1e-6 * scale)
        np.testing.assert_allclose(end[:, c], states[-1], atol=1e-6 * scale)


@pytest.mark.parametrize("n", [1, FEW - 1, FEW, 30])
def test_a_product_is_that_of_numpy(n: int) -> None:
    rng = np.random.default_rng(n)
    matrix, columns, out = rng.normal(size=(n + 2, n)), rng.normal(size=(n, 7)), np.full((n + 2, 7), np.nan)
    product(matrix, columns, out)
    np.testing.assert_allclose(out, matrix @ columns, atol=1e-13 * n)


def test_transitions_are_the_derivative_of_single_steps() -> None:
    slope, capacity = coupling(10)
    step, given, linear, moving, _ = problem(11, 3.0)
    modes, left = modes_of(slope, capacity), remainder(linear, moving)
    starts = np.random.default_rng(12).normal(300.0, 20.0, (N_STEPS, N))
    row, column = np.indices((N, N)).reshape(2, -1)
    forward, response = transitions(step, modes, row, column, left.linear + left.moving, starts, NO_RELAYS, NO_KICKS)
    base, _, _ = march(step, modes, left, NO_RELAYS, given, starts, NOT_NEAR, LOW, HIGH)
    for node in range(N):
        unit = np.eye(N)[node]
        moved, _, _ = march(step, modes, left, NO_RELAYS, given, starts + unit, NOT_NEAR, LOW, HIGH)
        np.testing.assert_allclose(forward[:, :, node], moved[:, 1] - base[:, 1], atol=1e-8)
        heated, _, _ = march(step, modes, left, NO_RELAYS, given + unit, starts, NOT_NEAR, LOW, HIGH)
        np.testing.assert_allclose(response[:, :, node], heated[:, 1] - base[:, 1], atol=1e-8 * 60.0)


def test_a_stiff_mode_lands_on_its_target() -> None:
    """With f = -rate (x - target), rate h -> infinity, one step lands on the target."""
    nothing = np.zeros(0, dtype=np.int64)
    none = Remainder(
        nothing, nothing, np.zeros(0), nothing, nothing, np.zeros(0), nothing, nothing, np.zeros((1, 2, 0))
    )
    modes = modes_of(np.array([[-1e12]]), np.ones(1))
    given = np.full((1, 2, 1), 7e12)
    found, _, _ = march(np.ones(1), modes, none, NO_RELAYS, given, np.array([[300.0]]), NOT_NEAR, LOW[:1], HIGH[:1])
    np.testing.assert_allclose(found[0, 1], 7.0, atol=1e-8)
