"""Forces, conductances, capacities and noise of a declared network, fitted together."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.helpers import central_difference, every_term_network
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4 as SIGMA
from twin_core.errors import ModelError
from twin_core.gp.kernels import Matern
from twin_core.latent_force.declared import along_parameters, declared_model, fit_declared
from twin_core.latent_force.posterior import GammaPrior
from twin_core.network.model import Network, build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import Forcing, build_forcing
from twin_core.telemetry import Record

CAPACITY, CONDUCTANCE, AREA_M2, NOISE_K = (800.0, 2000.0), 1.5, 0.16, 0.02
TIMES = np.arange(0.0, 12000.0, 60.0)
POWER = np.where(TIMES % 2400.0 < 1200.0, 60.0, 10.0)
SPEC = {
    "twin": "t",
    "boundaries": {"space": {"value_K": 3.0}},
    "channels": {
        "T_a": {"kind": "temperature", "unit": "K"},
        "T_b": {"kind": "temperature", "unit": "K"},
        "Q": {"kind": "power", "unit": "W"},
    },
    "nodes": [
        {"id": "a", "sensor": "T_a", "capacity_J_per_K": {"guess": 1100.0}},
        {"id": "b", "sensor": "T_b", "capacity_J_per_K": {"value": CAPACITY[1]}},
    ],
    "conductors": [{"between": ["a", "b"], "conductance_W_per_K": {"guess": 1.0}}],
    "radiators": [{"node": "b", "emissivity": 1.0, "area_m2": AREA_M2, "sink": "space"}],
    "loads": [{"channel": "Q", "node": "a"}],
}
NAMES = ("C:a", "G:a|b")
PRIORS = {"std": GammaPrior(2.0, 0.3), "length_s": GammaPrior(3.0, 0.003)}
START = {"std": 3.0, "length_s": 600.0}
OPTIONS = {"noise_std_K": NOISE_K, "prior_mean_K": np.array([265.0, 255.0]), "prior_std_K": 5.0}


def _hidden(t: float) -> float:
    return 5.0 * np.sin(2.0 * np.pi * t / 3000.0) + 3.0 * np.cos(2.0 * np.pi * t / 1100.0)


def _truth() -> np.ndarray:
    """Return the temperatures by SciPy, inputs held, (n_times, 2)."""
    out = [np.array([265.0, 255.0])]
    for k in range(TIMES.size - 1):

        def rates(t: float, x: np.ndarray, k: int = k) -> list[float]:
            exchange = CONDUCTANCE * (x[1] - x[0])
            radiated = SIGMA * AREA_M2 * (3.0**4 - x[1] ** 4)
            return [(POWER[k] + exchange) / CAPACITY[0], (_hidden(t) - exchange + radiated) / CAPACITY[1]]

        out.append(solve_ivp(rates, TIMES[k : k + 2], out[-1], rtol=1e-9, atol=1e-8).y[:, -1])
    return np.array(out)


TRUTH = _truth()


def _setting(seed: int = 0) -> tuple[Network, Forcing, np.ndarray]:
    network = build_network(load_spec(SPEC))
    samples = TRUTH + NOISE_K * np.random.default_rng(seed).normal(size=TRUTH.shape)
    record = Record(TIMES, {"T_a": samples[:, 0], "T_b": samples[:, 1], "Q": POWER})
    return network, build_forcing(network, record, 60.0), samples


def test_the_slopes_of_every_kind_of_parameter_are_central_differences() -> None:
    """Capacities, conductances, gains, tables, an unknown sink, radiation: all arrays of the discrete model."""
    network, rng = every_term_network(), np.random.default_rng(0)
    times = 60.0 * np.arange(12)
    values = {name: rng.uniform(270.0, 300.0, 12) for name in ("T_a", "T_b", "T_room")}
    values |= {"Q_a": rng.uniform(5.0, 60.0, 12), "Q_sun": rng.uniform(0.0, 90.0, 12), "H": rng.uniform(0.0, 90.0, 12)}
    values |= {"pitch": rng.uniform(50.0, 130.0, 12), "mode": rng.integers(0, 3, 12).astype(float)}
    forcing = build_forcing(network, Record(times, values, 0), 60.0)
    names = ("C:a", "G:a|b", "G:c|room", "gain:H|c", "T:sink", "table:mode|b[1]")
    temperatures = rng.uniform(270.0, 300.0, (12, 3))
    model = declared_model(
        network, forcing, temperatures, ("a", "c"), Matern(3), names=names, estimate_noise=("T_b",),
        noise_std_K=0.1, prior_mean_K=280.0, prior_std_K=5.0,
    )  # fmt: skip
    named = network.parameters.as_dict()
    at = np.array([2.0, 300.0, *(named[name] for name in names), 0.1])
    slopes, steps = model.slopes(at), np.eye(at.size)
    for p in range(at.size):
        for array in ("transition", "process_cov", "offset", "noise_variance"):

            def value(x: float, p: int = p, array: str = array) -> np.ndarray:
                return np.array(getattr(model.linear_model(at * np.exp(x * steps[p])), array))

            expected = central_difference(value, 0.0, 1e-3)
            scale = np.abs(value(0.0)).max()
            found = getattr(slopes, array)[p]
            np.testing.assert_allclose(found, expected, atol=1e-7 * scale, err_msg=f"{model.names[p]} {array}")


def test_force_conductance_and_capacity_are_found_together() -> None:
    """A guess 30 % off, hidden heat on the radiating node: both within three deviations, the heat within its band."""
    network, forcing, samples = _setting()
    found = fit_declared(
        network, forcing, samples, ("b",), Matern(3), PRIORS, START | {"noise_std_K[0]": 0.05},
        names=NAMES, estimate_noise=("T_a",), **OPTIONS,
    )  # fmt: skip
    fitted, std = found.fit.named(), dict(zip(found.fit.names, found.fit.std, strict=True))
    assert found.settled and found.fit.converged and not found.fit.notices
    for name, truth in {"C:a": CAPACITY[0], "G:a|b": CONDUCTANCE, "noise_std_K[0]": NOISE_K}.items():
        assert abs(fitted[name] - truth) < 3.0 * std[name] and std[name] < 0.15 * truth, name
    assert found.network.parameters.as_dict()["C:a"] == pytest.approx(fitted["C:a"])
    inner = slice(3, -3)
    away = (found.force.mean_W[:, 0] - _hidden(TIMES))[inner]
    assert np.sqrt(np.mean(away**2)) < 1.0
    assert np.mean(np.abs(away) < 1.96 * found.force.std_W[inner, 0]) > 0.85


def test_what_a_force_can_take_over_is_told() -> None:
    """A free heat on the very node whose capacity is asked for, and no known heat into it: only the ratio is seen."""
    spec = {k: v for k, v in SPEC.items() if k not in ("radiators", "conductors", "loads", "boundaries")}
    network = build_network(
        load_spec(spec | {"nodes": SPEC["nodes"][:1], "channels": {"T_a": SPEC["channels"]["T_a"]}})
    )
    forcing = build_forcing(network, Record(TIMES, {"T_a": TRUTH[:, 0]}), 60.0)
    priors = PRIORS | {"C:a": GammaPrior(4.0, 0.004)}
    found = fit_declared(
        network, forcing, TRUTH[:, :1], ("a",), Matern(3), priors, START,
        names=("C:a",), noise_std_K=NOISE_K, prior_mean_K=265.0, prior_std_K=5.0,
    )  # fmt: skip
    assert found.settled and found.n_linearisations == 2
    assert any("std and C:a together are not identifiable" in notice for notice in found.fit.notices)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"names": ("C:x",)}, "parameter 'C:x': the network has C:a"),
        ({"nodes": ("x",)}, "unknown node 'x'"),
        ({"estimate_noise": ("T_x",)}, "unknown sensor 'T_x'"),
        ({"max_linearisations": 0}, "max_linearisations must be at least 1"),
        ({"prior_mean_K": np.nan}, "prior_mean_K: holds a number that is not finite"),
        ({"prior_std_K": np.inf}, "prior_std_K: is infinite"),
    ],
)
def test_what_is_not_there_is_told(change: dict, words: str) -> None:
    network, forcing, samples = _setting()
    given = {"nodes": ("b",), "names": NAMES, "max_linearisations": 1} | OPTIONS | change
    with pytest.raises(ModelError, match=words):
        fit_declared(network, forcing, samples, given.pop("nodes"), Matern(3), PRIORS, START, **given)


def test_only_positive_parameters_are_fitted() -> None:
    network = every_term_network()
    flat = network.with_parameters(network.parameters.updated({"table:mode|b[1]": -3.0}))
    with pytest.raises(ModelError, match="only a positive one"):
        along_parameters(flat, None, np.zeros((1, 3)), ("table:mode|b[1]",))
