"""What two effects together lead to: the one that was added last, alone, from where both were fitted."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.twin_core.discover.stubs import NEEDED, judged, load, stub
from twin_core.discover import trajectories
from twin_core.discover.judge import Judged, Search
from twin_core.discover.trial import Trial


class Fitting:
    """Fits that are looked up; counts what was asked for."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, solved: bool) -> None:
        self.asked: list[tuple[str, ...]] = []
        self.solved = solved
        monkeypatch.setattr(trajectories, "try_on_trajectories", self.tried)
        monkeypatch.setattr(trajectories, "resettled", lambda simple, rich: ("resettled", rich))
        monkeypatch.setattr(trajectories, "_judged", lambda state, trial, n_tried: (trial, n_tried))

    def tried(self, base: Trial, effects: Any, *starts: str) -> str | None:
        self.asked.append((*(e.label for e in effects), *starts))
        return "alone" if self.solved else None


def pair() -> Judged:
    """Return two loads that were fitted together."""
    first, last = load("n0"), load("n1")
    both = SimpleNamespace(present_effects=(first, last), calibration=lambda: "where both are")
    option = judged("n1", 9.0)
    return Judged((first, last), option.evidence, cast(Trial, both))


def state() -> Search:
    base = stub()
    cast(Any, base).present_effects = ()
    found = Search(base, base)
    found.n_named = 70
    return found


def test_the_effect_that_was_added_last_is_tried_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A load that came and went was found beside a gain that it did not need, and both together were refused."""
    fitting = Fitting(monkeypatch, solved=True)
    assert trajectories._alone(state(), pair()) == [(("resettled", "alone"), 70)]
    assert fitting.asked == [("constant_heat_load(n1)", "where both are")]


def test_what_cannot_be_fitted_alone_is_no_option(monkeypatch: pytest.MonkeyPatch) -> None:
    Fitting(monkeypatch, solved=False)
    assert trajectories._alone(state(), pair()) == []


@pytest.mark.parametrize(("n_together", "fallback", "asked"), [(1, False, 0), (2, False, 1), (2, True, 0)])
def test_only_named_effects_together_are_taken_apart(
    monkeypatch: pytest.MonkeyPatch, n_together: int, asked: int, *, fallback: bool
) -> None:
    taken: list[Judged] = []
    monkeypatch.setattr(trajectories, "_alone", lambda state, option: taken.append(option) or [])
    monkeypatch.setattr(trajectories, "_extensions", lambda *a, **k: [(stub(), load("n1"), 5)])
    monkeypatch.setattr(trajectories, "_near_extensions", lambda *a, **k: [])
    monkeypatch.setattr(trajectories, "_fitted", lambda *a, **k: judged("n1", 9.0))
    monkeypatch.setattr(trajectories, "_settled", lambda *a: [])
    monkeypatch.setattr(trajectories, "accept", lambda *a: False)
    trajectories.extend_by_trajectory(state(), NEEDED, [stub()], [], n_together, fallback=fallback)
    assert len(taken) == asked
