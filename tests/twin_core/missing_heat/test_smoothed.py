"""The smoothed heat is the one that SciPy put in, is told in figures and words, and never stands in the way."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from twin_core.calibrate.second_order import fit_network
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4 as SIGMA
from twin_core.discover.judge import Search
from twin_core.discover.trial import Trial
from twin_core.errors import ModelError
from twin_core.missing_heat import smoothed as module
from twin_core.missing_heat.smoothed import NodeHeat, added_to_report, smooth_missing_heat
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

TIMES = np.arange(0.0, 40000.0, 100.0)
SPEC = {
    "twin": "t",
    "boundaries": {"space": {"value_K": 3.0}},
    "channels": {
        "T_a": {"kind": "temperature", "unit": "K"},
        "T_b": {"kind": "temperature", "unit": "K"},
        "Q": {"kind": "power", "unit": "W", "interpolation": "linear"},
    },
    "nodes": [
        {"id": "a", "sensor": "T_a", "capacity_J_per_K": {"value": 800.0}},
        {"id": "b", "sensor": "T_b", "capacity_J_per_K": {"value": 2000.0}},
    ],
    "conductors": [{"between": ["a", "b"], "conductance_W_per_K": {"value": 1.5}}],
    "radiators": [{"node": "b", "emissivity": 0.8, "area_m2": 0.2, "sink": "space"}],
    "loads": [{"channel": "Q", "node": "a"}],
}
POWER = 30.0 + 20.0 * np.sin(TIMES / 1500.0)


def _hidden(time_s):
    return 4.0 + 3.0 * np.sin(2.0 * np.pi * np.asarray(time_s) / 9000.0)


def _rates(t, x):
    exchange = 1.5 * (x[1] - x[0])
    radiated = SIGMA * 0.8 * 0.2 * (3.0**4 - x[1] ** 4)
    return [(np.interp(t, TIMES, POWER) + exchange) / 800.0, (-exchange + radiated + _hidden(t)) / 2000.0]


@pytest.fixture(scope="module")
def search() -> Search:
    run = solve_ivp(_rates, TIMES[[0, -1]], [265.0, 255.0], t_eval=TIMES, rtol=1e-9, atol=1e-9, max_step=100.0)
    noisy = run.y.T + np.random.default_rng(4).normal(0.0, 0.02, (TIMES.size, 2))
    record = Record(TIMES, {"T_a": noisy[:, 0], "T_b": noisy[:, 1], "Q": POWER})
    fit, calibration = fit_network(load_spec(SPEC), [record])
    base = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
    return Search(base, base)


def test_hidden_heat_is_seen_where_it_is(search):
    told = smooth_missing_heat(search)
    assert not told.notices
    heats = {heat.node: heat for heat in told.heats}
    assert set(heats) == {"a", "b"}
    truth, seen = _hidden(heats["b"].time_s), heats["b"]
    assert np.corrcoef(truth, seen.mean_W)[0, 1] > 0.97
    assert np.mean(np.abs(seen.mean_W - truth) < 2.0 * seen.std_W) > 0.85
    assert np.mean(np.abs(heats["a"].mean_W) < 2.0 * heats["a"].std_W) > 0.85
    # All heat passes through b by its radiator.
    radiated = SIGMA * 0.8 * 0.2 * np.mean(seen.temperature_K**4)
    assert seen.turnover_W == pytest.approx(radiated, rel=0.15)


def test_heat_is_told_of_the_model_that_the_report_tells(search):
    """Beside heat of any size a capacity of 1.4 kJ/K ended a hundred times larger: 1.5 kW were told where a heater gives 10 W."""
    nodes = [SPEC["nodes"][0] | {"capacity_J_per_K": {"guess": 700.0}}, SPEC["nodes"][1]]
    fit, calibration = fit_network(load_spec(SPEC | {"nodes": nodes}), [search.base.fit.problem.segments[0].record])
    swollen = replace(fit, free=fit.free + np.log(100.0))
    assert swollen.network.parameters.as_dict()["C:a"] > 3e4
    base = Trial((), swollen, calibration.max_step_s, (calibration.optimum,))
    heats = {heat.node: heat for heat in smooth_missing_heat(Search(base, base)).heats}
    assert np.abs(heats["a"].mean_W).max() < 10.0
    assert np.corrcoef(_hidden(heats["b"].time_s), heats["b"].mean_W)[0, 1] > 0.97


def test_without_findings_there_is_nothing_to_agree_with(search):
    report = {"words": ["before"], "notices": ["old"]}
    added = added_to_report(smooth_missing_heat(search), report)
    row = next(r for r in added["missing_heat"] if r["node"] == "b")
    assert row["agrees"] is None and row["correlation_with_effect"] is None
    assert row["mean_W"] == pytest.approx(4.0, abs=1.5)
    assert added["words"][0] == "before" and "The declared model lacks" in " ".join(added["words"])
    assert added["notices"] == ["old"] and report["words"] == ["before"]


@pytest.mark.parametrize(
    ("heat_W", "words"), [(np.nan, "Were what the readings at b show"), (4.0, "The declared model lacks")]
)
def test_where_what_was_found_supplies_no_heat_none_is_said_to_be_missing(search, monkeypatch, heat_W, words):
    """A sensor that lagged stood beside 4.3 W that a heater of 3.2 W was said to lack."""
    monkeypatch.setattr(module, "nodes_of_interest", lambda search: ["b"])
    monkeypatch.setattr(module, "effect_heat", lambda search, states, first: np.full_like(states, heat_W))
    told = smooth_missing_heat(replace(search, findings=["what a sensor does"]))
    assert len(told.words()) == 1
    assert told.words()[0].startswith(words)


def test_long_records_are_seen_from_their_end(search, monkeypatch):
    whole = {heat.node: heat for heat in smooth_missing_heat(search).heats}
    monkeypatch.setattr(module, "MAX_WORK", 16.0 * 200)
    ends = {heat.node: heat for heat in smooth_missing_heat(search).heats}
    for node, heat in ends.items():
        assert heat.time_s.size == 200 and heat.time_s[-1] == TIMES[-1]
        late = slice(-100, None)
        apart = np.abs(heat.mean_W[late] - whole[node].mean_W[late])
        assert (apart < 0.5 * heat.std_W[late]).all()


@pytest.mark.parametrize(
    "error", [ModelError("singular"), np.linalg.LinAlgError("singular"), FloatingPointError("nan")]
)
def test_trouble_is_told_not_raised(search, monkeypatch, error):
    def fail(*_args, **_options):
        raise error

    monkeypatch.setattr(module, "learn_heat_flow", fail)
    told = smooth_missing_heat(search)
    assert len(told.heats) == 2 and all(heat.law is None for heat in told.heats) and "no regression" in told.notices[0]
    monkeypatch.setattr(module, "smooth_extended", fail)
    told = smooth_missing_heat(search)
    (notice,) = told.notices
    assert told.heats == () and notice.startswith("the report does not contain the missing heat at ")
    assert notice.endswith(f": its computation failed ({error})")
    assert told.rows() == [] and told.words() == []


def _heat(effect_W, mean_W, std_W=0.5) -> NodeHeat:
    steps = np.arange(50.0)
    full = None if effect_W is None else effect_W * np.ones(50)
    return NodeHeat("n", steps, 280.0 + steps, mean_W * np.ones(50), std_W * np.ones(50), full, None, 10.0, {})


@pytest.mark.parametrize(
    ("share", "words"),
    [
        (0.0, "by itself foretells that variation."),
        (0.3, "by itself foretells that variation (at most 30% of it, the channel Q)."),
        (0.8, "80% of that variation follows the channel Q."),
    ],
)
def test_what_a_heat_follows_is_told_as_far_as_it_was_looked_for(share, words):
    assert replace(_heat(None, 4.0 + WAVE), follows={"channel Q": share}).words().endswith(words)


def test_of_a_variation_within_its_uncertainty_nothing_is_told():
    """0.7 W beside 2 W, though all of it repeats with something, and with the findings' heat by chance."""
    heat = replace(_heat(None, 5.0 + WAVE, 2.0), follows={"temperature of n": 1.0})
    lines = (
        heat.words(),
        heat.words(no_heat=True),
        replace(heat, effect_W=5.0 + 0.1 * WAVE).words(),
        replace(heat, effect_W=5.0 - 0.1 * WAVE).words(),
    )
    for line in lines:
        assert not any(word in line for word in ("vary by", "varies by", "temperature", "correlation"))
        assert "uncertainty" in line and "2 W" in line
    assert all("the two agree" in line for line in lines[2:])
    assert heat.row()["follows"] == []
    assert "varies by" in replace(heat, std_W=0.25 * heat.std_W).words()


