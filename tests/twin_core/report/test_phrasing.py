"""Words and numbers of the report page."""

import math
from typing import Any

import pytest

from twin_core.report import phrasing


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (7.008, 3, "7.01"),
        (0.04816, 3, "0.0482"),
        (0.99996, 3, "1.00"),
        (-5.678, 2, "−5.7"),
        (12345.0, 3, "12300"),
        (4.66e-100, 2, "4.7·10⁻¹⁰⁰"),
        (3.0e9, 2, "3.0·10⁹"),
        (0.0, 3, "0"),
        (7, 3, "7.00"),
        (None, 3, "–"),
        (math.nan, 3, "–"),
        (True, 3, "–"),
        ("7", 3, "–"),
    ],
)
def test_number(value: Any, digits: int, text: str) -> None:
    assert phrasing.number(value, digits) == text


@pytest.mark.parametrize(
    ("mean", "std", "text"),
    [
        (0.030013, 1.15e-5, "0.030013 ± 0.000012"),
        (21034.2, 311.0, "21030 ± 310"),
        (-2.0, 0.5, "−2.00 ± 0.50"),
        (5.0, None, "5.000"),
        ("2026-01-01T00:00:00Z", None, "2026-01-01T00:00:00Z"),
        (None, None, "–"),
    ],
)
def test_with_spread(mean: Any, std: Any, text: str) -> None:
    assert phrasing.with_spread(mean, std) == text


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        (7.0, 0.05, "140 times smaller"),
        (1.0, 0.9, "10% smaller"),
        (1.0, 1.2, "20% larger"),
        (1.0, 1.001, "unchanged"),
        (None, 1.0, ""),
        (1.0, None, ""),
        (0.0, 0.0, ""),
    ],
)
def test_gain(before: float | None, after: float | None, text: str) -> None:
    assert phrasing.gain(before, after) == text


@pytest.mark.parametrize(
    ("where", "text"),
    [
        ({"node": "px", "sink": "space"}, "from px to space"),
        ({"node": "px", "boundary": "bus"}, "from px to bus"),
        ({"nodes": ["px", "mx"]}, "between px and mx"),
        ({"node": "px"}, "at px"),
        ({"node": "px", "channel": "pitch"}, "at px by channel pitch"),
        ({"channel": "Q"}, "of channel Q"),
        ({"sensor": "T"}, "of sensor T"),
        ({}, ""),
    ],
)
def test_place(where: dict[str, Any], text: str) -> None:
    assert phrasing.place(where) == text


def test_the_headline_leads_with_sensors_that_never_change() -> None:
    report = {
        "verdict": "no_effect_supported",
        "findings": [],
        "resting_sensors": ["T_a"],
        "before": {"per_sensor": {"T_a": {}}},
    }
    assert phrasing.headline(report).startswith("No sensor ever changes (T_a)")
    report["before"] = {"per_sensor": {"T_a": {}, "T_b": {}}}
    assert "suffices" in phrasing.headline(report)
    told = phrasing.headline(report | {"verdict": "unexplained"})
    assert told.startswith("Sensor T_a never changes: stuck or at rest.")


def test_headline_of_each_verdict() -> None:
    one = {"effect": "input_gain", "where": {"channel": "Q_Box"}}
    added = {"verdict": "effect_added", "findings": [one]}
    assert phrasing.headline(added) == "Input gain of channel Q_Box was missing."
    told = {**one, "sentence": "a conductor between mx and battery was missing"}
    assert phrasing.headline({**added, "findings": [told]}) == "A conductor between mx and battery was missing."
    two, three = ({**added, "findings": [told, *more]} for more in ([one], [one, one]))
    assert phrasing.headline(two) == "A conductor between mx and battery was missing; 1 more effect was found."
    assert phrasing.headline(three) == "A conductor between mx and battery was missing; 2 more effects were found."
    assert "no missing effect" in phrasing.headline({"verdict": "no_effect_supported", "findings": []})
    assert "no known effect explains it" in phrasing.headline({"verdict": "unexplained", "findings": []})


def test_a_sentence_that_begins_with_a_name_keeps_its_spelling() -> None:
    finding = {"effect": "e", "where": {"node": "px"}, "sentence": "px radiates"}
    assert phrasing.sentence(finding, capital=True) == "px radiates"
    assert phrasing.sentence({**finding, "sentence": "heat into px"}, capital=True) == "Heat into px"


def test_parameters_carry_their_units() -> None:
    finding = {
        "parameters": {
            "C_J_per_K": {"mean": 100.0, "std": 1.0},
            "values_W": {"mean": [1.0, 2.0], "std": [0.1, None]},
            "g": {"mean": 0.5, "std": None},
            "Q_W": {"mean": 40.0, "std": 120.0, "unbounded_above": True},
            "time": {"mean": "2026-01-03T04:05:06Z", "std": 35.2},
        }
    }
    assert phrasing.parameters(finding) == [
        {"symbol": "C", "text": "100.0 ± 1.0", "unit": "J/K"},
        {"symbol": "values", "text": "1.00 ± 0.10; 2.000", "unit": "W"},
        {"symbol": "g", "text": "0.5000", "unit": ""},
        {"symbol": "Q", "text": "40.0 or more, unbounded above", "unit": "W"},
        {"symbol": "time", "text": "2026-01-03T04:05:06Z ± 35", "unit": "s"},
    ]


@pytest.mark.parametrize(("factor", "word"), [(7.0, "very strong"), (3.5, "strong"), (1.5, "positive"), (0.1, "weak")])
def test_strength(factor: float, word: str) -> None:
    assert phrasing.strength(factor) == word


def test_labels_keep_names() -> None:
    assert phrasing.label_in_words("input_gain(Q_box)") == "input gain (Q_box)"
    assert phrasing.label_in_words("input_gain") == "input gain"


def _among(*factors: float | None) -> dict[str, Any]:
    others = [{"effect": "heat_leak", "where": {"node": f"n{k}"}, "log_bayes_factor": f} for k, f in enumerate(factors)]
    return {"evidence": {"log_bayes_factor": 100.0}, "alternatives": others}


CLOSE, COARSE = "The readings hardly tell it from", "The declared network is too coarse to tell it from"


@pytest.mark.parametrize(
    ("factors", "said"),
    [
        ((), []),
        ((97.5,), [f"{CLOSE} heat leak at n0"]),
        ((104.0, 99.0), [f"{CLOSE} heat leak at n0 or heat leak at n1"]),
        ((20.0,), [f"{COARSE} heat leak at n0: this explains nearly as much"]),
        (
            (99.0, 40.0, 5.0),
            [
                f"{CLOSE} heat leak at n0",
                f"{COARSE} heat leak at n1 or heat leak at n2: these explain nearly as much",
            ],
        ),
        ((99.0,) * 3, [f"{CLOSE} heat leak at n0, heat leak at n1 or heat leak at n2"]),
        ((99.0,) * 4, [f"{CLOSE} heat leak at n0, heat leak at n1, heat leak at n2 and 1 other"]),
        (
            (9.0,) * 20,
            [
                f"{COARSE} heat leak at n0, heat leak at n1, heat leak at n2 and 17 others: these explain nearly as much",
            ],
        ),
    ],
)
def test_why_a_finding_is_ambiguous_is_told(factors: tuple[float, ...], said: list[str]) -> None:
    """Three nats are what readings hardly tell; what is farther behind explains nearly as much in a coarse network."""
    assert phrasing.ambiguities(_among(*factors)) == said
