"""A Xija model of our own, every family of component in it, against its equations in Xija's own units."""

import json
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from twin_core.constants import ZERO_CELSIUS_K
from twin_core.errors import SpecError
from twin_core.interchange.xija.specification import read_xija
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record
from twin_core.units import parse_instant_ns

PITCHES = [45.0, 90.0, 180.0]
POWERS = {"pow_0xxx": 10.0, "pow_6xx1": 90.0, "pow_xxxx": 50.0}
SOLAR = {"P_45": 1.0, "P_90": 0.3, "P_180": 0.8, "dP_45": 0.1, "dP_90": 0.0, "dP_180": -0.2}
ROLL = {"P_plus_y": 0.5, "P_minus_y": -1.5}


def model(**more: Any) -> dict[str, Any]:
    """Two nodes coupled both ways, one seen; sunlight, roll, electronics, heaters, a switch and a step."""

    def component(kind: str, name: str, *args: Any, **kwargs: Any) -> dict[str, Any]:
        return {"class_name": kind, "name": name, "init_args": list(args), "init_kwargs": kwargs}

    comps = [
        component("Node", "1box", "1box", quant=0.5),
        component("Node", "skin", "skin"),
        *(component(kind, name) for kind, name in (("Pitch", "pitch"), ("Roll", "roll"), ("Eclipse", "eclipse"))),
        component("SimZ", "sim_z"),
        component("Mask", "mask__1box_gt", "1box", "gt", 20.0),
        component("Coupling", "coupling__1box__skin", "1box", "skin", tau=20.0),
        component("Coupling", "coupling__skin__1box", "skin", "1box", tau=50.0),
        component("HeatSink", "heatsink__skin", "skin", T=-30.0, tau=12.0),
        component(
            "SolarHeat", "solarheat__skin", "skin", "pitch", "eclipse", PITCHES, epoch="2017:001", var_func="linear"
        ),
        component("SolarHeatHrcMult", "solarheat__1box", "1box", P_pitches=PITCHES, epoch="2017:001", var_func="exp"),
        component("SolarHeatOffNomRoll", "solarheat_off_nom_roll__skin", "skin", eclipse_comp="eclipse"),
        *(component("CmdStatesData", n, n) for n in ("fep_count", "ccd_count", "vid_board", "clocking")),
        component(
            "AcisDpaStatePower",
            "dpa_power",
            "1box",
            **{n: n for n in ("fep_count", "ccd_count", "vid_board", "clocking")},
        ),
        component("PropHeater", "prop_heat__1box", "1box"),
        component("StepFunctionPower", "step_power__skin", "skin", "2017:100:12:00:00"),
        component("MsidStatePower", "radio_on", "1box", "RADIO", "ON "),
    ]
    values = {
        "coupling__1box__skin": {"tau": 20.0},
        "coupling__skin__1box": {"tau": 50.0},
        "heatsink__skin": {"T": -30.0, "tau": 12.0},
        "solarheat__skin": SOLAR | {"tau": 400.0, "ampl": 0.05, "bias": 0.1},
        "solarheat__1box": SOLAR | {"tau": 500.0, "ampl": 0.03, "bias": 0.0, "hrci_bias": 0.2, "hrcs_bias": -0.1},
        "solarheat_off_nom_roll": ROLL,
        "dpa_power": POWERS | {"mult": 2.0, "bias": 5.0},
        "prop_heat__1box": {"k": 0.2, "T_set": 22.0},
        "step_power__skin": {"P": -0.4},
        "radio_on": {"P": 0.3},
    }
    pars = [{"full_name": f"{c}__{p}", "val": v, "frozen": False} for c, ps in values.items() for p, v in ps.items()]
    return {"name": "box", "comps": comps, "pars": pars, "dt": 328.0, "evolve_method": 2, "bad_times": [], **more}