def test_nothing_is_said_of_a_node_that_lacks_nothing():
    told = module.MissingHeat((_heat(None, 0.0), _heat(None, 4.0)))
    assert len(told.words()) == 1 and "lacks 4 W" in told.words()[0] and len(told.rows()) == 2


WAVE = np.sin(np.arange(50.0) / 5.0)
QUICK = np.where(np.arange(50) % 2, 1.0, -1.0)


@pytest.mark.parametrize(
    ("effect_W", "mean_W", "std_W", "agrees", "words"),
    [
        (5.0 + WAVE, 5.2 + WAVE, 0.5, True, "the two agree"),
        (5.0, 5.2 + WAVE, 0.5, True, "the two agree"),
        (5.0 + 0.3 * WAVE, 5.2 + WAVE, 0.5, True, "the two agree"),
        (5.0 - 0.3 * WAVE, 5.2 + WAVE, 0.5, False, "alike in size but do not vary together (correlation -1.00)"),
        (5.0 + 0.3 * QUICK, 5.2 + WAVE, 0.5, False, "alike in size but do not vary together (correlation -0.0"),
        (5.0 + 3 * WAVE, 3 * WAVE, 0.5, True, "rise and fall together"),
        (5.0 + WAVE, -4.0 - WAVE, 0.5, False, "the two differ"),
        (0.3 * WAVE, -4.0 + 0.3 * WAVE, 2.0, None, "too wide"),
        (None, 4.0, 0.5, None, "on average"),
    ],
)
def test_agreement(effect_W, mean_W, std_W, agrees, words):
    heat = _heat(effect_W, mean_W, std_W)
    assert heat.agrees is agrees and words in heat.words()
    row = heat.row()
    assert row["share_of_turnover"] == pytest.approx(np.sqrt(np.mean((mean_W * np.ones(50)) ** 2)) / 10.0)
    if isinstance(effect_W, np.ndarray) and isinstance(mean_W, np.ndarray):
        assert row["correlation_with_effect"] == pytest.approx(np.corrcoef(effect_W, mean_W)[0, 1])
    else:
        assert row["correlation_with_effect"] is None


