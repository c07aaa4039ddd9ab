"""How far a search has come: in steps that never go back, with words for each phase."""

import os

import pytest

from benchmarks.network_cases import network_case
from twin_core.calibrate.second_order import fit_network
from twin_core.discover.search import search
from twin_core.discover.trial import Trial
from twin_core.effects import REGISTRY
from twin_core.errors import Cancelled
from twin_core.progress import Part

KINDS = ("leak_to_boundary", "hidden_mass", "input_gain", "learned_heat_flow")


@pytest.fixture(scope="module")
def base() -> Trial:
    """Return a small spacecraft whose leak nobody declared, calibrated."""
    case = network_case("leak_to_boundary", 1, n_orbits=3, dt_s=300.0)
    fit, calibration = fit_network(case.spec, [case.record])
    return Trial((), fit, calibration.max_step_s, (calibration.optimum,))


@pytest.fixture(autouse=True)
def few_kinds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(REGISTRY, "_kinds", {name: REGISTRY[name] for name in KINDS})


def test_a_part_tells_the_whole() -> None:
    heard: list[tuple[float, str]] = []
    part = Part(lambda f, m: heard.append((f, m))).part(0.2, 0.6, "effect 1: ").part(0.5, 1.0)
    part(0.0, "fitting")
    part(1.0, "done")
    assert heard == [(pytest.approx(0.4), "effect 1: fitting"), (pytest.approx(0.6), "effect 1: done")]


def test_the_first_look_is_told_in_steps_with_words(base: Trial) -> None:
    """It is most of a search: half a minute without a word looks as if nothing happened."""
    heard: list[tuple[float, str]] = []
    parent = os.getpid()

    def hear(fraction: float, message: str) -> None:
        assert os.getpid() == parent  # what a forked process told would reach a pipe that is not its own
        heard.append((fraction, message))

    found = search(base, false_alarm_rate=0.01, progress=hear)
    assert [effect.name for finding in found.findings for effect in finding.effects] == ["leak_to_boundary"]
    fractions = [fraction for fraction, _ in heard]
    assert fractions == sorted(fractions)
    assert fractions[0] >= 0.0 and fractions[-1] <= 1.0
    first = {fraction: message for fraction, message in heard if message.startswith("effect 1: ")}
    assert len(first) >= 6
    words = " ".join(message for _, message in heard)
    for phase in ("screening", "fitting", "examining", "revising", "comparing with other names"):
        assert phase in words, phase


def test_a_search_ends_where_what_hears_of_it_raises(base: Trial) -> None:
    def stop(fraction: float, message: str) -> None:
        if "examining" in message:
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        search(base, false_alarm_rate=0.01, progress=stop)