def telemetry() -> Record:
    """Return one day of inputs around the step, each held from sample to sample."""
    rng = np.random.default_rng(3)
    time_s = np.arange(0.0, 86_400.0, 656.0)

    def held(choices: list[float]) -> np.ndarray:
        return np.repeat(rng.choice(choices, 1 + time_s.size // 12), 12)[: time_s.size]

    values = {
        "pitch": held([50.0, 95.0, 150.0]),
        "roll": held([-8.0, 0.5, 12.0]),
        "eclipse": held([0.0, 0.0, 1.0]),
        "sim_z": held([92904.0, -50504.0, -99616.0]),
        "fep_count": held([0.0, 4.0, 6.0]),
        "ccd_count": held([1.0, 6.0]),
        "vid_board": held([1.0]),
        "clocking": held([0.0, 1.0]),
        "radio_on": held([0.0, 1.0]),
    }
    return Record(time_s, values, parse_instant_ns("2017-04-10T00:00:00Z"))


def heats(record: Record, k: int, t: float) -> tuple[float, float]:
    """Return Xija's heats of both nodes in K/ks, as its components define them."""
    now = {name: float(column[k]) for name, column in record.values.items()}
    unix = record.epoch_s + t
    aged = (unix - parse_instant_ns("2017-01-01T12:00:00Z") / 1e9) / 86_400.0
    phase = 2.0 * np.pi * (unix - parse_instant_ns("2000-01-01T00:00:00Z") / 1e9) / 86_400.0 / 365.3
    power = np.interp(now["pitch"], PITCHES, [SOLAR[f"P_{p:.0f}"] for p in PITCHES])
    change = np.interp(now["pitch"], PITCHES, [SOLAR[f"dP_{p:.0f}"] for p in PITCHES])
    lit = 1.0 - now["eclipse"]
    skin = lit * (power + 0.1 + change * aged / 400.0 + 0.05 * np.cos(phase))
    box = (power + change * (1.0 - np.exp(-aged / 500.0))) * (1.0 + 0.03 * np.cos(phase))
    box += 0.2 if -86147.0 < now["sim_z"] < 0.0 else -0.1 if now["sim_z"] <= -86147.0 else 0.0
    sun_y = np.sin(np.radians(now["pitch"])) * np.sin(np.radians(now["roll"]))
    skin += lit * ROLL["P_plus_y" if sun_y > 0.0 else "P_minus_y"] * sun_y
    skin -= 0.4 * (unix >= parse_instant_ns("2017-04-10T12:00:00Z") / 1e9)
    state = "0xxx" if now["fep_count"] == 0 else "6xx1" if (now["fep_count"], now["clocking"]) == (6, 1) else "xxxx"
    box += 0.02 * (POWERS[f"pow_{state}"] - 5.0) + 0.3 * now["radio_on"]
    return box, skin


def test_the_imported_model_moves_as_xija_defines_it() -> None:
    imported = read_xija(json.dumps(model(), indent=1), "box.json", held=True)
    assert not imported.refused
    network, record = build_network(load_spec(imported.data)), telemetry()
    forcing = build_forcing(network, record, 60.0)
    start_C = np.array([18.0, 5.0])
    order = [network.nodes.index(name) for name in ("n1box", "skin")]
    start_K = np.empty(2)
    start_K[order] = start_C + ZERO_CELSIUS_K
    path = rollout(network, network.parameters.values, start_K, forcing)
    found = path.at_samples(forcing.sample_step)[:, order] - ZERO_CELSIUS_K

    def rates(t: float, y: np.ndarray, k: int) -> list[float]:
        box, skin = heats(record, k, t)
        heater = 0.2 * max(22.0 - y[0], 0.0)
        return [
            (box + heater - (y[0] - y[1]) / 20.0) / 1e3,
            (skin - (y[1] - y[0]) / 50.0 + (-30.0 - y[1]) / 12.0) / 1e3,
        ]

    state, expected = start_C, [start_C]
    for k, (begin, end) in enumerate(zip(record.time_s, record.time_s[1:], strict=False)):
        state = solve_ivp(rates, (begin, end), state, args=(k,), rtol=1e-9, atol=1e-9, max_step=60.0).y[:, -1]
        expected.append(state)
    np.testing.assert_allclose(found, np.array(expected), atol=0.01)
    assert np.ptp(found[:, 0]) > 5.0


def test_what_was_fitted_is_a_guess_unless_held() -> None:
    free = build_network(load_spec(read_xija(json.dumps(model()), "m").data)).parameters.free_names
    assert {"G:n1box|skin", "T:heatsink__skin", "gain:step_power__skin_P|skin", "heater:n1box.k"} <= set(free)
    held = build_network(load_spec(read_xija(json.dumps(model()), "m", held=True).data)).parameters.free_names
    assert not held


def test_the_first_way_to_integrate_counts_half_a_step_twice() -> None:
    """A step of y_0 + h f_0 / 2 + h f_1, iterated, against the imported model."""
    heatsink = [c for c in model()["comps"] if c["class_name"] in ("Node", "HeatSink")][1:]
    pars = [p for p in model()["pars"] if p["full_name"].startswith("heatsink")]
    imported = read_xija(json.dumps(model(comps=heatsink, pars=pars, evolve_method=1)), "m", held=True)
    network = build_network(load_spec(imported.data))
    time_s = np.arange(0.0, 30_000.0, 656.0)
    forcing = build_forcing(network, Record(time_s, {}, 0), 60.0)
    path = rollout(network, network.parameters.values, np.array([ZERO_CELSIUS_K + 20.0]), forcing)
    found = path.at_samples(forcing.sample_step)[:, 0] - ZERO_CELSIUS_K
    y, expected = 20.0, []
    for _ in time_s:
        expected.append(y)
        half = y + 0.656 * (-30.0 - y) / 12.0 / 2.0
        y = half + 0.656 * (-30.0 - half) / 12.0
    np.testing.assert_allclose(found, expected, atol=0.02)


def test_measured_power_and_constants_stand_for_components() -> None:
    imported = read_xija(
        json.dumps(model()),
        "m",
        channels={"dpa_power": "P_W", "1box": "T_box"},
        constants={"eclipse": 0.0},
        hidden=["skin"],
    )
    spec = load_spec(imported.data)
    assert spec.sensors == ("T_box",)
    assert (
        {"P_W", "T_box"} <= set(spec.channels) and "eclipse" not in spec.channels and "fep_count" not in spec.channels
    )
    assert any("fep_count" in note for note in imported.notes)


def test_an_unknown_component_is_one_line_with_its_place() -> None:
    comps = [*model()["comps"], {"class_name": "TidalHeat", "name": "tide", "init_args": [], "init_kwargs": {}}]
    text = json.dumps(model(comps=comps), indent=1)
    (line,) = read_xija(text, "moon.json").refused
    number = 1 + text[: text.index("TidalHeat")].count("\n")
    assert line == f"moon.json: line {number}: TidalHeat 'tide' is not a component that can be translated"


def changed(kind: str, **members: Any) -> dict[str, Any]:
    """Return the model with the first component of a class changed."""
    whole = model()
    next(c for c in whole["comps"] if c["class_name"] == kind).update(members)
    return whole


WRONG = {
    "no P_90": (
        model(pars=[p for p in model()["pars"] if p["full_name"] != "solarheat__skin__P_90"]),
        "parameter P_90",
    ),
    "no nodes": (changed("Coupling", init_args=[]), "does not name two nodes and a positive tau"),
    "surplus": (changed("Coupling", init_kwargs={"tau": 20.0, "tau_2": 3.0}), "the argument 'tau_2'"),
    "no tau": (
        model(pars=[p | {"val": 0.0} if p["full_name"].endswith("__tau") else p for p in model()["pars"]]),
        "has a tau of 0",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_components_that_lack_what_they_need_are_refused_by_name(case: str) -> None:
    data, said = WRONG[case]
    assert any(said in line for line in read_xija(json.dumps(data), "m.json").refused)


@pytest.mark.parametrize(
    "wrong", [{"pars": [{"full_name": "x"}]}, {"pars": [{"full_name": "a__b", "val": "warm"}]}, {"dt": None}]
)
def test_numbers_that_are_none_are_told_with_the_file(wrong: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match=r"m\.json: "):
        read_xija(json.dumps(model(**{"evolve_method": 1} | wrong)), "m.json")


@pytest.mark.parametrize("text", ["[]", "{", '{"comps": 3}', '{"comps": [3]}'])
def test_what_is_no_model_is_refused(text: str) -> None:
    with pytest.raises(SpecError, match=r"m\.json"):
        read_xija(text, "m.json")


def test_a_name_that_is_no_component_is_refused() -> None:
    with pytest.raises(SpecError, match="no component 'pich'"):
        read_xija(json.dumps(model()), "m.json", channels={"pich": "pitch_deg"})


@pytest.mark.parametrize("power", [0.5, 2.0])
def test_a_thermostat_without_a_deadband_holds_its_node_where_it_can(power: float) -> None:
    """The node rises to where losses and power balance, T_sink + P tau, and stays at T_set if that is on the way."""
    tau_ks, sink_C, set_C = 20.0, -10.0, 15.0

    def component(kind: str, name: str, **kwargs: Any) -> dict[str, Any]:
        return {"class_name": kind, "name": name, "init_args": ["box"], "init_kwargs": kwargs}

    comps = [
        component("Node", "box"),
        component("HeatSink", "heatsink__box", T=sink_C, tau=tau_ks),
        component("ThermostatHeater", "thermostat_heat__box", P=power, T_set=set_C),
    ]
    imported = read_xija(json.dumps({"name": "t", "comps": comps, "pars": [], "evolve_method": 2}), "t.json", held=True)
    assert not imported.refused and any("no deadband" in note for note in imported.notes)
    network = build_network(load_spec(imported.data))
    time_s = np.arange(0.0, 120_000.0, 300.0)
    forcing = build_forcing(network, Record(time_s, {"T_box": np.full(time_s.size, 273.15)}), 300.0)
    path = rollout(network, network.parameters.values, np.array([sink_C + ZERO_CELSIUS_K]), forcing)
    found_C = path.at_samples(forcing.sample_step)[:, 0] - ZERO_CELSIUS_K
    expected = np.minimum(sink_C + power * tau_ks * -np.expm1(-time_s / (1000.0 * tau_ks)), set_C)
    np.testing.assert_allclose(found_C, expected, atol=0.06)
