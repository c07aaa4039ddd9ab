"""Findings as the report lists them: what stands as an alternative beside which effect."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from twin_core.discover.evidence import Evidence
from twin_core.discover.judge import Finding, Judged, Search
from twin_core.effects import effect_from_json
from twin_core.effects.base import Effect
from twin_core.report import build


def effect(name: str, where: dict[str, Any], values: dict[str, float]) -> Effect:
    return effect_from_json({"effect": name, "where": where, "values": values, "settings": {}})


def test_what_an_alternative_has_as_well_is_not_in_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two effects that were judged together, against one of them beside a third: only the other one is in doubt."""
    monkeypatch.setattr(build, "separating", lambda finding: [])
    leak = effect("leak_to_boundary", {"node": "a", "boundary": "room"}, {"G_W_per_K": 0.5})
    heat = effect("constant_heat_load", {"node": "b"}, {"Q_W": 2.0})
    lag = effect("sensor_lag", {"sensor": "T_b"}, {"tau_s": 60.0})
    trial: Any = None
    pair, option = Judged((leak, heat), Evidence(9.0, 0.0), trial), Judged((leak, lag), Evidence(8.0, 0.0), trial)
    names = [p.name for e in (leak, heat) for p in e.parameters()]
    summary = {"parameters": [{"name": name, "std": 0.1} for name in names]}
    model: Any = SimpleNamespace(effects=(leak, heat), summary=summary)
    told = {row["effect"]: row["alternatives"] for row in build.findings_json([Finding(pair, (option,))], model, [])}
    assert told["leak_to_boundary"] == []
    assert told["constant_heat_load"] == [{"effect": "sensor_lag", "where": {"sensor": "T_b"}, "log_bayes_factor": 8.0}]


@pytest.mark.parametrize(
    ("left", "beside", "said"),
    [(0.4, 9.0, True), (2.1, 9.0, False), (0.4, 8.0, False), (0.4, None, False)],
    ids=["most of it", "half of it", "heat that wanders is as likely", "fits to the noise"],
)
def test_a_misfit_that_gradients_explain_is_said_to_be_coarse(left: float, beside: float | None, said: bool) -> None:
    """Where they are the likeliest of all that may explain it, and explain most of it: on a rig they may stand for a lag."""
    trial: Any = SimpleNamespace(
        fit=SimpleNamespace(log_posterior=8.0),
        calibration=lambda: SimpleNamespace(log_posterior=7.0),
        beside_gradients=lambda: beside and SimpleNamespace(log_posterior=beside),
        unexplained=lambda: left,
        excess=lambda: np.array([4.0, 4.0]),
    )
    notices = build._beside_gradients(Search(trial, trial))
    assert ["90%" in notice for notice in notices] == [True] * said
