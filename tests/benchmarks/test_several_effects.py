"""Several effects as one, what the sensors can tell of them, and cases that survive being written down."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.case import read_case, save_case
from benchmarks.combined_effects import distance, together, wandering
from benchmarks.declared_fit import calibrated
from benchmarks.hidden_effects import HIDDEN
from benchmarks.network_cases import declared, inputs, network_case
from benchmarks.network_world import NOTHING, Hidden, World
from benchmarks.several_effects import KINDS, several_case
from benchmarks.worlds.hidden.sensing import lag_exact
from twin_core.telemetry import Record


def world(seed: int = 3) -> World:
    """Return a small network with a short record."""
    return World(np.random.default_rng(seed), 2, 60.0, 5)


def states(hidden: Hidden) -> np.ndarray:
    """Return what happens in it, from the same start every time."""
    own = world()
    own.rng = np.random.default_rng(1)
    return own.simulate(hidden)


def test_an_effect_together_with_nothing_is_itself() -> None:
    for effect in ("hidden_mass", "latent_heat", "sensor_lag", "thermostat_heater", "missing_conductor"):
        own = world()
        own.rng = np.random.default_rng(7)
        alone = HIDDEN[effect](own, 1)
        np.testing.assert_allclose(states(together(own, [NOTHING, alone])), states(alone), atol=1e-9)


def test_a_mass_and_a_slow_sensor_keep_their_own_states() -> None:
    own = world()
    mass, slow = HIDDEN["hidden_mass"](own, 0), HIDDEN["sensor_lag"](own, 2)
    both = together(own, [mass, slow])
    assert both.n_extra == 2 and both.reads == {2: own.n + 1}
    found, alone = states(both), states(mass)
    np.testing.assert_allclose(found[:, : own.n], alone[:, : own.n], atol=1e-4)
    tau_s = slow.parameters["tau_s"]
    late = int(8 * tau_s / 60.0)
    np.testing.assert_allclose(found[late:, own.n + 1], lag_exact(found[:, 2], 60.0, tau_s)[late:], atol=0.02)


def test_heats_together_are_their_sum() -> None:
    own = world()
    x = np.linspace(280.0, 300.0, own.n)
    one, two = HIDDEN["constant_heat_load"](own, 0), HIDDEN["leak_to_boundary"](own, 3)
    assert one.heat is not None and two.heat is not None
    both = together(own, [one, two])
    assert both.heat is not None
    np.testing.assert_allclose(both.heat(5.0, 1, x), one.heat(5.0, 1, x) + two.heat(5.0, 1, x))


def test_distances_count_conductors() -> None:
    own = world()
    own.edges = [(0, 1), (1, 2), (2, 3), (1, 4)]
    assert [distance(own, [0], [i]) for i in range(5)] == [0, 1, 2, 3, 2]
    assert distance(own, [0, 2], [3, 4]) == 1


def test_what_a_conductance_does_is_imitated_and_what_a_sensor_does_is_not() -> None:
    """The oracle is SciPy's solution with another conductance, not the sensitivities themselves."""
    own = world()
    own.rng = np.random.default_rng(1)
    healthy = own.simulate()
    values = {"T_room": own.room_K, "mode": own.mode} | inputs(own)
    values |= {f"T{i}": healthy[:, i] + np.random.default_rng(i).normal(0, 0.05, len(healthy)) for i in range(own.n)}
    spec = declared(own, own.capacity.tolist(), own.conductance.tolist(), (), "x")
    fit = calibrated(spec, Record(own.time_s, values))
    own.conductance[0] *= 1.02
    own.rng = np.random.default_rng(1)
    moved = own.simulate() - healthy
    n = fit.residual_K.shape[0]
    assert np.linalg.norm(fit.beyond(moved)) < 0.05 * np.linalg.norm(moved[:n])
    bias = np.zeros_like(healthy)
    bias[n // 2 :, 0] = 1.0
    assert np.linalg.norm(fit.beyond(bias)) > 0.3 * np.linalg.norm(bias[:n])


def test_a_wandering_path_is_slow_and_of_unit_size() -> None:
    own = world()
    path = wandering(own, np.random.default_rng(0), own.period_s)
    assert np.sqrt(np.mean(path**2)) == pytest.approx(1.0)
    assert np.abs(np.diff(path)).max() < 0.1


@pytest.mark.parametrize("seed", [3, 5])
def test_cases_keep_what_their_kind_promises(seed: int) -> None:
    case = several_case(2, seed)
    kind = KINDS[seed % len(KINDS)]
    assert case.facts["kind"] == kind
    assert len(case.truths) == (1 if kind == "beside_drift" else 2)
    assert ("drift" in case.facts) == (kind == "beside_drift")
    traces = [truth.trace for truth in case.truths]
    assert traces == sorted(traces, reverse=True) and traces[0] <= 5.0 * traces[-1]
    assert min(truth.trace_beyond for truth in case.truths) >= 2.0
    assert case.facts["most_alike"] <= 0.98


def test_a_written_case_is_read_as_it_was(tmp_path: Path) -> None:
    case = network_case("leak_to_boundary", 5, n_orbits=2, dt_s=120.0)
    save_case(case, tmp_path / "case.pickle", group="network")
    again, plain = read_case(tmp_path / "case.pickle")
    assert plain["group"] == "network" and plain["effects"] == ["leak_to_boundary"]
    assert (again.spec, again.truths, again.noise_K) == (case.spec, case.truths, case.noise_K)
    np.testing.assert_array_equal(again.truth_K, case.truth_K)
    assert all(np.array_equal(again.record.values[k], v) for k, v in case.record.values.items())


@pytest.mark.parametrize("about_K", [100.0, 500.0], ids=["up", "below 0 K"])
def test_a_heat_that_runs_away_ends_with_its_reason(about_K: float) -> None:
    """A gain that feeds itself grows without end: the integrator would take ever smaller steps."""
    own = world()

    def heat(t: float, k: int, state: np.ndarray) -> np.ndarray:
        return 20.0 * (state[: own.n] - about_K)

    with pytest.raises(ArithmeticError, match=r"leaves 0 to 1000 K by .* s: what is hidden runs away"):
        states(Hidden({}, heat))
