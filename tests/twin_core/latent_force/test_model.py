"""The block model against matrices written by hand, and its slopes against central differences."""

import numpy as np
import pytest
from scipy.linalg import expm

from twin_core.errors import ModelError
from twin_core.gp.kernels import Matern, Periodic
from twin_core.gp.score import Slopes
from twin_core.latent_force.augment import drive
from twin_core.latent_force.linearised import Linearised
from twin_core.latent_force.model import ForceModel

CAPACITY = np.array([[200.0, 500.0]])
TIMES = np.array([0.0, 10.0, 20.0, 35.0, 45.0])
GL = 3.0


def _jacobian(gl=GL):
    return np.array([[[-gl, gl], [gl, -gl - 1.0]]]) / CAPACITY[0][:, None]


def _network(gl=GL) -> Linearised:
    inputs = np.zeros((4, 2, 2))
    inputs[:, :, 0] = np.array([[0, 0], [50, 50], [50, 80], [80, 0]]) / 200.0
    return Linearised(TIMES, _jacobian(gl), inputs, CAPACITY)


def _model(kernel=None, nodes=(1,), network=None, **options) -> ForceModel:
    parts = dict(observation=np.eye(2), noise_std_K=[0.1, 0.2], prior_mean_K=[300.0, 290.0], prior_std_K=2.0)
    return ForceModel.build(network or _network(), nodes, kernel or Matern(1), **{**parts, **options})


