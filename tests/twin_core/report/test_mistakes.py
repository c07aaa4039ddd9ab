"""Mistakes of the declaration in a report: sensors of one node that contradict each other, and a look that fails."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from twin_core.errors import TelemetryError
from twin_core.report import mistakes
from twin_core.report.mistakes import contradictions, told_mistakes


def calibration(residual_K: np.ndarray, nodes: dict[str, str]) -> Any:
    """Return a calibration of which sensors, their nodes and what it leaves count."""
    layout = SimpleNamespace(sensor_node=nodes.__getitem__)
    network = SimpleNamespace(spec=SimpleNamespace(sensors=list(nodes)), layout=layout, parameters=None)
    problem = SimpleNamespace(noise_K=np.ones(len(nodes)), network=network, segments=[])
    return SimpleNamespace(network=network, residuals=[residual_K], problem=problem)


@pytest.mark.parametrize(
    ("share", "nodes", "told"),
    [(0.49, ("a", "a"), 0), (0.51, ("a", "a"), 1), (0.51, ("a", "b"), 0)],
    ids=["less than half", "most of it", "of two nodes"],
)
def test_sensors_of_one_node_that_differ_by_most_of_the_misfit_are_told(
    share: float, nodes: tuple[str, str], told: int
) -> None:
    """Half the square of a difference d stays of both, whatever one temperature is predicted; the rest is common to both."""
    difference_K = 6.0
    common_K = np.sqrt((1.0 / share - 1.0) * difference_K**2 / 4.0)
    signs = np.where(np.arange(40) % 2, 1.0, -1.0)
    residual = np.stack([common_K * signs + 3.0, common_K * signs - 3.0], axis=1)
    residual[5, 0] = np.nan
    words = contradictions(calibration(residual, {"T_1": nodes[0], "T_2": nodes[1]}))
    assert len(words) == told
    assert all("'T_1' and 'T_2' read one node, a, and differ by 6 K" in line for line in words)


def test_sensors_that_are_never_read_together_contradict_nobody() -> None:
    residual = np.where(np.arange(40)[:, None] % 2 == [0, 1], 5.0, np.nan)
    assert contradictions(calibration(residual, {"T_1": "a", "T_2": "a"})) == []


def test_a_look_for_mistakes_that_fails_is_told_and_costs_no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    base = calibration(np.full((40, 1), 9.0), {"T_1": "a"})
    base.network.parameters = SimpleNamespace(as_dict=dict)

    def fails(*given: Any, **named: Any) -> None:
        raise TelemetryError("channel 'T_1' has no usable samples")

    for name, value in {"nothing_moves": [], "is_odd": True, "stated_guesses": {}, "declared_of": None}.items():
        monkeypatch.setattr(mistakes, name, lambda *given, value=value: value)
    monkeypatch.setattr(mistakes, "suspicions", fails)
    trial: Any = SimpleNamespace(calibration=lambda: base)
    search: Any = SimpleNamespace(trial=trial, base=trial, findings=[])
    told = told_mistakes(search, {"words": ["w"], "notices": ["n"]})
    assert told["suspicions"] == []
    assert told["notices"] == [
        "n",
        "mistakes of the declaration were not looked for: channel 'T_1' has no usable samples",
    ]
