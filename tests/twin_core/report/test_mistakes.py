"""Mistakes of the declaration in a report: sensors of one node that contradict each other, and a look that fails."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from twin_core.calibrate.suspicions import Looked, Suspicion
from twin_core.errors import TelemetryError
from twin_core.report import mistakes
from twin_core.report.mistakes import Mistakes, contradictions, look_for_mistakes, told_mistakes


def calibration(residual_K: np.ndarray, nodes: dict[str, str]) -> Any:
    """Return a calibration of which sensors, their nodes and what it leaves count."""
    layout = SimpleNamespace(sensor_node=nodes.__getitem__)
    network = SimpleNamespace(spec=SimpleNamespace(sensors=list(nodes)), layout=layout, parameters=None)
    problem = SimpleNamespace(noise_K=np.ones(len(nodes)), network=network, segments=[])
    return SimpleNamespace(network=network, residuals=[residual_K], problem=problem)


@pytest.mark.parametrize(
    ("difference_K", "share", "nodes", "told"),
    [(40.0, 0.91, "aa", 1), (40.0, 0.89, "aa", 0), (40.0, 0.91, "ab", 0), (1.0, 0.91, "aa", 0)],
    ids=["all but a little", "less", "of two nodes", "within some noises"],
)
def test_sensors_of_one_node_that_differ_by_all_that_is_left_are_told(
    difference_K: float, share: float, nodes: str, told: int
) -> None:
    """Half the difference each, and a swing of both: (a + b)² is the difference squared and four times the swing."""
    common_K = np.sqrt((1.0 / share - 1.0) * difference_K**2 / 4.0) * np.where(np.arange(40) % 2, 1.0, -1.0)
    residual = common_K[:, None] + difference_K * np.array([0.5, -0.5])
    made = calibration(residual, {"T_1": nodes[0], "T_2": nodes[1]})
    residual[5, 0] = np.nan
    # 39 samples are left: the swing's mean is no longer zero, but both have the same.
    words = contradictions(made)
    assert len(words) == told
    assert all("'T_1' and 'T_2' read one node, a, and differ by 40 K" in line for line in words)


def test_a_sensor_that_is_off_while_the_model_follows_the_other_is_told() -> None:
    residual = np.random.default_rng(4).normal(size=(4000, 2)) * [0.05, 10.0]
    made = calibration(residual, {"T_1": "a", "T_2": "a"})
    made.problem.noise_K = np.array([0.001, 0.1])
    (words,) = contradictions(made)
    assert "differ by" in words


def test_sensors_that_are_off_independently_contradict_nobody() -> None:
    residual = 50.0 * np.random.default_rng(4).normal(size=(4000, 2))
    assert contradictions(calibration(residual, {"T_1": "a", "T_2": "a"})) == []


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
    told = told_mistakes(search, look_for_mistakes(search), {"words": ["w"], "notices": ["n"]})
    assert told["suspicions"] == []
    assert told["notices"] == [
        "n",
        "mistakes of the declaration were not looked for: channel 'T_1' has no usable samples",
    ]


@pytest.mark.parametrize(
    ("mistake", "misfit", "outdone"),
    [("unit", 0.9, True), ("swapped loads", 0.96, False), ("held value", 0.1, False), ("missing coupling", 0.1, False)],
    ids=["explains more", "explains the same", "frees a parameter", "is missing physics itself"],
)
def test_a_mistake_of_the_data_that_explains_more_outdoes_findings(mistake: str, misfit: float, outdone: bool) -> None:
    """Of what the findings leave; it would add no parameter."""
    left = calibration(np.full((40, 1), 9.0), {"T_1": "a"})
    search: Any = SimpleNamespace(trial=SimpleNamespace(calibration=lambda: left), findings=["one"])
    looked = Looked([Suspicion(mistake, ("T_1",), "in words", 9.0 * misfit, 70.0)], 1, 1, complete=True)
    assert Mistakes(looked).outdo(search) == outdone
    search.findings = []
    assert not Mistakes(looked).outdo(search)
    assert not Mistakes().outdo(search)


@pytest.mark.parametrize("power_W", [0.0, 1.0])
def test_that_nothing_is_heated_comes_before_what_may_come_of_it(
    monkeypatch: pytest.MonkeyPatch, power_W: float
) -> None:
    base = calibration(np.full((40, 1), 9.0), {"T_1": "a"})
    base.network.spec.loads = [SimpleNamespace(channel="P")]
    base.network.spec.channels = {"P": SimpleNamespace(kind="power")}
    base.network.parameters = SimpleNamespace(parameters=[])
    base.problem.segments = [SimpleNamespace(record=SimpleNamespace(values={"P": np.full(40, power_W)}))]
    monkeypatch.setattr(mistakes, "stated_guesses", lambda network: {})
    monkeypatch.setattr(mistakes, "close_words", lambda *given, **named: ["perhaps two sensors are swapped"])
    trial: Any = SimpleNamespace(calibration=lambda: base)
    search: Any = SimpleNamespace(trial=trial, base=trial, findings=[])
    told = told_mistakes(search, Mistakes(Looked([], 1, 1, complete=True)), {"words": [], "notices": []})
    first = ["power channel 'P' is zero throughout"] if power_W == 0.0 else []
    assert [line.split(":")[0] for line in told["notices"]] == [*first, "perhaps two sensors are swapped"]
