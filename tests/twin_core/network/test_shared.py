"""Shared unknowns and stated guesses: the chain rule against central differences, priors, and what a fit reports."""

import json
from typing import Any

import numpy as np
import pytest

from tests.analytic import laplacian, linear_states
from tests.helpers import central_difference, record_of
from twin_core.calibrate import calibrate
from twin_core.calibrate.criteria import acceptance
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.second_order import fit_network
from twin_core.calibrate.summary import to_model
from twin_core.effects import REGISTRY
from twin_core.errors import ModelError
from twin_core.network.model import Network, build_network
from twin_core.network.spec_io import dump_spec, load_spec
from twin_core.parameters.parameter import GUESS_LOG_STD
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.response import sensitivities
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

AREAS_M2, MASSES_KG = (0.03, 0.02, 0.01), (1.5, 0.7, 0.25)
FILM, HEAT = 7.0, 900.0
ROOM_K, POWER_W = 293.0, 10.0


def data(**more: Any) -> dict[str, Any]:
    """Three blocks in a row, a heater on the first, one film coefficient and one specific heat."""
    nodes = [
        {"id": f"b{i}", "sensor": f"T{i}", "capacity_J_per_K": {"per_mass": "cp", "mass_kg": m}}
        for i, m in enumerate(MASSES_KG)
    ]
    film = [
        {"between": [f"b{i}", "room"], "conductance_W_per_K": {"per_area": "h", "area_m2": a}}
        for i, a in enumerate(AREAS_M2)
    ]
    joints = [{"between": [f"b{i}", f"b{i + 1}"], "conductance_W_per_K": {"guess": 0.5}} for i in range(2)]
    return {
        "twin": "blocks",
        "boundaries": {"room": {"value_K": ROOM_K}},
        "channels": {f"T{i}": {"kind": "temperature", "unit": "K"} for i in range(3)}
        | {"Q": {"kind": "power", "unit": "W"}},
        "parameters": {"h": {"guess": 10.0, "spread": 2.0}, "cp": {"guess": 600.0}},
        "nodes": nodes,
        "conductors": [*joints, *film],
        "loads": [{"channel": "Q", "node": "b0"}],
        **more,
    }


def truth(noise_K: float = 0.01) -> Record:
    """Return the closed form of the blocks with noise."""
    time_s = np.arange(0.0, 9000.0, 30.0)
    capacity = HEAT * np.array(MASSES_KG)
    matrix = -laplacian(3, [(0, 1), (1, 2)], [0.6, 0.3]) - np.diag(FILM * np.array(AREAS_M2))
    drive = FILM * np.array(AREAS_M2) * ROOM_K + np.array([POWER_W, 0.0, 0.0])
    states = linear_states(
        matrix / capacity[:, None], np.tile(drive / capacity, (time_s.size, 1)), np.full(3, ROOM_K), time_s
    )
    read = states + np.random.default_rng(0).normal(0.0, noise_K, states.shape)
    return record_of(time_s, Q=POWER_W, **{f"T{i}": read[:, i] for i in range(3)})


def network_of(*effects: Any) -> Network:
    return build_network(load_spec(data()), effects)


def test_tied_quantities_follow_the_shared_unknown() -> None:
    parameters = network_of().parameters
    assert set(parameters.free_names) == {"h", "cp", "G:b0|b1", "G:b1|b2"}
    moved = parameters.updated({"h": FILM, "G:b0|room": 99.0}).as_dict()
    assert [moved[f"G:b{i}|room"] for i in range(3)] == pytest.approx([FILM * a for a in AREAS_M2])
    free = parameters.free + 0.3
    values = dict(zip(parameters.index, parameters.to_values(free), strict=True))
    assert [values[f"C:b{i}"] for i in range(3)] == pytest.approx([values["cp"] * m for m in MASSES_KG])
    assert {p.name: p.unit for p in parameters.parameters}["h"] == "W/m2/K"
    assert {p.name: p.unit for p in parameters.parameters}["cp"] == "J/kg/K"


EFFECTS = {
    "alone": (),
    "borrowed": (
        REGISTRY["conductance_temperature"]({"nodes": ["b1", "room"]}, {"beta_per_K": 0.05}, {"T_ref_K": 290.0}),
        REGISTRY["capacity_temperature"]({"node": "b0"}, {"kappa_per_K": 0.01}, {"T_ref_K": 295.0}),
    ),
}


@pytest.mark.parametrize("effects", EFFECTS.values(), ids=list(EFFECTS))
def test_sensitivities_follow_the_chain_rule(effects: tuple[Any, ...]) -> None:
    """Also where an effect borrows a tied conductance or capacity."""
    network = network_of(*effects)
    forcing = build_forcing(network, truth(), 60.0)
    parameters, start = network.parameters, np.array([300.0, 296.0, 294.0])
    path = rollout(network, parameters.values, start, forcing)
    columns = np.zeros((3, parameters.free.size))
    blocks = sensitivities(network, parameters.values, forcing, path, columns, np.arange(3))
    found = np.concatenate([block for _, block in blocks])
    for k, name in enumerate(parameters.free_names):

        def read(x: float, k: int = k) -> np.ndarray:
            free = parameters.free + x * (np.arange(parameters.free.size) == k)
            return rollout(network, parameters.to_values(free), start, forcing).at_samples(forcing.sample_step)

        expected = central_difference(read, 0.0, 1e-3)
        scale = float(np.abs(expected).max())
        np.testing.assert_allclose(found[:, :, k], expected, atol=1e-6 * scale, err_msg=name)


