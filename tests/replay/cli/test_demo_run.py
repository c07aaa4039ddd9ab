"""The judgement of the demonstration, apart from its run."""

from typing import Any

import pytest

from replay.cli.demo_run import Outcome, hidden_effect, place_of, verdict_on
from twin_core.fem.demo import DEMO_EFFECTS, demo_scenario

HIDDEN = {"effect": "missing_conductor", "where": {"nodes": ["a", "b"]}}
OTHER = {"effect": "input_gain", "where": {"channel": "Q"}, "alternatives": []}


def report(findings: list[dict[str, Any]], before_K: float = 2.0, after_K: float = 1.0) -> dict[str, Any]:
    return {"findings": findings, "before": {"rmse_K": before_K}, "after": {"rmse_K": after_K}}


@pytest.mark.parametrize(
    ("findings", "hidden", "verdict"),
    [
        ([{**HIDDEN, "where": {"nodes": ["b", "a"]}, "alternatives": []}], HIDDEN, "named"),
        ([OTHER, {**HIDDEN, "alternatives": []}], HIDDEN, "named"),
        ([{**OTHER, "alternatives": [HIDDEN]}], HIDDEN, "alternative"),
        ([OTHER], HIDDEN, "no"),
        ([{**HIDDEN, "where": {"nodes": ["a", "c"]}, "alternatives": []}], HIDDEN, "no"),
        ([], HIDDEN, "no"),
        ([], None, "nothing"),
        ([OTHER], None, "no"),
    ],
)
def test_verdict(findings: list[dict[str, Any]], hidden: dict[str, Any] | None, verdict: str) -> None:
    assert verdict_on(report(findings), hidden) == verdict


@pytest.mark.parametrize(
    ("hidden", "found", "after_K", "success"),
    [
        (HIDDEN, "named", 1.0, True),
        (HIDDEN, "alternative", 1.0, True),
        (HIDDEN, "named", 2.0, False),
        (HIDDEN, "no", 1.0, False),
        (None, "nothing", 2.0, True),
        (None, "no", 1.0, False),
    ],
)
def test_success_needs_the_name_and_a_lower_error(
    hidden: dict[str, Any] | None, found: str, after_K: float, success: bool
) -> None:
    outcome = Outcome(hidden, found, report([], after_K=after_K), {}, 1.0, "http://127.0.0.1:1")
    assert outcome.success is success
    assert outcome.to_json()["success"] is success


@pytest.mark.parametrize("effect", DEMO_EFFECTS)
def test_hidden_effect_is_read_from_the_scenario(effect: str) -> None:
    scenario, _ = demo_scenario(effect, 3)
    hidden = hidden_effect(scenario)
    assert hidden is not None and hidden["effect"] == effect
    assert hidden["where"] and hidden["parameters"]
    assert place_of(hidden)[0] == effect


def test_nothing_hidden() -> None:
    assert hidden_effect(demo_scenario("none", 3)[0]) is None
