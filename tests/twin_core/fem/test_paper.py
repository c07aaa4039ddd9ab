"""The paper's problem: its size, its network, sensible temperatures."""

import numpy as np
import pytest

from twin_core.errors import SpecError
from twin_core.fem.assembly import assemble
from twin_core.fem.paper import CONFIGURATIONS, CORRELATION_LENGTH_S, paper_scenario, paper_spec
from twin_core.fem.simulate import simulate_many


def test_the_discretisation_is_the_papers() -> None:
    """64 x 64 cells with 4225 unknowns, nine sensors, radiation along eight metres."""
    scenario = paper_scenario()
    field = assemble(scenario)
    assert scenario.grid.region.shape == (64, 64)
    assert field.n_unknowns == 4225
    assert field.readings.shape == (9, 4225)
    assert field.radiation.weight.sum() == pytest.approx(5.670374419e-8 * 0.35 * 8.0)


def test_the_network_has_the_papers_37_parameters() -> None:
    """Nine capacities and 28 conductances; every sensor and input of the scenario is declared."""
    spec, scenario = paper_spec(), paper_scenario()
    assert len(spec.nodes) + len(spec.conductors) == 37
    assert set(spec.channels) == set(scenario.channels)
    assert spec.nodes[0].capacity_J_per_K is not None
    assert paper_spec(guesses=False).nodes[0].capacity_J_per_K is None
    total = sum(assemble(scenario).capacity_J_per_K.values())
    assert sum(node.capacity_J_per_K.guess for node in spec.nodes) == pytest.approx(total, rel=0.1)


def test_tests_a_b_c_run_side_by_side_within_the_papers_range() -> None:
    """Temperatures stay within 200 to 400 K, the balance closes, the tests differ."""
    scenarios = [paper_scenario(test, duration_s=6000.0, sample_s=120.0) for test in CORRELATION_LENGTH_S]
    runs = simulate_many(scenarios)
    for run in runs:
        readings = np.stack(list(run.truth.temperature_K.values()))
        assert 200.0 < readings.min() < readings.max() < 400.0
        assert run.truth.imbalance.max() < 1e-9
    payload = [run.truth.temperature_K["T_payload_1"] for run in runs]
    assert np.abs(payload[0] - payload[1]).max() > 0.5
    assert np.abs(payload[1] - payload[2]).max() > 0.5


@pytest.mark.parametrize("configuration", list(CONFIGURATIONS))
def test_configurations_drive_what_their_table_says(configuration: str) -> None:
    """External: sun alone; internal: heaters alone; combined: both. The channels are the same in all three."""
    scenario = paper_scenario("B", configuration)
    acts = {name: forcing.signal.signal != "constant" for name, forcing in scenario.forcings.items()}
    assert acts["Q_left"] == ("sun" in CONFIGURATIONS[configuration])
    assert acts["Q_payload"] == ("heater" in CONFIGURATIONS[configuration])
    assert set(scenario.channels) == set(paper_scenario("A").channels)


def test_unknown_cases_are_refused() -> None:
    """The message names the known ones."""
    with pytest.raises(SpecError, match=r"unknown test 'D' \(known: A, B, C\)"):
        paper_scenario("D")
    with pytest.raises(SpecError, match="configuration: unknown 'both'"):
        paper_scenario("A", "both")