def test_a_fit_finds_the_shared_unknowns_and_reports_them() -> None:
    spec = load_spec(data(criteria={"std_K": 0.5, "per_sensor": {"T1": {"bias_K": 1e-9}}}))
    _, calibration = fit_network(spec, [truth()])
    model = to_model(calibration, [])
    rows = {row["name"]: row for row in model.summary["parameters"] if not row["held"]}
    assert set(rows) == {"h", "cp", "G:b0|b1", "G:b1|b2"}
    for name, value in {"h": FILM, "cp": HEAT}.items():
        assert abs(rows[name]["mean"] - value) < 4.0 * rows[name]["std"] + 1e-3 * value
        assert rows[name]["std"] < 0.02 * value
    again = CalibratedModel.from_json(json.loads(json.dumps(model.to_json())))
    assert again.values == model.values
    assert again.network().parameters.as_dict() == model.network().parameters.as_dict()
    assert {s: row["met"] for s, row in model.summary["per_sensor"].items()} == {"T0": True, "T1": False, "T2": True}
    assert model.summary["criteria"]["met"] is False
    assert model.summary["criteria"]["per_sensor"]["T1"] == {
        "limit_bias_K": 1e-9,
        "limit_std_K": 0.5,
        "limit_q99_abs_K": 5.0,
        "met": False,
    }


def test_a_balance_start_knows_the_ties() -> None:
    """Joints that nobody guessed are started from heat balances in which the film is one unknown."""
    joints = [{"between": [f"b{i}", f"b{i + 1}"]} for i in range(2)]
    spec = load_spec(data(conductors=[*joints, *data()["conductors"][2:]]))
    _, calibration = fit_network(spec, [truth()])
    found = calibration.network.parameters.as_dict()
    assert found["h"] == pytest.approx(FILM, rel=0.03)
    assert found["G:b0|b1"] == pytest.approx(0.6, rel=0.03)


def test_criteria_of_a_sensor_replace_those_of_all() -> None:
    spec = load_spec(data(criteria={"bias_K": 1.0, "std_K": 2.0, "per_sensor": {"T0": {"std_K": 0.1}}}))
    row = {"bias_K": -0.4, "std_K": 0.3, "q99_abs_K": 1.0}
    told = acceptance(spec, {"T0": row, "T1": row})
    assert (told["per_sensor"]["T0"]["met"], told["per_sensor"]["T1"]["met"], told["met"]) == (False, True, False)
    assert told["bias_K"] == 0.4 and told["limit_std_K"] == 2.0


def test_a_spread_is_one_standard_deviation_of_the_prior() -> None:
    joint = {"between": ["b0", "b1"], "conductance_W_per_K": {"guess": 0.5, "spread": 3.0}}
    bounded = {"between": ["b1", "b2"], "conductance_W_per_K": {"guess": 0.5, "spread": 1.1, "bounds": [0.1, 4.0]}}
    parameters = {
        p.name: p
        for p in build_network(
            load_spec(data(conductors=[joint, bounded, *data()["conductors"][2:]]))
        ).parameters.parameters
    }
    assert parameters["h"].prior_std == pytest.approx(np.log(2.0))
    assert parameters["cp"].prior_std == GUESS_LOG_STD
    assert parameters["G:b0|b1"].prior_std == pytest.approx(np.log(3.0))
    within = parameters["G:b1|b2"]
    step = 0.01 * (within.prior_std or 0.0)
    assert within.transform.to_value(within.free + step) / 0.5 == pytest.approx(1.1**0.01, rel=1e-4)


def test_a_sink_has_its_spread_in_kelvin() -> None:
    for given, expected in (({"guess_K": 280.0, "spread": 3.0}, 3.0), ({"guess_K": 280.0}, 50.0)):
        network = build_network(load_spec(data(boundaries={"room": given})))
        (sink,) = [p for p in network.parameters.parameters if p.name == "T:room"]
        assert sink.prior_std == expected


def test_a_known_shared_value_is_held() -> None:
    parameters = build_network(load_spec(data(parameters={"h": {"value": 5.0}, "cp": {"guess": 600.0}}))).parameters
    assert "h" not in parameters.free_names
    assert parameters.as_dict()["G:b0|room"] == pytest.approx(5.0 * AREAS_M2[0])


def test_the_method_that_cannot_share_says_so() -> None:
    with pytest.raises(ModelError, match="is shared, which this method cannot do"):
        calibrate(load_spec(data()), [truth()], method="neural-ode")


def test_limits_and_ties_survive_being_written_down() -> None:
    described = data()
    described["channels"]["T0"]["limits"] = {"yellow": [None, 320.0], "red": [250, 330]}
    spec = load_spec(described)
    assert load_spec(json.loads(json.dumps(dump_spec(spec)))) == spec
    limits = spec.channels["T0"].limits
    assert limits is not None and limits.yellow == (None, 320.0) and limits.red == (250.0, 330.0)
