"""Radiation between nodes, nodes that store nothing, one-way conductors, heaters, formulas and known tables.

The oracle is the heat balance written down once more and integrated by scipy; derivatives are checked by differences.
"""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.helpers import central_difference
from twin_core._typing import FloatArray
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4 as SIGMA
from twin_core.errors import SpecError
from twin_core.network.formula import channels_of, evaluate
from twin_core.network.model import build_network
from twin_core.network.spec_io import dump_spec, load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.response import sensitivities
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

EPOCH_NS = 1_500_000_000_000_000_000
START_K = {"box": 290.0, "skin": 270.0, "dish": 250.0, "fluid": 300.0}


def data(**more: Any) -> dict[str, Any]:
    """A box in a skin of no capacity, a dish that only sees, a line of fluid that heats one way, two heaters."""
    return {
        "twin": "terms",
        "boundaries": {"space": {"value_K": 4.0}},
        "channels": {
            "T_box": {"kind": "temperature", "unit": "K"},
            "T_skin": {"kind": "temperature", "unit": "K"},
            "pitch": {"kind": "auxiliary"},
            "on": {"kind": "auxiliary", "levels": True},
        },
        "derived": {
            "lit": {"formula": "where(pitch > 60.0, 1.0, 0.5) * on"},
            "Q_days": {"formula": "10.0 + 2.0 * sin(days('2017-07-14T00:00:00Z'))", "unit": "W"},
        },
        "nodes": [
            {"id": "box", "sensor": "T_box", "capacity_J_per_K": {"guess": 900.0}},
            {"id": "skin", "sensor": "T_skin", "capacity_J_per_K": {"value": 0.0}},
            {"id": "dish", "capacity_J_per_K": {"value": 400.0, "scale": "size"}},
            {"id": "fluid", "capacity_J_per_K": {"value": 2000.0}},
        ],
        "conductors": [
            {"between": ["box", "skin"], "conductance_W_per_K": {"value": 0.3, "scale": "joints"}},
            {"between": ["box", "fluid"], "conductance_W_per_K": {"guess": 0.2}, "into": "box"},
            {"between": ["dish", "fluid"], "conductance_W_per_K": {"value": 0.05, "scale": "joints"}},
        ],
        "radiators": [{"node": "skin", "emissivity": 0.8, "area_m2": 0.05, "sink": "space"}],
        "radiation": [
            {"between": ["skin", "dish"], "area_m2": {"guess": 0.03}},
            {"between": ["box", "dish"], "area_m2": {"value": 0.02, "scale": "size"}},
            {"between": ["dish", "space"], "area_m2": {"guess": 0.04}},
        ],
        "heaters": [
            {"node": "box", "control": "dish", "proportional": {"set_K": 262.0, "gain_W_per_K": {"guess": 0.5}}},
            {
                "node": "fluid",
                "proportional": {"set_K": 300.0, "gain_W_per_K": {"guess": 0.7}, "most_W": {"guess": 6.0}},
            },
        ],
        "loads": [
            {
                "channel": "pitch",
                "node": "skin",
                "factor": "lit",
                "table": {"knots": [40, 80, 120], "values_W": [2, 9, 1]},
            },
            {
                "channel": "pitch",
                "node": "dish",
                "table": {"knots": [40, 120], "guess_W": [3.0, -1.0], "spread_W": 1.0},
            },
            {"channel": "Q_days", "node": "box", "factor": "on", "gain": {"guess": 0.4}},
        ],
        "parameters": {"joints": {"guess": 1.2}, "size": {"guess": 0.9}},
        **more,
    }


def record() -> Record:
    time_s = np.arange(0.0, 12_000.0, 60.0)
    pitch = 80.0 + 40.0 * np.sin(time_s / 1500.0)
    on = (time_s % 4000.0 > 1500.0).astype(np.float64)
    return Record(time_s, {"T_box": time_s * np.nan, "T_skin": time_s * np.nan, "pitch": pitch, "on": on}, EPOCH_NS)


