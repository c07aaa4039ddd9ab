"""Where a calibration starts: levels, interpolated temperatures, and the order of magnitude of what nobody guessed."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.starts import attempt
from tests.analytic import laplacian, linear_states
from tests.helpers import conductive_spec, record_of
from twin_core.calibrate import calibrate
from twin_core.calibrate.multistart import unguessed
from twin_core.calibrate.problem import build_problem
from twin_core.calibrate.starting import balance_start, channel_levels, filled_columns
from twin_core.network.model import build_network
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.parameters.parameter import NO_GUESS_LOG_STD, positive, real
from twin_core.parameters.vector import ParameterSet
from twin_core.telemetry import Record
from twin_core.telemetry_csv import read_csv


def test_levels_are_where_a_channel_rests() -> None:
    rng = np.random.default_rng(0)
    states = np.repeat(rng.choice([0.0, 5.0, 6.0], 60), 20)
    slewing = states.copy()
    slewing[::97] = rng.uniform(1.0, 4.0, slewing[::97].size)
    record = record_of(np.arange(1200.0), mode=slewing + rng.normal(0.0, 1e-3, 1200))
    np.testing.assert_allclose(channel_levels([record], "mode"), [0.0, 5.0, 6.0], atol=1e-2)


@pytest.mark.parametrize(
    ("column", "expected"), [([3.0] * 9, (3.0,)), ([np.nan] * 9, ()), ([1.0, 2.0] * 8, (1.0, 2.0))]
)
def test_levels_of_simple_channels(column: list[float], expected: tuple[float, ...]) -> None:
    assert channel_levels([record_of(np.arange(float(len(column))), mode=np.array(column))], "mode") == expected


def test_levels_are_gathered_from_all_records() -> None:
    parts = [record_of(np.arange(20.0), mode=2.0), record_of(np.arange(20.0), mode=1.0), record_of(np.arange(5.0))]
    assert channel_levels(parts, "mode") == (1.0, 2.0)


def chain_network(**fields: object) -> dict:
    power = {"kind": "power", "unit": "W"}
    data = conductive_spec(3, [(0, 1), (1, 2)], channels={"Q": power}, loads=[{"channel": "Q", "node": "n0"}], **fields)
    for row in data["nodes"]:
        del row["capacity_J_per_K"]
    for row in data["conductors"]:
        del row["conductance_W_per_K"]
    return data


def test_gaps_are_bridged_and_hidden_states_follow_their_neighbours() -> None:
    data = chain_network()
    del data["nodes"][1]["sensor"], data["channels"]["T1"]
    network = build_network(load_spec(data))
    measured = np.array([[280.0, 290.0], [np.nan, 292.0], [284.0, np.nan]])
    filled = filled_columns(network, np.array([0.0, 1.0, 2.0]), measured, None)
    np.testing.assert_allclose(filled[:, 0], [280.0, 282.0, 284.0])
    np.testing.assert_allclose(filled[:, 2], [290.0, 292.0, 292.0])
    np.testing.assert_allclose(filled[:, 1], 0.5 * (filled[:, 0] + filled[:, 2]))
    held = filled_columns(network, np.array([0.0, 1.0, 2.0]), measured, np.array([1.0, 277.0, 3.0]))
    np.testing.assert_array_equal(held[:, 1], 277.0)


def chain_telemetry() -> tuple[Record, dict[str, float]]:
    """Return ten hours of a heated chain of three nodes with a noise of 0.02 K, and its parameters."""
    capacity, conductance = np.array([4.0e3, 2.0e4, 900.0]), [5.0, 0.4]
    rng = np.random.default_rng(3)
    time_s = 60.0 * np.arange(600)
    heat = np.repeat(rng.choice([0.0, 50.0], 60), 10)
    rates = -laplacian(3, [(0, 1), (1, 2)], conductance) / capacity[:, None]
    states = linear_states(rates, np.outer(heat, [1.0 / capacity[0], 0.0, 0.0]), np.full(3, 290.0), time_s)
    readings = {f"T{i}": states[:, i] + rng.normal(0, 0.02, 600) for i in range(3)}
    truth = {f"C:n{i}": c for i, c in enumerate(capacity)} | {"G:n0|n1": 5.0, "G:n1|n2": 0.4}
    return record_of(time_s, Q=heat, **readings), truth


def test_integrated_balances_give_the_order_of_magnitude() -> None:
    record, truth = chain_telemetry()
    problem = build_problem(build_network(load_spec(chain_network())), [record], np.full(3, 0.02))
    found = balance_start(problem).as_dict()
    for name, value in truth.items():
        assert abs(np.log(found[name] / value)) < np.log(3.0), name


def test_declared_guesses_are_kept() -> None:
    network = build_network(load_spec(conductive_spec(2, [(0, 1)])))
    record = record_of(60.0 * np.arange(30), T0=290.0, T1=280.0)
    assert balance_start(build_problem(network, [record], np.ones(2))) == network.parameters


def heated_board(scale: float, **load: object) -> tuple[TwinSpec, Record]:
    """Return a board of 5 J/K behind a loss of 0.05 W/K, both times ``scale``, of which nothing is declared but a load.

    The heater's channel is in percent of 3 W times ``scale``.
    """
    data = {
        "twin": "board",
        "boundaries": {"room": {"value_K": 295.0}},
        "channels": {"T": {"kind": "temperature", "unit": "K"}, "H": {"kind": "power", "unit": "percent"}},
        "nodes": [{"id": "board", "sensor": "T"}],
        "conductors": [{"between": ["board", "room"]}],
        "loads": [{"channel": "H", "node": "board"} | load],
    }
    time_s = 2.0 * np.arange(400)
    heater = np.repeat([0.0, 100.0, 40.0, 80.0, 0.0, 60.0, 20.0, 100.0], 50)
    rise = linear_states(np.array([[-0.01]]), (0.006 * heater)[:, None], np.zeros(1), time_s)[:, 0]
    noisy = 295.0 + rise + np.random.default_rng(5).normal(0.0, 0.05, 400)
    return load_spec(data), record_of(time_s, T=noisy, H=heater)


@pytest.mark.parametrize("scale", [1e-5, 1.0, 1e5])
def test_a_guessed_gain_sets_the_scale(scale: float) -> None:
    """The balance is homogeneous: least squares would shrink capacity and loss to nothing while the gain stays."""
    spec, record = heated_board(scale, gain={"guess": 0.03 * scale})
    found = balance_start(build_problem(build_network(spec), [record], np.full(1, 0.05))).as_dict()
    assert 0.5 < found["C:board"] / (5.0 * scale) < 2.0
    assert 0.5 < found["G:board|room"] / (0.05 * scale) < 2.0
    assert found["gain:H|board"] == 0.03 * scale


def test_without_any_scale_the_ratios_are_found() -> None:
    spec, record = heated_board(1.0)
    model = calibrate(spec, [record])
    assert abs(np.log(model.values["C:board"] / model.values["G:board|room"] / 100.0)) < 0.05
    assert abs(np.log(model.values["C:board"] / model.values["gain:H|board"] * 0.03 / 5.0)) < 0.05
    assert model.summary["rmse_K"] < 1.05 * 0.05


@pytest.mark.parametrize("seed", range(12))
def test_random_networks_are_found_from_any_subset_of_guesses(seed: int) -> None:
    """Power over ten decades, 2 to 7 nodes; the truth is integrated by Runge and Kutta's method. All 500: benchmarks.starts."""
    case, outcome = attempt(1000 + seed)
    assert outcome.found, (case.kind, outcome)


