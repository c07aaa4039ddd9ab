"""The paper's method: embedding, limiter, block-diagonal windows, gradients three ways, a small network recovered."""

import json
from typing import Any

import numpy as np
import pytest
import torch

from tests.analytic import laplacian, linear_states
from tests.helpers import central_difference, record_of
from twin_core.calibrate import CalibratedModel, calibrate, neural_ode
from twin_core.calibrate.neural_ode import (
    Embedding,
    Recipe,
    Trainer,
    embed,
    fit_neural_ode,
    inside,
    limit,
    roll,
    unembed,
)
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.calibrate.summary import to_model
from twin_core.calibrate.windows import balance_of
from twin_core.errors import ModelError
from twin_core.forecast import forecast
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.response import sensitivities
from twin_core.telemetry import Record

STEP_S, CAPACITY, CONDUCTANCE, WALL_W_PER_K, ROOM_K = 20.0, np.array([4.0e3, 7.0e3]), 2.5, 0.9, 285.0


def declared(**fields: Any) -> dict[str, Any]:
    """Two nodes, one of them heated, the other one tied to a room."""
    return {
        "twin": "pair",
        "boundaries": {"room": {"value_K": ROOM_K}, "space": {"value_K": 3.0}},
        "channels": {
            "T_a": {"kind": "temperature", "unit": "K", "noise_std": 0.1},
            "T_b": {"kind": "temperature", "unit": "K", "noise_std": 0.1},
            "Q": {"kind": "power", "unit": "W"},
        },
        "nodes": [
            {"id": "a", "sensor": "T_a", "capacity_J_per_K": {"guess": 6.0e3}},
            {"id": "b", "sensor": "T_b", "capacity_J_per_K": {"guess": 5.0e3}},
        ],
        "conductors": [
            {"between": ["a", "b"], "conductance_W_per_K": {"guess": 1.5}},
            {"between": ["b", "room"], "conductance_W_per_K": {"guess": 1.5, "bounds": [0.5, 4.0]}},
        ],
        "loads": [{"channel": "Q", "node": "a"}],
    } | fields