def _truth(telemetry: Record) -> FloatArray:
    """Integrate the balance as it is declared, the skin solved for at every moment; step by step, as inputs jump."""
    time_s = telemetry.time_s

    def skin_K(box: float, dish: float, heat: float) -> float:
        low, high = 1.0, 1000.0
        for _ in range(200):
            x = 0.5 * (low + high)
            net = heat + 0.36 * (box - x) + SIGMA * 0.04 * (4.0**4 - x**4) + SIGMA * 0.03 * (dish**4 - x**4)
            low, high = (x, high) if net > 0 else (low, x)
        return 0.5 * (low + high)

    def heats(t: float, k: int) -> tuple[float, float, float]:
        pitch = float(np.interp(t, time_s, telemetry.values["pitch"]))
        on = telemetry.values["on"][k]
        # a formula is linear between the ends of a step, as other inputs are, and a table over it is its value there
        ends = telemetry.values["pitch"][[k, k + 1]]
        lit = np.interp(t, time_s[[k, k + 1]], np.where(ends > 60.0, 1.0, 0.5) * on)
        day = (t + EPOCH_NS / 1e9 - 1_499_990_400.0) / 86_400.0
        return (
            float(np.interp(pitch, [40, 80, 120], [2, 9, 1]) * lit),
            3.0 - 4.0 * np.clip((pitch - 40) / 80, 0, 1),
            float(0.4 * on * (10.0 + 2.0 * np.sin(day))),
        )

    def rates(t: float, y: FloatArray, k: int) -> list[float]:
        box, dish, fluid = y
        into_skin, into_dish, into_box = heats(t, k)
        skin = skin_K(box, dish, into_skin)
        exchanged = SIGMA * 0.018 * (dish**4 - box**4)
        box_W = into_box + 0.36 * (skin - box) + 0.2 * (fluid - box) + exchanged + 0.5 * max(262.0 - dish, 0.0)
        dish_W = (
            into_dish
            + 0.06 * (fluid - dish)
            - exchanged
            + SIGMA * (0.03 * (skin**4 - dish**4) + 0.04 * (4.0**4 - dish**4))
        )
        fluid_W = 0.06 * (dish - fluid) + min(6.0, 0.7 * max(300.0 - fluid, 0.0))
        return [box_W / 900.0, dish_W / 360.0, fluid_W / 2000.0]

    state, out = np.array([290.0, 250.0, 300.0]), []
    for k in range(time_s.size - 1):
        solution = solve_ivp(rates, time_s[[k, k + 1]], state, args=(k,), rtol=1e-9, atol=1e-9)
        state = solution.y[:, -1]
        out.append([state[0], skin_K(state[0], state[1], heats(time_s[k + 1], k)[0]), state[1], state[2]])
    return np.array(out)


def test_the_rollout_follows_the_balance_written_down() -> None:
    network, telemetry = build_network(load_spec(data())), record()
    errors = []
    for step_s in (30.0, 10.0):
        forcing = build_forcing(network, telemetry, step_s)
        path = rollout(network, network.parameters.values, np.array(list(START_K.values())), forcing)
        assert path.converged
        errors.append(np.abs(path.at_samples(forcing.sample_step)[1:] - _truth(telemetry)).max(axis=0))
    assert errors[1].max() < 0.01, errors


def test_sensitivities_are_exact() -> None:
    network, telemetry = build_network(load_spec(data())), record()
    forcing = build_forcing(network, telemetry, 60.0)
    parameters, start = network.parameters, np.array(list(START_K.values()))
    path = rollout(network, parameters.values, start, forcing)
    columns = np.zeros((4, parameters.free.size))
    blocks = sensitivities(network, parameters.values, forcing, path, columns, np.arange(4))
    found = np.concatenate([block for _, block in blocks])
    assert {"joints", "size", "R:skin|dish", "G:fluid>box", "heater:box<dish.k"} <= set(parameters.free_names)
    for k, name in enumerate(parameters.free_names):

        def read(x: float, k: int = k) -> FloatArray:
            free = parameters.free + x * (np.arange(parameters.free.size) == k)
            return rollout(network, parameters.to_values(free), start, forcing).at_samples(forcing.sample_step)

        expected = central_difference(read, 0.0, 1e-3)
        # A quotient over steps of 1e-3 has the rounding of 300 K a thousandfold, which adds up over the samples as a random walk.
        rounding = np.sqrt(expected.shape[0]) * np.spacing(300.0)
        atol = 2e-5 * float(np.abs(expected).max()) + 1e3 * rounding
        np.testing.assert_allclose(found[:, :, k], expected, atol=atol, err_msg=name)