@pytest.mark.parametrize("off", [1e-3, 30.0, 1e3])
def test_guesses_that_are_wrong_by_far_do_not_hold_the_fit(off: float) -> None:
    """Far from the telemetry the misfit counts as noise, so that the priors of wrong guesses held the search where it began."""
    record, truth = chain_telemetry()
    data = chain_network()
    for i, row in enumerate([*data["nodes"], *data["conductors"]]):
        quantity = "capacity_J_per_K" if "id" in row else "conductance_W_per_K"
        row[quantity] = {"guess": list(truth.values())[i] * off ** (-1.0) ** i}
    model = calibrate(load_spec(data), [record])
    assert model.summary["rmse_K"] < 1.1 * 0.02
    for name, value in truth.items():
        assert abs(np.log(model.values[name] / value)) < 0.1, name


def test_a_fit_without_guesses_keeps_what_is_stated_beside_them() -> None:
    parameters = ParameterSet(
        (
            positive("C:free", "J/K", 5.0),
            positive("C:known", "J/K", 5.0, frozen=True),
            positive("C:spread", "J/K", 5.0, prior_std=0.1),
            real("Q", "W", 5.0, prior_std=1.0),
        )
    )
    free, *kept = unguessed(parameters).parameters
    assert (free.guessed, free.prior_std) == (True, NO_GUESS_LOG_STD)
    assert tuple(kept) == parameters.parameters[1:]


