"""The demonstration: nothing hidden leaks, the same seed repeats, temperatures are a spacecraft's."""

import json

import numpy as np
import pytest

from twin_core.errors import SpecError
from twin_core.fem.demo import DEMO_EFFECTS, demo_scenario
from twin_core.fem.scenario import Scenario, load_scenario
from twin_core.fem.simulate import Simulation, simulate
from twin_core.network.spec_io import dump_spec


def short(scenario: Scenario, orbits: float = 2.0) -> Scenario:
    """Return the scenario cut to a few orbits."""
    body = scenario.model_dump(mode="json", exclude_none=True)
    body["time"] |= {"duration_s": orbits * 5700.0, "settle_s": 5700.0, "step_s": 60.0}
    return load_scenario(body)


@pytest.fixture(scope="module")
def clean() -> Simulation:
    """A short run with nothing hidden."""
    return simulate(short(demo_scenario("none", 5)[0]))


def test_temperatures_are_sensible_and_the_balance_closes(clean: Simulation) -> None:
    """Every region stays between 240 and 330 K, and no step loses heat."""
    for temperature_K in clean.truth.region_K.values():
        assert 240.0 < temperature_K.min() < temperature_K.max() < 330.0
    assert clean.truth.imbalance.max() < 1e-9
    assert all((heat == 0.0).all() for heat in clean.truth.hidden_heat_W.values())


def test_noise_is_what_the_specification_declares(clean: Simulation) -> None:
    """The record minus the truth at the samples has the declared standard deviation."""
    _, spec = demo_scenario("none", 5)
    for node in spec.nodes:
        sensor = node.sensors[0]
        true_K = np.interp(clean.record.time_s, clean.truth.time_s, clean.truth.temperature_K[sensor])
        noise_K = clean.record.channel(sensor) - true_K
        # 191 samples: the standard deviation itself is uncertain by 5 %.
        assert noise_K.std() == pytest.approx(spec.noise_std_K(sensor), rel=0.2)


@pytest.mark.parametrize("effect", list(DEMO_EFFECTS))
def test_the_specification_knows_nothing_of_the_effect(effect: str) -> None:
    """The operator's specification and the channels are the same whatever is hidden, and do not name it."""
    scenario, spec = demo_scenario(effect, 3)
    clean_scenario, clean_spec = demo_scenario("none", 3)
    assert spec == clean_spec
    assert scenario.channels == clean_scenario.channels
    assert effect not in json.dumps(dump_spec(spec))
    assert [hidden.effect for hidden in scenario.hidden] == [effect]
    assert set(scenario.channels) == set(spec.channels)


def test_the_effect_changes_temperatures_and_not_inputs() -> None:
    """Declared inputs of a run with an effect equal those without; temperatures differ by more than the noise."""
    for effect in ("input_gain", "hidden_mass", "proportional_heater"):
        with_effect = simulate(short(demo_scenario(effect, 5)[0], orbits=3.0))
        without = simulate(short(demo_scenario("none", 5)[0], orbits=3.0))
        for name, channel in demo_scenario("none", 5)[0].channels.items():
            if channel.kind != "temperature":
                np.testing.assert_array_equal(with_effect.record.channel(name), without.record.channel(name))
        gaps = [np.abs(with_effect.truth.region_K[r] - without.truth.region_K[r]).max() for r in without.truth.region_K]
        assert max(gaps) > 0.5


def test_random_draws_the_effect_and_its_place_from_the_seed() -> None:
    """Eight seeds in a row hide each effect once, in many places over forty seeds; a seed is always the same."""
    drawn = [demo_scenario("random", seed)[0].hidden[0] for seed in range(40)]
    assert {effect.effect for effect in drawn[:8]} == {effect.effect for effect in drawn[8:16]} == set(DEMO_EFFECTS)
    assert [effect.effect for effect in drawn[:8]] != [effect.effect for effect in drawn[8:16]]
    assert len({json.dumps(effect.where) for effect in drawn}) >= 15
    assert demo_scenario("random", 11)[0] == demo_scenario("random", 11)[0]


def test_guesses_are_off_but_within_reach() -> None:
    """Capacity guesses lie within 40 % of the truth and are not the truth."""
    scenario, spec = demo_scenario("none", 8)
    capacity = simulate(short(scenario, 1.0)).truth.capacity_J_per_K
    ratios = np.array([node.capacity_J_per_K.guess / capacity[node.id] for node in spec.nodes])
    assert (np.abs(ratios - 1.0) < 0.41).all()
    assert np.abs(ratios - 1.0).max() > 0.1


def test_an_unknown_effect_is_refused_by_name() -> None:
    """The message names the effect and the known ones."""
    with pytest.raises(SpecError, match=r"unknown effect 'gremlin' \(known: radiation_to_sink"):
        demo_scenario("gremlin", 0)
