"""The choice of what to vary, against pivoted QR by LAPACK of finite differences."""

import numpy as np
import pytest
from scipy.linalg import qr

from tests.twin_core.calibrate.test_phases import rest, spec, transient
from twin_core.calibrate.choice import by_sensitivity, pivots, responses
from twin_core.calibrate.phases import at_rest, correlate
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.errors import ModelError
from twin_core.network.model import build_network


@pytest.fixture(scope="module")
def problem() -> Problem:
    return build_problem(build_network(spec()), [transient()], np.full(2, 0.05), 150.0)


def test_pivots_are_those_of_lapack(problem: Problem) -> None:
    """Of the finite differences of all readings, beside rows that say what is known of the initial temperatures."""
    start, step = problem.start(), 1e-4
    _, std = problem.prior()
    rows = []
    for k in range(start.size):
        ends = [problem.solve(start + sign * step * np.eye(start.size)[k]).predicted_K[0] for sign in (1.0, -1.0)]
        rows.append(((ends[0] - ends[1]) / (2.0 * step) / problem.noise_K).ravel())
    columns = np.array(rows).T
    n = problem.n_free
    known = np.hstack([np.zeros((problem.n_nodes, n)), np.diag(1.0 / std[n:])])
    stacked = np.vstack([columns, known])
    basis, _ = np.linalg.qr(stacked[:, n:])
    seen = (stacked[:, :n] - basis @ (basis.T @ stacked[:, :n])) * std[:n]
    _, _, order = qr(seen, mode="economic", pivoting=True)
    np.testing.assert_allclose(responses(problem), seen.T @ seen, rtol=1e-4, atol=1e-4 * np.abs(seen.T @ seen).max())
    assert pivots(responses(problem), n) == order.tolist()


def test_of_two_that_do_the_same_one_is_taken() -> None:
    columns = np.array([[3.0, 3.0, 0.1], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    assert pivots(columns.T @ columns, 3) == [0, 2]


def test_the_rest_keeps_its_guesses() -> None:
    known, held = by_sensitivity(spec(), [transient()], 2)
    parameters = build_network(known).parameters
    assert len(parameters.free_names) == 2 and set(held) == set(build_network(spec()).parameters.free_names) - set(
        parameters.free_names
    )
    assert parameters.as_dict() == build_network(spec()).parameters.as_dict()
    assert by_sensitivity(spec(), [transient()], 6)[1] == ()
    with pytest.raises(ModelError, match="at least one"):
        by_sensitivity(spec(), [transient()], 0)


def test_phases_at_rest_tell_of_conductances_alone() -> None:
    """No capacity moves a temperature at rest; what is chosen is told beside what is not."""
    phases = [at_rest(spec(), name, rest(*given)) for name, given in (("hot", (60.0, 30.0)), ("cold", (10.0, -20.0)))]
    found = correlate(spec(), phases, most_free=2)
    assert {row["name"] for row in found.report["parameters"] if row["identified"] is not None} == {
        "G:a|b",
        "G:b|plate",
    }
    assert found.report["notices"][0].startswith("capacities keep their guesses")
    assert found.report["notices"][1].startswith("1 parameter keeps its guess")