def test_forces_that_are_not_finite_are_left_out(search, monkeypatch):
    smooth = module.smooth_extended

    def spoilt(*args, **options):
        found = smooth(*args, **options)
        found.mean_W[3, 0] = np.nan
        return found

    monkeypatch.setattr(module, "smooth_extended", spoilt)
    told = smooth_missing_heat(search)
    assert len(told.heats) == 1 and any("not finite" in notice for notice in told.notices)
    assert told.heats[0].node == "b"


def test_a_leak_to_a_boundary_follows_what_drives_it():
    """SciPy lets b leak 0.4 W/K into a wall whose channel is read; all else is known, so that nothing takes it up."""
    wall = 285.0 + 9.0 * np.sin(2.0 * np.pi * TIMES / 5100.0) + 4.0 * np.sin(2.0 * np.pi * TIMES / 1900.0)

    def rates(t, x):
        exchange, leak = 1.5 * (x[1] - x[0]), 0.4 * (np.interp(t, TIMES, wall) - x[1])
        radiated = SIGMA * 0.8 * 0.2 * (3.0**4 - x[1] ** 4)
        return [(np.interp(t, TIMES, POWER) + exchange) / 800.0, (-exchange + radiated + leak) / 2000.0]

    run = solve_ivp(rates, TIMES[[0, -1]], [265.0, 255.0], t_eval=TIMES, rtol=1e-9, atol=1e-9, max_step=100.0)
    noisy = run.y.T + np.random.default_rng(5).normal(0.0, 0.02, (TIMES.size, 2))
    known = {
        "boundaries": SPEC["boundaries"] | {"wall": {"channel": "T_wall"}},
        "channels": SPEC["channels"] | {"T_wall": {"kind": "temperature", "unit": "K"}},
    }
    record = Record(TIMES, {"T_a": noisy[:, 0], "T_b": noisy[:, 1], "Q": POWER, "T_wall": wall})
    fit, calibration = fit_network(load_spec(SPEC | known), [record])
    base = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
    heat = next(h for h in smooth_missing_heat(Search(base, base)).heats if h.node == "b")
    truth = 0.4 * (np.interp(heat.time_s, TIMES, wall) - heat.temperature_K)
    assert np.corrcoef(truth, heat.mean_W)[0, 1] > 0.95
    what, share = next(iter(heat.follows.items()))
    assert what == "temperature of wall over its own" and share > 0.9
    assert f"{share:.0%} of that variation follows the {what}" in heat.words()
