"""Common mistakes of a declaration, made on a small satellite one by one: each is told."""

from collections.abc import Callable
from copy import deepcopy
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.helpers import record_of
from twin_core.calibrate import calibrate, suspicions
from twin_core.calibrate.containment import TimeIsUpError, check_time, limited
from twin_core.calibrate.problem import build_problem
from twin_core.calibrate.suspicions import Declared, Suspicion, close_words, declared_of, variants
from twin_core.errors import NoSolutionError
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.parameters.parameter import positive
from twin_core.parameters.vector import ParameterSet

FloatArray = np.ndarray

NODES = ("panel", "box", "battery", "tank")
CAPACITY = np.array([900.0, 4.0e3, 2.5e3, 7.0e3])
PAIRS = {("panel", "box"): 0.8, ("box", "battery"): 0.5, ("battery", "tank"): 0.3, ("panel", "tank"): 0.4}
AREA_M2, SIGMA = 0.12, 5.670374419e-8
DT_S, N = 60.0, 400
NOISE_K = 0.1


def telemetry() -> dict[str, FloatArray]:
    """Return readings and powers of four nodes over 6.7 h, integrated by SciPy sample by sample."""
    rng = np.random.default_rng(4)
    time_s = DT_S * np.arange(N)
    sun = 50.0 * np.clip(np.sin(2.0 * np.pi * time_s / 5600.0), 0.0, None)
    powers = {
        "Q_sun": sun,
        "H_box": np.repeat(rng.uniform(5.0, 30.0, N // 20), 20),
        "H_battery": np.repeat(rng.uniform(0.0, 12.0, N // 25), 25),
    }
    exchange = np.zeros((4, 4))
    for (a, b), g in PAIRS.items():
        i, j = NODES.index(a), NODES.index(b)
        exchange[[i, j, i, j], [j, i, i, j]] += np.array([g, g, -g, -g])
    state = np.array([275.0, 285.0, 283.0, 280.0])
    states = [state]
    for k in range(N - 1):
        heat = np.array([powers["Q_sun"][k], powers["H_box"][k], powers["H_battery"][k], 0.0])

        def rate(_: float, x: FloatArray, heat: FloatArray = heat) -> FloatArray:
            lost = np.array([SIGMA * AREA_M2 * x[0] ** 4, 0.0, 0.0, 0.0])
            return (heat + exchange @ x - lost) / CAPACITY

        state = solve_ivp(rate, (0.0, DT_S), state, rtol=1e-8, atol=1e-8).y[:, -1]
        states.append(state)
    noisy = np.array(states) + rng.normal(0.0, NOISE_K, (N, 4))
    return powers | {f"T_{node}": noisy[:, i] for i, node in enumerate(NODES)}


def declaration() -> dict[str, Any]:
    """Return the declaration: every guess is within 40 % of the truth, the tank and one coupling are known."""
    kelvin, watt = {"kind": "temperature", "unit": "K"}, {"kind": "power", "unit": "W"}
    offsets = {"panel": 1.3, "box": 0.8, "battery": 1.25}
    return {
        "twin": "small-satellite",
        "boundaries": {"space": {"value_K": 2.7}},
        "channels": {f"T_{n}": dict(kelvin) for n in NODES}
        | {name: dict(watt) for name in ("Q_sun", "H_box", "H_battery")},
        "nodes": [
            {
                "id": n,
                "sensor": f"T_{n}",
                "capacity_J_per_K": {"guess": offsets[n] * c} if n in offsets else {"value": c},
            }
            for n, c in zip(NODES, CAPACITY.tolist(), strict=True)
        ],
        "conductors": [
            {
                "between": list(pair),
                "conductance_W_per_K": {"value": g} if pair == ("box", "battery") else {"guess": 1.2 * g},
            }
            for pair, g in PAIRS.items()
        ],
        "radiators": [{"node": "panel", "emissivity": 0.8, "area_m2": AREA_M2 / 0.8, "sink": "space"}],
        "loads": [
            {"channel": "Q_sun", "node": "panel"},
            {"channel": "H_box", "node": "box"},
            {"channel": "H_battery", "node": "battery"},
        ],
    }


Mistake = Callable[[dict[str, Any], dict[str, FloatArray]], None]


def scaled(channel: str, factor: float) -> Mistake:
    return lambda spec, values: values.update({channel: factor * values[channel]})


def shifted(shift_K: float, *channels: str) -> Mistake:
    return lambda spec, values: values.update({c: values[c] + shift_K for c in channels})


def exchanged(a: str, b: str) -> Mistake:
    return lambda spec, values: values.update({a: values[b], b: values[a]})


def held(kind: str, position: int, key: str, factor: float) -> Mistake:
    def make(spec: dict[str, Any], values: dict[str, FloatArray]) -> None:
        quantity = spec[kind][position]
        if key in quantity and isinstance(quantity[key], dict):
            quantity[key]["value"] *= factor
        else:
            quantity[key] *= factor

    return make


def at_another_node(spec: dict[str, Any], values: dict[str, FloatArray]) -> None:
    spec["loads"][1]["node"] = "tank"


def without_coupling(spec: dict[str, Any], values: dict[str, FloatArray]) -> None:
    del spec["conductors"][3]


MISTAKES: list[tuple[str, Mistake, str, set[str]]] = [
    ("sensors swapped", exchanged("T_box", "T_tank"), "swapped sensors", {"T_box", "T_tank"}),
    ("loads swapped", exchanged("H_box", "H_battery"), "swapped loads", {"H_box", "H_battery"}),
    ("load misplaced", at_another_node, "misplaced load", {"H_box", "box"}),
    ("power negated", scaled("H_box", -1.0), "sign", {"H_box"}),
    ("mW read as W", scaled("H_battery", 1000.0), "unit", {"H_battery"}),
    ("kW read as W", scaled("Q_sun", 1e-3), "unit", {"Q_sun"}),
    ("degC read as K", shifted(-273.15, "T_battery"), "unit", {"T_battery"}),
    ("K read as degC", shifted(273.15, "T_tank"), "unit", {"T_tank"}),
    ("all degC read as K", shifted(-273.15, *(f"T_{n}" for n in NODES)), "unit", {f"T_{n}" for n in NODES}),
    ("held capacity", held("nodes", 3, "capacity_J_per_K", 20.0), "held value", {"C:tank"}),
    ("held conductance", held("conductors", 1, "conductance_W_per_K", 30.0), "held value", {"G:box|battery"}),
    ("radiator's area", held("radiators", 0, "area_m2", 5.0), "held value", {"R:panel|space"}),
    ("coupling missing", without_coupling, "missing coupling", {"panel", "tank"}),
]


@pytest.fixture(scope="module")
def flown() -> dict[str, FloatArray]:
    return telemetry()


@pytest.mark.parametrize(("mistake", "expected", "where"), [m[1:] for m in MISTAKES], ids=[m[0] for m in MISTAKES])
def test_each_mistake_is_told(mistake: Mistake, expected: str, where: set[str], flown: dict[str, FloatArray]) -> None:
    spec, values = deepcopy(declaration()), dict(flown)
    mistake(spec, values)
    try:
        model = calibrate(load_spec(spec), [record_of(DT_S * np.arange(N), **values)])
    except NoSolutionError as refused:  # so wrong that no temperature exists: the refusal tells it
        assert all(f"'{name}'" in str(refused).split("perhaps", 2)[1] for name in where)
        return
    told = [(s["mistake"], set(s["where"])) for s in model.summary["suspicions"]]
    assert (expected, where) in told, model.summary["words"]
    words = next(s["words"] for s in model.summary["suspicions"] if set(s["where"]) == where)
    assert any(words in line for line in model.summary["words"])


@pytest.mark.parametrize(("factor", "unit"), [(1000.0, "ms"), (1.0 / 60.0, "minutes"), (1.0 / 3600.0, "hours")])
def test_a_clock_in_another_unit_is_told(factor: float, unit: str, flown: dict[str, FloatArray]) -> None:
    """Nothing misfits but what is held: capacities alone tell how quick time passes."""
    model = calibrate(load_spec(declaration()), [record_of(factor * DT_S * np.arange(N), **flown)])
    assert model.summary["suspicions"][0]["words"] == f"the times are in {unit}, not in seconds"


def test_a_right_declaration_raises_no_suspicion(flown: dict[str, FloatArray]) -> None:
    model = calibrate(load_spec(declaration()), [record_of(DT_S * np.arange(N), **flown)])
    assert "suspicions" not in model.summary
    assert not any("perhaps" in line or "ended" in line for line in model.summary["words"])


def test_words_say_how_far_each_parameter_went() -> None:
    parameters = ParameterSet(
        (positive("C:a", "J/K", 50.0), positive("G:a|b", "W/K", 1.1), positive("C:b", "J/K", 2e-3))
    )
    said = close_words(parameters, {"C:a": 5e-2, "G:a|b": 1.0, "C:b": 2.0}, 1.0, [])
    assert said[0] == "C:a ended 1e+03 times above its guess of 0.05 J/K"
    assert said[1] == "C:b ended 1e+03 times below its guess of 2 J/K"
    assert len(said) == 3 and "no single" in said[2]
    suspicion = Suspicion("sign", ("H",), "power channel 'H' has the wrong sign", 1.02, 90.0)
    assert close_words(parameters, {}, 31.0, [suspicion]) == [
        "the misfit is 31 times the sensors' noise",
        "perhaps power channel 'H' has the wrong sign: the misfit would be 1.02 times the noise, not 31",
    ]


def row(n: int) -> Declared:
    """Return a row of nodes, half of whose joints are held, with a record of noise alone."""
    names = [f"n{k}" for k in range(n)]
    spec = {
        "twin": "row",
        "channels": {f"T_{name}": {"kind": "temperature", "unit": "K"} for name in names},
        "nodes": [{"id": name, "sensor": f"T_{name}", "capacity_J_per_K": {"guess": 900.0}} for name in names],
        "conductors": [
            {"between": [a, b], "conductance_W_per_K": {"value" if k % 2 else "guess": 1.0}}
            for k, (a, b) in enumerate(pairwise(names))
        ],
    }
    generator = np.random.default_rng(5)
    readings = {f"T_{name}": generator.normal(290.0, 1.0, 40) for name in names}
    return Declared(load_spec(spec), (record_of(60.0 * np.arange(40), **readings),), np.full(n, 0.1))


@pytest.mark.parametrize("n", [6, 40])
def test_what_suspicions_cost_does_not_follow_the_network(n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fits that compute a second each on a clock of the test: as many on any network, and the words say how many not."""
    clock_s, fits = [0.0], []
    monkeypatch.setattr("time.thread_time", lambda: clock_s[0])

    def slow(variant: suspicions.Variant, *_: object) -> None:
        fits.append(variant.mistake)
        clock_s[0] += 1.0

    monkeypatch.setattr(suspicions, "_fitted", slow)
    declared = row(n)
    looked = suspicions.suspicions(declared)
    assert len(fits) == looked.tried == suspicions.FIRST_CPU_S
    pairs, joints = n * (n - 1) // 2, n - 1
    # Units of the clock, swaps, couplings that are missing, joints that are held.
    assert looked.possible == 3 + 2 * pairs - joints + joints // 2
    assert set(fits) == {"unit", "swapped sensors", "missing coupling", "held value"}
    assert not looked.complete
    assert looked.left_out.startswith(
        f"checked 12 of {looked.possible:,} possible single mistakes in the specification ("
    )
    assert f"the computing time did not allow for the other {looked.possible - 12:,}, one of which" in looked.left_out
    assert close_words(ParameterSet(()), {}, 9.0, [], complete=False, left_out=looked.left_out)[-1] == looked.left_out


def test_a_fit_that_outlasts_the_limit_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the fit as declared there is nothing to compare with, and nothing is told."""
    clock_s = [0.0]
    monkeypatch.setattr("time.thread_time", lambda: clock_s[0])

    def endless(*_: object) -> None:
        while True:
            clock_s[0] += 1.0
            check_time()

    monkeypatch.setattr(suspicions, "_fitted", endless)
    looked = suspicions.suspicions(row(6), {})
    assert looked.found == [] and looked.tried == 0 and not looked.complete


def test_a_limit_of_computing_holds_within_a_longer_one(monkeypatch: pytest.MonkeyPatch) -> None:
    clock_s = [0.0]
    monkeypatch.setattr("time.thread_time", lambda: clock_s[0])
    with limited(np.inf, 2.0), limited(np.inf, 5.0):
        check_time()
        clock_s[0] = 2.0
        with pytest.raises(TimeIsUpError):
            check_time()
    check_time()


@pytest.mark.parametrize("lengths", [(9000,), (9000, 12), (30,) * 400, (4000, 30, 5000, 30)])
def test_many_records_are_thinned_as_one_is(lengths: tuple[int, ...]) -> None:
    declared = row(3)
    rng = np.random.default_rng(1)
    records = [
        record_of(1e6 * k + 60.0 * np.arange(m), **{f"T_n{i}": rng.normal(290.0, 1.0, m) for i in range(3)})
        for k, m in enumerate(lengths)
    ]
    thin = declared_of(build_problem(build_network(declared.spec), records, declared.noise_K, 90.0)).records
    assert 0 < sum(r.time_s.size for r in thin) <= 2 * suspicions.SAMPLES + len(thin)
    assert min(r.time_s.size for r in thin) >= suspicions.SHORTEST
    starts = [r.time_s[0] for r in thin]
    assert starts == sorted(starts)


def test_each_possible_mistake_is_made_only_when_asked_for() -> None:
    """Of a network of 200 nodes there are 40,000: none of them is built to be counted."""
    assert len(variants(row(200))) == 3 + 2 * 19_900 - 199 + 99


@pytest.mark.parametrize("rests", [True, False])
def test_readings_at_rest_put_no_capacity_in_doubt(rests: bool) -> None:
    """A conductance that is held may be wrong either way."""
    spec = {
        "twin": "pair",
        "boundaries": {"room": {"channel": "T_room"}},
        "channels": {name: {"kind": "temperature", "unit": "K"} for name in ("T_a", "T_room")},
        "nodes": [{"id": "a", "sensor": "T_a", "capacity_J_per_K": {"value": 900.0}}],
        "conductors": [{"between": ["a", "room"], "conductance_W_per_K": {"value": 1.0}}],
    }
    swing_K = 0.0 if rests else 1.0
    columns = {"T_a": 290.0 + swing_K * np.arange(9.0), "T_room": np.full(9, 285.0)}
    declared = Declared(load_spec(spec), (record_of(60.0 * np.arange(9), **columns),), np.array([0.1]))
    held_values = {v.where[0] for v in variants(declared) if v.mistake == "held value"}
    assert held_values == ({"G:a|room"} if rests else {"G:a|room", "C:a"})
