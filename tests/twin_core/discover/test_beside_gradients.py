"""The look beside gradients within the nodes: what it fits from where, and when it is asked at all."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks.network_cases import network_case
from tests.twin_core.discover.stubs import JUST, NEEDED, judged, load, stub
from twin_core.calibrate.second_order import fit_network
from twin_core.discover import search as searching
from twin_core.discover import trajectories
from twin_core.discover.evidence import Evidence
from twin_core.discover.judge import Finding, Judged, Search
from twin_core.discover.policy import LEAST_EXCESS
from twin_core.discover.screen import Probe
from twin_core.discover.trial import Trial
from twin_core.effects.base import Effect


@pytest.fixture(autouse=True)
def in_one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Search, "attempt_each", lambda state, works: [work() for work, _ in works])


def test_what_stands_out_is_fitted_from_both_starts_and_the_likeliest_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """One has no solution, one was refused for what it predicts; one that was less likely before is asked again."""
    nats, asked, starts_seen = {"a": 60.0, "b": 90.0}, [], []
    base: Any = stub(left=9.0)
    base.present_effects, base.calibration = (), lambda: "along trajectories"

    def tried(simple: Any, effects: tuple[Effect, ...], *starts: object) -> Any:
        starts_seen.append(starts)
        return None if effects[-1].where["node"] == "c" else stub(*effects)

    def accepted(state: Search, options: Sequence[Judged], needed: float) -> bool:
        asked.extend(options)
        return True

    names = [load(node) for node in "abcd"]
    for name, value in {
        "screened_beside_gradients": lambda trial: (None, [SimpleNamespace(probes=[])]),
        "best_of_each_place": lambda probes, n_samples: [Probe(effect, effect, 99.0) for effect in names],
        "refined": lambda fit, effects: list(effects),
        "starts_beside_gradients": lambda trial: ["along trajectories", "beside gradients"],
        "try_on_trajectories": tried,
        "weigh": lambda simple, rich, n_tried: Evidence(nats[str(rich.effects[-1].where["node"])], 0.0),
        "_settled": lambda state, options, n_tried, needed: [],
        "accept": accepted,
    }.items():
        monkeypatch.setattr(trajectories, name, value)
    state = Search(base, base, rejected=[judged("d", 99.0), replace(judged("b", 99.0), validation=None)])
    assert trajectories.extend_beside_gradients(state, NEEDED)
    assert starts_seen == [("along trajectories", "beside gradients")] * 3
    assert [j.effects[0].where["node"] for j in asked] == ["b", "a"]
    assert state.n_named == 4


def test_nothing_is_asked_where_gradients_have_nothing_to_explain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectories, "screened_beside_gradients", lambda trial: None)
    assert not trajectories.extend_beside_gradients(Search(stub(), stub()), NEEDED)


@pytest.mark.parametrize(
    ("named", "beside", "looks"),
    [(True, True, []), (False, True, ["beside"]), (False, False, ["beside", "without a name"])],
    ids=["found at first", "found beside gradients", "found by neither"],
)
def test_gradients_are_asked_where_nothing_is_found_and_before_a_heat_without_a_name(
    monkeypatch: pytest.MonkeyPatch, looks: list[str], *, named: bool, beside: bool
) -> None:
    asked: list[str] = []

    def find(state: Search) -> bool:
        state.findings.append(Finding(judged("a", 90.0)))
        return True

    def extend(state: Search, needed: float, *, fallback: bool) -> bool:
        asked.extend(["without a name"] * fallback)
        return named and not state.findings and find(state)

    def look(state: Search, needed: float) -> bool:
        asked.append("beside")
        return beside and find(state)

    for name in ("_converge", "complete", "restart", "prune", "withdraw", "reconsider", "tell_alternatives"):
        monkeypatch.setattr(searching, name, lambda state, *needed: None)
    monkeypatch.setattr(searching, "_extend", extend)
    monkeypatch.setattr(searching, "extend_beside_gradients", look)
    monkeypatch.setattr(searching, "_nothing_is_missing", lambda state, needed: False)
    found = searching.search(stub(), false_alarm_rate=0.01)
    assert asked == looks
    assert bool(found.findings) == (named or beside)


@pytest.mark.parametrize(
    ("left", "missing", "is_asked"),
    [(LEAST_EXCESS / 2.0 - JUST, 99.0, False), (LEAST_EXCESS / 2.0, NEEDED, False), (LEAST_EXCESS / 2.0, 99.0, True)],
    ids=["trajectories fit", "no heat is missing", "something is missing"],
)
def test_a_healthy_record_is_not_looked_at_again(
    monkeypatch: pytest.MonkeyPatch, left: float, missing: float, *, is_asked: bool
) -> None:
    asked: list[float] = []
    base: Any = stub(left=left)
    monkeypatch.setattr(searching, "gain_of_undeclared_heat", lambda fit: missing)
    monkeypatch.setattr(searching, "extend_beside_gradients", lambda state, needed: asked.append(needed))
    searching._look_beside_gradients(Search(base, base), NEEDED)
    assert bool(asked) == is_asked


def test_what_the_other_looks_miss_is_named_from_the_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    """A spacecraft integrated by SciPy whose leak nobody declared."""
    case = network_case("leak_to_boundary", 1, n_orbits=3, dt_s=300.0)
    fit, calibration = fit_network(case.spec, [case.record])
    monkeypatch.setattr(searching, "_extend", lambda state, needed, *, fallback: False)
    base = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
    (finding,) = searching.search(base, false_alarm_rate=0.01).findings
    assert [(effect.name, dict(effect.where)) for effect in finding.effects] == [(case.effect, case.where)]
