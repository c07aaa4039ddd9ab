"""A periodic heat: by hand, and the periods from which a search for it starts."""

from dataclasses import replace

import numpy as np
import pytest

from tests.helpers import every_term_network, points, survey_of
from twin_core.effects import REGISTRY, effect_from_json, effect_to_json

LOAD = REGISTRY["periodic_heat_load"]
SETTINGS = {"origin_s": 600.0, "dated": False}


def test_its_heat_by_hand() -> None:
    effect = LOAD({"node": "b"}, {"Q_W": 2.0, "A_W": 3.0, "B_W": -1.0, "P_s": 480.0}, SETTINGS)
    network = every_term_network([effect])
    (term,) = effect.addition(network.layout).terms
    heat = term.evaluate(points(network, 10), np.array([2.0, 3.0, -1.0, 480.0])).heat_W[:, 0]
    np.testing.assert_allclose(heat[5:10], [1.0, 5.0, 3.0, -1.0, 1.0], atol=1e-12)  # a quarter of a period each


def test_about_no_mean_it_has_three_unknowns_and_the_same_heat_but_for_the_mean() -> None:
    effect = LOAD({"node": "b"}, {"Q_W": 2.0, "A_W": 3.0, "B_W": -1.0, "P_s": 480.0}, SETTINGS)
    network = every_term_network([effect])
    survey = survey_of(network, points(network, 10))
    (form,) = effect.simplified(survey)
    assert (form.held, form.n_free, form.amplitudes) == (("Q_W",), 3, (1, 2))
    assert [p.name for p in form.parameters() if p.frozen] == [f"{form.label}.Q_W"]
    assert not list(form.simplified(survey))
    assert effect_from_json(effect_to_json(form), 0) == form
    (term,), along = form.addition(network.layout).terms, points(network, 10)
    whole = effect.addition(network.layout).terms[0].evaluate(along, np.array([2.0, 3.0, -1.0, 480.0]))
    alone = term.evaluate(along, np.array([p.value for p in form.parameters()]))
    np.testing.assert_allclose(alone.heat_W, whole.heat_W - 2.0, atol=1e-12)


@pytest.mark.parametrize("node", ["a", "c"])
@pytest.mark.parametrize("period_s", [1111.0, 7000.0])
def test_a_line_in_the_residual_is_a_period_to_start_from(node: str, period_s: float) -> None:
    """In noise and a drift ten times as large, to a fraction of what the record's length resolves."""
    network = every_term_network()
    along = points(network, 800)
    t, rng = along.time_s, np.random.default_rng(3)
    drift = 10.0 * np.cumsum(rng.normal(0.0, 1.0, (800, 2)), axis=0) / np.sqrt(800.0)
    line = 2.0 * np.sin(2.0 * np.pi * t / period_s + 1.0)[:, None]
    survey = replace(survey_of(network, along), residual_K=drift + line + rng.normal(0.0, 0.3, (800, 2)))
    starts = list(LOAD.starts({"node": node}, survey))
    assert 6 <= len(starts) <= 12
    nearest = min(abs(1.0 / e.values["P_s"] - 1.0 / period_s) for e in starts)
    assert nearest < 0.25 / (t[-1] - t[0])
    assert all(e.values["P_s"] <= (t[-1] - t[0]) / 2.0 + 1e-6 for e in starts)


def test_what_has_not_come_back_once_is_no_period() -> None:
    """A slow change as long as the record is no line, and no fit may stretch a period beyond half of it."""
    network = every_term_network()
    along = points(network, 400)
    span_s = float(np.ptp(along.time_s))
    slow = np.sin(2.0 * np.pi * along.time_s / (1.2 * span_s))[:, None] * np.ones((1, 2))
    noise = np.random.default_rng(2).normal(0.0, 0.05, slow.shape)
    starts = list(LOAD.starts({"node": "a"}, replace(survey_of(network, along), residual_K=slow + noise)))
    assert starts
    for effect in starts:
        period = next(q for q in effect.parameter_specs() if q.name == "P_s")
        assert effect.values["P_s"] <= span_s / 2.0
        assert period.transform.to_value(np.log(span_s)) == pytest.approx(span_s / 2.0)
        assert period.transform.highest == pytest.approx(np.log(span_s / 2.0))


def test_its_phase_counts_from_the_first_sample() -> None:
    """Not from the first point of the rollout, which lies within the first step: 40 s are 6 degrees in 40 minutes."""
    network = every_term_network()
    along = points(network, 400)
    line = np.sin(2.0 * np.pi * along.time_s / 2400.0)[:, None] * np.ones((1, 2))
    survey = replace(survey_of(network, along), residual_K=line, sample_s=along.time_s - 40.0)
    assert {e.settings["origin_s"] for e in LOAD.starts({"node": "a"}, survey)} == {float(along.time_s[0]) - 40.0}


def test_a_residual_without_anything_gives_no_line() -> None:
    network = every_term_network()
    survey = survey_of(network, points(network, 100))
    assert not list(LOAD.starts({"node": "a"}, replace(survey, residual_K=np.zeros((100, 2)))))