TEMPERATURE_LAB = Path(__file__).resolve().parents[4] / "shared" / "data" / "tclab_notre_dame"


@pytest.mark.skipif(not TEMPERATURE_LAB.is_dir(), reason="the temperature lab's runs are not here")
@pytest.mark.parametrize("run", ["step50_run1", "sine300s_run2", "sine50s_run3"])
def test_the_temperature_lab_starts_from_a_guessed_gain_alone(run: str) -> None:
    spec = load_spec(
        {
            "twin": "lab",
            "boundaries": {"room": {"guess_K": 296.0}},
            "channels": {
                "T1_degC": {"kind": "temperature", "unit": "degC"},
                "T2_degC": {"kind": "temperature", "unit": "degC"},
                "Q1_percent": {"kind": "power", "unit": "percent"},
            },
            "nodes": [{"id": "a", "sensor": "T1_degC"}, {"id": "b", "sensor": "T2_degC"}],
            "conductors": [{"between": pair} for pair in (["a", "b"], ["a", "room"], ["b", "room"])],
            "loads": [{"channel": "Q1_percent", "node": "a", "gain": {"guess": 0.032}}],
        }
    )
    model = calibrate(spec, [read_csv(TEMPERATURE_LAB / f"{run}.csv", spec)])
    gain = model.values["gain:Q1_percent|a"]
    assert abs(np.log(gain / 0.032)) < 1.0  # the guess sets the scale, within its spread
    assert 0.5 < model.values["C:a"] / gain / (6.0 / 0.032) < 2.0  # published: 6 J/K at 0.032 W/%
    assert 0.5 < model.values["G:a|room"] / gain / (0.042 / 0.032) < 2.0  # published: 0.042 W/K


def test_a_coupling_that_no_temperature_drives_disturbs_no_balance() -> None:
    """A hidden node hangs on a chain of large heats, so that it reads as its neighbour: their coupling tells nothing.

    Warnings are errors: nothing may overflow. The chain starts where it would, the coupling at what nobody guessed.
    """
    data = chain_network()
    data["nodes"].append({"id": "pocket", "capacity_J_per_K": {"guess": 3e9}})
    data["conductors"].append({"between": ["n2", "pocket"]})
    capacity, conductance = np.full(3, 1e10), [2e7, 3e7]
    time_s = 60.0 * np.arange(200.0)
    heat = np.repeat(np.random.default_rng(2).choice([0.0, 3e8], 20), 10)
    rates = -laplacian(3, [(0, 1), (1, 2)], conductance) / capacity[:, None]
    read = linear_states(rates, np.outer(heat, [1.0 / capacity[0], 0.0, 0.0]), np.full(3, 280.0), time_s)
    record = record_of(time_s, Q=heat, **{f"T{k}": read[:, k] for k in range(3)})
    found = balance_start(build_problem(build_network(load_spec(data)), [record], np.full(3, 0.01))).as_dict()
    for name, value in {"C:n0": 1e10, "C:n1": 1e10, "G:n0|n1": 2e7, "G:n1|n2": 3e7}.items():
        assert abs(np.log(found[name] / value)) < np.log(3.0), name
    assert 0.0 < found["G:n2|pocket"] < np.inf