def test_states_are_temperatures_then_forces():
    linear = _model().linear_model(np.array([7.0, 30.0]))
    f = np.zeros((3, 3))
    f[:2, :2] = _jacobian()[0]
    f[1, 2] = 1.0 / 500.0
    f[2, 2] = -1.0 / 30.0
    for k, step in enumerate(np.diff(TIMES)):
        np.testing.assert_allclose(linear.transition[linear.step_index[k]], expm(f * step), atol=1e-13)
    assert linear.transition.shape[0] == 2, "two distinct steps, two matrices"
    np.testing.assert_array_equal(linear.prior_mean, [300.0, 290.0, 0.0])
    np.testing.assert_allclose(linear.prior_cov, np.diag([4.0, 4.0, 49.0]))
    np.testing.assert_array_equal(linear.observation, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def test_inputs_are_integrated_exactly():
    """The third step's input rises linearly: against the same step cut into a thousand held ones."""
    linear = _model().linear_model(np.array([7.0, 30.0]))
    f, total, fine = _jacobian()[0], np.zeros(2), 15.0 / 1000
    hold = np.linalg.solve(f, expm(f * fine) - np.eye(2))
    for k in range(1000):
        total = expm(f * fine) @ total + hold @ np.array([(50 + 30 * (k + 0.5) / 1000) / 200.0, 0.0])
    np.testing.assert_allclose(linear.offset[2, :2], total, rtol=1e-6)


def test_positive_heat_warms():
    model = _model(Matern(3), nodes=(0, 1), shared=False)
    rows = model.force_rows(np.array([1.0, 10.0, 1.0, 10.0]))
    linear = model.linear_model(np.array([1.0, 10.0, 1.0, 10.0]))
    for k, node in enumerate((0, 1)):
        state = rows[k]
        assert (linear.transition[0] @ state)[node] > 0
    assert model.names == ("std[0]", "length_s[0]", "std[1]", "length_s[1]")


def test_many_jacobians_are_one_when_equal():
    """Linearised about any trajectory, a linear network gives the same discrete model."""
    rng = np.random.default_rng(0)
    nominal = 300.0 + rng.normal(size=(5, 2))
    c = _network().constant_K_per_s
    ends = np.stack([nominal[:-1], nominal[1:]], axis=1)
    rate = ends @ _jacobian()[0].T + c
    about = Linearised.about(TIMES, nominal, rate, np.repeat(_jacobian(), 4, axis=0), CAPACITY[0])
    assert about.jacobian_per_s.shape[0] == 1
    np.testing.assert_allclose(about.constant_K_per_s, c, atol=1e-12)
    moving = Linearised(TIMES, np.repeat(_jacobian(), 4, axis=0), c, CAPACITY)
    one, many = (_model(network=n).linear_model(np.array([7.0, 30.0])) for n in (_network(), moving))
    np.testing.assert_allclose(many.transition, one.transition[one.step_index], atol=1e-14)
    np.testing.assert_allclose(many.offset, one.offset, atol=1e-14)


@pytest.mark.parametrize("kernel", [Matern(1), Matern(5), Periodic(50.0, 2, forgets=True)], ids=str)
def test_slopes_are_central_differences(kernel):
    """Hyperparameters, a conductance, and the noise of one sensor, all in one vector."""
    model = ForceModel.build(
        lambda values: _network(values[0]),
        (0, 1),
        kernel,
        observation=np.eye(2),
        noise_std_K=[0.1, 0.2],
        prior_mean_K=[300.0, 290.0],
        prior_std_K=2.0,
        network_names=("GL_W_per_K",),
        estimate_noise=(1,),
        drift_K2_per_s=1e-6,
    )
    assert model.names[-2:] == ("GL_W_per_K", "noise_std_K[1]")
    values = np.array([*[2.0, 0.9, 40.0][: len(kernel.names)], GL, 0.3])
    slopes, step = model.slopes(values), 1e-6
    for p in range(values.size):
        ahead, back = (model.linear_model(values * np.exp(s * step * np.eye(values.size)[p])) for s in (1, -1))
        for name in Slopes._fields:
            expected = (getattr(ahead, name) - getattr(back, name)) / (2 * step)
            np.testing.assert_allclose(getattr(slopes, name)[p], expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"nodes": (2,)}, "force on node 2"),
        ({"network": "capacity"}, "node 1: the capacity must be positive"),
        ({"network": "jacobian"}, "jacobian_per_s has shape"),
        ({"network": "constant"}, "constant_K_per_s has shape"),
    ],
)
def test_bad_parts_are_told(change, words):
    def build():
        parts = {"jacobian": _jacobian(), "constant": _network().constant_K_per_s, "capacity": CAPACITY}
        bad = {"capacity": np.array([[1.0, 0.0]]), "jacobian": np.zeros((3, 2, 2)), "constant": np.zeros((4, 2))}
        if "network" in change:
            parts[change["network"]] = bad[change["network"]]
            return Linearised(TIMES, parts["jacobian"], parts["constant"], parts["capacity"])
        return _model(**change)

    with pytest.raises(ModelError, match=words):
        build()


def test_repeated_times_are_told():
    network = Linearised(np.array([0.0, 1.0, 1.0, 2.0, 3.0]), _jacobian(), _network().constant_K_per_s, CAPACITY)
    with pytest.raises(ModelError, match="strictly increasing"):
        _model(network=network).linear_model(np.array([7.0, 30.0]))


@pytest.mark.parametrize("n_repeats", [1, 40])
def test_distinct_steps_in_any_order_meet_their_own_inputs(n_repeats: int) -> None:
    """Tables of distinct steps are sorted, telemetry is not: every step's input acts over that step's own length."""
    rng = np.random.default_rng(5)
    steps = np.tile(rng.permutation(np.arange(1.0, 41.0)), n_repeats)
    distinct, index = np.unique(steps, return_inverse=True)
    hold = distinct[:, None, None] * np.array([[[0.5, 0.0], [0.0, 0.25]]])
    ramp = 0.1 * hold
    inputs = rng.normal(size=(steps.size, 2, 2))
    rise = inputs[:, 1] - inputs[:, 0]
    expected = steps[:, None] * np.array([0.5, 0.25]) * (inputs[:, 0] + 0.1 * rise)
    np.testing.assert_allclose(drive(hold, ramp, index, inputs), expected, rtol=1e-13, atol=1e-12)