def telemetry(n_times: int = 241, noise_K: float = 0.0) -> Record:
    """Return telemetry by the matrix exponential."""
    rng = np.random.default_rng(0)
    heat = np.repeat(rng.choice([0.0, 60.0, 150.0], n_times // 12 + 1), 12)[:n_times]
    rates = -(laplacian(2, [(0, 1)], [CONDUCTANCE]) + np.diag([0.0, WALL_W_PER_K])) / CAPACITY[:, None]
    drive = np.stack([heat, np.full(heat.size, WALL_W_PER_K * ROOM_K)], axis=1) / CAPACITY
    time_s = STEP_S * np.arange(n_times)
    read = linear_states(rates, drive, np.array([290.0, 288.0]), time_s) + noise_K * rng.normal(size=(n_times, 2))
    return record_of(time_s, Q=heat, T_a=read[:, 0], T_b=read[:, 1])


def problem_of(data: dict[str, Any], record: Record, max_step_s: float = 30.0) -> Problem:
    return build_problem(build_network(load_spec(data)), [record], np.full(2, 0.1), max_step_s)


def radiating() -> dict[str, Any]:
    """The pair with a radiator and a load that runs linearly between its samples."""
    data = declared(radiators=[{"node": "a", "emissivity": 0.8, "area_m2": 0.1, "sink": "space"}])
    data["channels"]["Q"]["interpolation"] = "linear"
    return data


def test_psi_stays_between_its_bounds_and_comes_back() -> None:
    free, scale = torch.linspace(-3.0, 3.0, 25, dtype=torch.float64), torch.tensor(7.0, dtype=torch.float64)
    value = embed(free, scale)
    assert ((value > 0.0) & (value < 7.0)).all() and (value.diff() > 0.0).all()
    torch.testing.assert_close(unembed(value, scale), free, atol=1e-5, rtol=1e-5)
    assert float(embed(torch.zeros(()), scale)) == 3.5


@pytest.mark.parametrize("temperature_K", [-900.0, 120.0, 199.99, 200.0, 300.0, 400.0, 400.01, 550.0, 3000.0])
def test_the_limiter_is_bounded_and_smooth(temperature_K: float) -> None:
    """The identity from 200 to 400 K, within 0 and 600 K elsewhere; its derivative is that of central differences."""
    point = torch.tensor(temperature_K, dtype=torch.float64, requires_grad=True)
    limited = limit(point)
    limited.backward()  # type: ignore[no-untyped-call]
    assert 0.0 <= float(limited.detach()) <= 600.0
    if 200.0 <= temperature_K <= 400.0:
        assert float(limited.detach()) == temperature_K
    slope = central_difference(lambda t: limit(torch.tensor(t, dtype=torch.float64)).numpy(), temperature_K, 1e-3)
    assert point.grad is not None
    assert float(point.grad) == pytest.approx(float(slope), abs=1e-6)


def test_batched_windows_are_separate_windows() -> None:
    """One disconnected graph: no window feels another one."""
    trainer = Trainer(problem_of(radiating(), telemetry()), Recipe(window_s=600.0))
    matrix = trainer.matrix(trainer.embedding.start)
    start = torch.as_tensor(trainer.windows.start_K)
    field, n_steps = trainer.field.at(matrix), trainer.windows.n_steps
    together = roll(field, start, n_steps, trainer.recipe, limited=False)
    moved = start.clone()
    moved[1:] += 10.0
    apart = roll(field, moved, n_steps, trainer.recipe, limited=False)
    assert start.shape[0] == 8
    torch.testing.assert_close(together[:, 0], apart[:, 0], atol=0.0, rtol=0.0)
    assert float((together[:, 1:] - apart[:, 1:]).abs().min()) > 1.0


def test_a_window_is_the_rollout_of_its_own_record() -> None:
    """The batched trajectories are those of our own scheme from the same readings."""
    record, problem = telemetry(), problem_of(radiating(), telemetry(), 1.0)
    trainer = Trainer(problem_of(radiating(), record), Recipe(window_s=600.0))
    with torch.no_grad():
        field = trainer.field.at(trainer.matrix(trainer.embedding.start))
        path = roll(field, torch.as_tensor(trainer.windows.start_K), 30, trainer.recipe, limited=False).numpy()
    for window in range(8):
        part = record.take(np.arange(30 * window, 30 * window + 31))
        own = problem_of(radiating(), part, 1.0)
        start = np.array([part.values["T_a"][0], part.values["T_b"][0]])
        fit = own.solve(np.concatenate([problem.network.parameters.free, start]))
        np.testing.assert_allclose(path[:, window], fit.predicted_K[0], atol=1e-3)


def own_gradient(problem_data: dict[str, Any], record: Record, n_steps: int) -> tuple[float, np.ndarray]:
    """Return the mean squared error over windows and d loss / d ln parameter from exact sensitivities, fine steps."""
    square, gradient, count = 0.0, np.zeros(3), 0
    for first in range(0, record.time_s.size - 1, n_steps):
        part = record.take(np.arange(first, first + n_steps + 1))
        own = problem_of(problem_data, part, 0.5)
        network, segment = own.network, own.segments[0]
        start = np.array([part.values["T_a"][0], part.values["T_b"][0]])
        fit = own.solve(np.concatenate([network.parameters.free, start]))
        columns = np.zeros((2, own.n_free))
        parts = sensitivities(
            network,
            network.parameters.values,
            segment.forcing,
            fit.trajectories[0],
            columns,
            network.sensor_node,
        )
        residual = own.residuals(fit)[0][1:]
        block = np.concatenate([b for _, b in parts])[1:]
        square, count = square + float((residual**2).sum()), count + residual.size
        gradient = gradient - 2.0 * np.einsum("tsk,ts->k", block, residual)
    return square / count, gradient / count


def test_adjoint_direct_and_exact_sensitivities_agree() -> None:
    """Three ways to one gradient: backward in time, through the unrolled solver, forward by our own recursion."""
    data, record = radiating(), telemetry()
    data["conductors"][1]["conductance_W_per_K"] = {"value": WALL_W_PER_K}
    loss, own = own_gradient(data, record, 30)
    for gradients in ("adjoint", "direct"):
        recipe = Recipe(window_s=600.0, gradients=gradients, validation_share=0.0)
        trainer = Trainer(problem_of(data, record), recipe)
        free = trainer.embedding.start.clone().requires_grad_(True)
        train, _ = trainer.losses(free)
        train.backward()  # type: ignore[no-untyped-call]
        # d p / d p~ over p of the two inverse capacities (ln gamma = -ln C) and of the conductance.
        psi = embed(trainer.embedding.start, trainer.embedding.scale)
        slope = 4.0 * (1.0 - psi / trainer.embedding.scale)
        expected = own * slope.numpy() * np.array([-1.0, -1.0, 1.0])
        assert float(train.detach()) == pytest.approx(loss, rel=1e-4)
        np.testing.assert_allclose(free.grad.numpy(), expected, rtol=1e-3)


def test_the_limiter_acts_in_training_only() -> None:
    """A hundredfold heat leaves the range: training sees bounded temperatures, validation the bare dynamics."""
    record = telemetry()
    hot = Record(record.time_s, {**record.values, "Q": 100.0 * record.values["Q"]})
    trainer = Trainer(problem_of(declared(), hot), Recipe(window_s=1200.0))
    train, validation = trainer.losses(trainer.embedding.start)
    field = trainer.field.at(trainer.matrix(trainer.embedding.start))
    bare = roll(field, torch.as_tensor(trainer.windows.start_K), trainer.windows.n_steps, trainer.recipe, limited=False)
    assert not inside(bare) and float(bare.max()) > 600.0
    assert float(train) < 300.0**2 < float(validation)


def test_a_small_network_is_recovered() -> None:
    recipe = Recipe(window_s=400.0, learning_rate=0.1, max_iterations=120)
    training, calibration = fit_neural_ode(load_spec(declared()), [telemetry()], recipe)
    found = calibration.network.parameters.as_dict()
    truth = {"C:a": CAPACITY[0], "C:b": CAPACITY[1], "G:a|b": CONDUCTANCE, "G:b|room": WALL_W_PER_K}
    for name, value in truth.items():
        assert found[name] == pytest.approx(value, rel=0.05), name
    assert training.validation_K2.min() < 1e-2 * training.validation_K2[0]


def test_training_stops_when_the_validation_loss_rests() -> None:
    recipe = Recipe(window_s=800.0, learning_rate=0.3, max_iterations=300, patience=5)
    training, calibration = fit_neural_ode(load_spec(declared()), [telemetry(noise_K=0.5)], recipe)
    assert training.status == "early_stopping"
    assert training.validation_K2.size == int(np.argmin(training.validation_K2)) + 6 < 300
    assert "validation" in to_model(calibration, (), uncertain=False).summary["advice"]


def test_the_model_forecasts_and_says_that_it_knows_no_uncertainty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neural_ode, "Recipe", lambda: Recipe(max_iterations=3))
    record = telemetry()
    model = calibrate(load_spec(declared()), [record], method="neural-ode")
    again = CalibratedModel.from_json(json.loads(json.dumps(model.to_json(), allow_nan=False)))
    assert again.free_names == () and again.covariance.size == 0
    assert any("no uncertainty" in line for line in again.summary["words"])
    assert all(row["std"] is None for row in again.summary["parameters"])
    ahead = forecast(again, record, 600.0)
    assert np.isfinite(ahead.mean_K).all()
    assert (ahead.quantiles_K[0.05] < ahead.quantiles_K[0.95]).all()


def test_a_truth_beyond_the_reach_of_psi_is_told() -> None:
    """From a guess of 4e4 J/K it reaches 1e4 J/K at best; the truth is 4e3."""
    far = declared()
    far["nodes"][0]["capacity_J_per_K"] = {"guess": 4.0e4}
    settings = {"learning_rate": 0.1, "window_s": 400.0, "max_iterations": 150}
    notices = calibrate(load_spec(far), [telemetry()], method="neural-ode", training=settings).summary["notices"]
    (told,) = [line for line in notices if line.startswith("C:a: ended at the end")]
    assert "1e+04 to inf J/K" in told


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"learning_rate": 0.0}, "learning_rate: must be a positive number"),
        ({"patience": 2.5}, "patience: must be a whole number"),
        ({"momentum": 0.9}, "unknown setting 'momentum'"),
    ],
)
def test_settings_that_make_no_sense(settings: dict[str, float], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        calibrate(load_spec(declared()), [telemetry()], method="neural-ode", training=settings)
    with pytest.raises(ModelError, match="belongs to method 'neural-ode'"):
        calibrate(load_spec(declared()), [telemetry()], training=settings)


def test_a_guess_on_a_bound_is_refused() -> None:
    network = build_network(load_spec(declared()))
    on_bound = network.with_parameters(network.parameters.updated({"G:b|room": 4.0}))
    problem = build_problem(on_bound, [telemetry()], np.full(2, 0.1))
    with pytest.raises(ModelError, match=r"G:b\|room: the guess 4 is not inside its bounds"):
        Embedding(problem)


def test_what_the_method_does_not_know_is_refused() -> None:
    unread = declared()
    del unread["nodes"][1]["sensor"], unread["channels"]["T_b"]
    unknown = declared(boundaries={"room": {"guess_K": 280.0}})
    table = declared()
    table["channels"]["pitch"] = {"kind": "auxiliary", "unit": "deg"}
    table["loads"].append({"channel": "pitch", "node": "a", "table": {"knots": [0.0, 90.0]}})
    record = telemetry()
    record = Record(record.time_s, {**record.values, "pitch": np.zeros(record.time_s.size)})
    for data, message in (
        (unread, "node 'b' has no sensor"),
        (unknown, "boundary 'room'"),
        (table, "loads with a gain"),
    ):
        with pytest.raises(ModelError, match=message):
            balance_of(build_problem(build_network(load_spec(data)), [record], np.full(2, 0.1)))