def test_a_thermostat_keeps_its_band() -> None:
    heaters = [{"node": "box", "thermostat": {"on_K": 280.0, "off_K": 285.0, "power_W": {"value": 40.0}}}]
    network = build_network(load_spec(data(heaters=heaters)))
    forcing = build_forcing(network, record(), 60.0)
    start = np.array([*START_K.values(), 290.0])
    path = rollout(network, network.parameters.values, start, forcing)
    box = path.at_samples(forcing.sample_step)[:, 0]
    assert path.converged
    reached = box[np.argmax(box < 281.0) :]
    assert 279.0 < reached.min() and reached.max() < 288.0
    assert (np.diff(np.sign(np.diff(reached))) != 0).sum() > 3, "it switches again and again"


def test_it_survives_a_round_trip() -> None:
    spec = load_spec(data())
    assert load_spec(dump_spec(spec)) == spec


def test_formulas() -> None:
    assert set(channels_of("where(pitch > 60, sin(radians(a)), b) * days('2020-01-01T00:00:00Z')")) == {
        "pitch",
        "a",
        "b",
    }
    found = evaluate(
        "max(a, 2.0) ** 2 + (b == 1) * -3", {"a": np.array([1.0, 3.0]), "b": np.array([1.0, 0.0])}, np.zeros(2)
    )
    np.testing.assert_allclose(found, [1.0, 9.0])


@pytest.mark.parametrize(
    "formula",
    [
        "__import__('os')",
        "a.b",
        "a[0]",
        "lambda: 1",
        "days(pitch)",
        "days('soon')",
        "min(a)",
        "1e999",
        "",
        "f'x'",
        "sin(a, b=1)",
    ],
)
def test_a_formula_is_arithmetic_only(formula: str) -> None:
    with pytest.raises(SpecError, match="formula"):
        load_spec(data(derived={"lit": {"formula": formula}, "Q_days": {"formula": "1", "unit": "W"}}))


WRONG = {
    "radiation.0.between twice": ({"radiation": [{"between": ["skin", "space"], "area_m2": {"value": 1.0}}]}, "radiate twice"),
    "into a boundary": ({"conductors": [{"between": ["box", "space"], "into": "space"}]}, "which nothing heats"),
    "unknown end": ({"radiation": [{"between": ["box", "moon"], "area_m2": {"value": 1.0}}]}, "'moon'"),
    "two laws": ({"heaters": [{"node": "box"}]}, "exactly one of 'thermostat' and 'proportional'"),
    "thermostat of another node": (
        {
            "heaters": [
                {"node": "box", "control": "skin", "thermostat": {"on_K": 280, "off_K": 285, "power_W": {"value": 1.0}}}
            ]
        },
        "heaters[0].control: a thermostat is switched by the node that it heats",
    ),
    "thermostat's band": (
        {"heaters": [{"node": "box", "thermostat": {"on_K": 290.0, "off_K": 280.0, "power_W": {"value": 1.0}}}]},
        "on_K must lie below off_K",
    ),
    "formula of a temperature": (
        {"derived": {"lit": {"formula": "T_box"}, "Q_days": {"formula": "1", "unit": "W"}}},
        "is a temperature",
    ),
    "values without knots": (
        {"loads": [{"channel": "pitch", "node": "box", "table": {"knots": [1, 2], "values_W": [1]}}]},
        "1 values for 2 knots",
    ),
    "scale of a guess": (
        {"radiation": [{"between": ["skin", "dish"], "area_m2": {"guess": 1.0, "scale": "size"}}]},
        "give the 'value'",
    ),
}  # fmt: skip


@pytest.mark.parametrize("change, said", WRONG.values(), ids=list(WRONG))
def test_what_cannot_be_is_refused(change: dict[str, Any], said: str) -> None:
    with pytest.raises(SpecError) as error:
        load_spec(data(**change))
    assert any(said in line for line in error.value.problems)
