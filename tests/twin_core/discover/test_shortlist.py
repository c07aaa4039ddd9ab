"""Candidates where they can be: at a node without a coupling, couplings alone."""

from typing import Any

import numpy as np
import pytest

from tests.helpers import conductive_spec, record_of
from twin_core.calibrate.second_order import fit_network
from twin_core.discover.shortlist import candidates, refined, survey_of
from twin_core.discover.trial import Trial, try_effects
from twin_core.effects import REGISTRY
from twin_core.effects.base import Effect, touched_nodes
from twin_core.network.spec_io import load_spec

STEP_S, N = 60.0, 120


@pytest.fixture(scope="module")
def base() -> Trial:
    """Return two nodes that are joined beside a heated one that nobody joined to anything, which cools all the same."""
    room: dict[str, Any] = {"boundaries": {"room": {"value_K": 290.0}}}
    loads = {"loads": [{"channel": "P", "node": "n2"}], "channels": {"P": {"kind": "power", "unit": "W"}}}
    spec = conductive_spec(3, [(0, 1)], **room, **loads)
    time_s = STEP_S * np.arange(N)
    noise = np.random.default_rng(3).normal(0.0, 0.02, (3, N))
    swing = np.sin(time_s / 900.0)
    values = {"T0": 300.0 + swing, "T1": 300.0 - swing, "T2": 290.0 + 9.0 * np.exp(-time_s / 3000.0)}
    values["P"], noise = np.where(time_s < 3000.0, 1.0, 2.0), np.vstack([noise, np.zeros(N)])
    record = record_of(time_s, **{name: v + e for (name, v), e in zip(values.items(), noise, strict=True)})
    fit, calibration = fit_network(load_spec(spec), [record])
    return Trial((), fit, calibration.max_step_s, (calibration.optimum,))


def at(node: str, trial: Trial, *, fallback: bool) -> list[Effect]:
    """Return the candidates that act at one node alone."""
    survey, effects = candidates(trial, trial.fit, fallback=fallback)
    return [effect for effect in effects if set(touched_nodes(effect, survey.layout)) == {node}]


@pytest.mark.parametrize("fallback", [False, True])
def test_at_a_node_without_a_coupling_couplings_alone_are_candidates(base: Trial, *, fallback: bool) -> None:
    """A constant heat followed the first hour, and was five times as wrong on the rest as no heat at all."""
    alone = at("n2", base, fallback=fallback)
    joins = {"boundary", "sink"}
    assert [e.label for e in alone if not (joins & e.where.keys() or e.name == "hidden_mass")] == []
    assert not all(joins & effect.where.keys() for effect in at("n1", base, fallback=fallback))
    assert fallback or {"leak_to_boundary", "radiation_to_sink"} & {effect.name for effect in alone}


def test_once_a_coupling_is_found_a_node_may_have_any_effect(base: Trial) -> None:
    leak = REGISTRY["leak_to_boundary"]({"node": "n2", "boundary": "room"}, {"G_W_per_K": 1.0})
    found = try_effects(base, (leak,))
    assert "constant_heat_load" not in {effect.name for effect in at("n2", base, fallback=False)}
    assert "constant_heat_load" in {effect.name for effect in at("n2", found, fallback=False)}


def test_an_effect_that_may_end_is_tried_with_an_end_and_without(base: Trial) -> None:
    """Of a load that came and went one that stays may explain nothing: neither may hide the other."""
    kind, survey = REGISTRY["heat_load_step"], survey_of(base.fit)
    starts = list(kind.starts({"node": "n0"}, survey))
    staying, ending = ([s for s in starts if ("stop" in s.values) is ends] for ends in (False, True))
    for chosen in (staying[9], ending[9]):
        found = refined(base.fit, [chosen])
        assert {"stop" in effect.values for effect in found} == {False, True}
        assert all(effect.values["time"] < effect.values.get("stop", np.inf) for effect in found)
        assert {effect.place for effect in found} == {chosen.place}
    (lag,) = list(REGISTRY["sensor_lag"].starts({"sensor": "T0"}, survey))[:1]
    assert len(refined(base.fit, [lag])) == 1
