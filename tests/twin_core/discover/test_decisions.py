"""The deciding rooms at their boundaries: what is likely enough, what predicts, what stands, and what goes first."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from threading import Barrier, Thread
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twin_core.discover import coarseness, judge, policy, revision, trajectories
from twin_core.discover import search as searching
from twin_core.discover.coarseness import least_explained, stands
from twin_core.discover.confirm import Evidence, Trial, Validation
from twin_core.discover.form import Repeatable
from twin_core.discover.judge import (
    LESS_LIKELY,
    NO_FORESIGHT,
    NO_LAW,
    NO_MORE,
    NOT_SUPPORTED,
    OUTDONE,
    SIZE_NOT_DETERMINED,
    SMALL_REMAINDER,
    Finding,
    Judged,
    Search,
    accept,
    is_close,
    most_left,
    once_each,
    simplest_first,
    threshold,
)
from twin_core.discover.once import once
from twin_core.discover.policy import (
    ALTERNATIVE_NATS,
    DOMINANCE,
    FORESIGHT,
    LEAST_COARSENESS,
    LEAST_EXCESS,
    MOST_COARSENESS,
    REPEATABLE_SHARE,
    THRESHOLDS,
    VISIBLE_COARSENESS,
)
from twin_core.discover.revision import exchange, is_undecided, prune, reconsider, tell_alternatives, withdraw
from twin_core.discover.wald import score_needed
from twin_core.effects import REGISTRY
from twin_core.effects.base import Effect

JUST = 1e-6
NEEDED = 4.6
LEAST, MOST = LEAST_COARSENESS, MOST_COARSENESS
N_READINGS = 5000
CHANCE = VISIBLE_COARSENESS * float(np.sqrt(2.0 / N_READINGS))


@dataclass
class Problem:
    n_free: int


@dataclass
class Fit:
    problem: Problem


@dataclass
class Stub:
    """A trial of which only the excess and the number of its parameters count."""

    effects: tuple[Effect, ...] = ()
    left: float = 0.0
    n_free: int = 3
    n_samples: int = N_READINGS
    foresight: float = 1.0
    fit: Fit = field(init=False)

    def __post_init__(self) -> None:
        self.fit = Fit(Problem(self.n_free))

    def excess(self) -> Any:
        return np.array([2.0 * self.left, 0.0])


def stub(*effects: Effect, left: float = 0.0, n_free: int = 3, foresight: float = 1.0) -> Trial:
    return cast(Trial, Stub(tuple(effects), left, n_free, foresight=foresight))


@pytest.fixture(autouse=True)
def foreseen(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a stub foretells is what it says."""

    def told(simple: Trial, rich: Any) -> Validation:
        return Validation(rich.foresight, 1.0, rich.foresight, 0.1, 1.0)

    monkeypatch.setattr(coarseness, "validate", told)
    monkeypatch.setattr(revision, "validate", told)


def load(node: str) -> Effect:
    return REGISTRY["constant_heat_load"]({"node": node}, {"Q_W": 1.0})


def unnamed() -> Effect:
    """Return an effect that claims no law; of its kind alone counts."""
    return cast(Effect, type("Free", (), {"fallback": True, "place": "n0", "label": "free(n0)"})())


def judged(node: str, nats: float, *, n_free: int = 3, left: float = 0.0, foresight: float = 0.5) -> Judged:
    validation = Validation(foresight, 1.0, foresight, 0.1, 1.0, 1, False)
    return Judged((load(node),), Evidence(nats, 0.0), stub(load(node), left=left, n_free=n_free), validation)


@pytest.mark.parametrize("rate", [0.5, 0.01, 1e-6])
def test_the_odds_of_the_false_alarm_rate_are_asked_for(rate: float) -> None:
    assert np.exp(-threshold(rate)) == pytest.approx(rate)


@pytest.mark.parametrize(
    ("ratio", "forward", "n_sessions", "is_law", "foresight"),
    [
        (0.5, 0.5, 1, True, 0.5),
        (0.25, 1.0, 1, True, 0.5),
        (0.25, 1.0, 1, False, 0.5),
        (0.25, 2.0, 1, True, 4.0 * np.sqrt(0.5)),
        (1.44, 0.25, 1, False, 1.44**2 * 0.6),
        (0.5, 0.7, 3, True, 0.7),
        (0.5, 0.75, 3, True, 0.75),
        (0.5, 0.75 + JUST, 3, True, 1.0),
        (0.5, 0.9, 3, False, np.sqrt(0.45)),
    ],
    ids=[
        "alike",
        "geometric mean",
        "an event",
        "worse at the end",
        "worse on blocks",
        "told between sessions",
        "half of the gain",
        "less than half",
        "event, sessions",
    ],
)
def test_foresight(ratio: float, forward: float, n_sessions: int, is_law: bool, foresight: float) -> None:
    told = Validation(ratio, 1.0, forward, 0.1, 1.0, n_sessions, is_law)
    assert told.foresight == pytest.approx(foresight)


@pytest.mark.parametrize(("nats", "most"), [(0.0, NEEDED), (46.0, NEEDED), (460.0, 46.0)])
def test_what_a_name_may_leave_is_weighed_against_what_it_explains(nats: float, most: float) -> None:
    assert most_left(nats, NEEDED) == pytest.approx(most)
    assert REPEATABLE_SHARE < 1.0


@pytest.mark.parametrize(("behind", "close"), [(0.0, True), (ALTERNATIVE_NATS - JUST, True), (ALTERNATIVE_NATS, False)])
def test_alternatives(behind: float, close: bool) -> None:
    assert is_close(judged("a", 50.0 - behind), judged("b", 50.0)) == close


def test_the_simplest_of_those_that_the_data_hardly_tell_comes_first() -> None:
    options = [judged("a", 50.0, n_free=5), judged("b", 48.0, n_free=3), judged("c", 40.0, n_free=1)]
    assert [j.effects[0].where["node"] for j in simplest_first(options)] == ["b", "a", "c"]


def test_every_set_of_effects_counts_once_at_its_best() -> None:
    kept = once_each([judged("a", 1.0), judged("b", 2.0), judged("a", 3.0)])
    assert [(j.effects[0].where["node"], j.evidence.log_bayes_factor) for j in kept] == [("a", 3.0), ("b", 2.0)]


@pytest.fixture
def examined(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the foresight of an option as it stands, one at node ``form`` for no law, and one at ``x…`` for less likely."""

    def told(simple: Trial, option: Judged, needed: float) -> tuple[Judged, bool]:
        assert option.validation is not None
        if option.effects[0].where["node"].startswith("x"):
            return replace(option, validation=None, reason=LESS_LIKELY), False
        if not option.validation.foresight < FORESIGHT:
            return replace(option, reason=NO_FORESIGHT), False
        is_form = option.effects[0].where["node"] == "form"
        return replace(option, reason=NO_LAW if is_form else ""), is_form

    monkeypatch.setattr(judge, "examine", told)


@pytest.mark.usefixtures("examined")
@pytest.mark.parametrize(
    ("options", "named", "reasons"),
    [
        ([judged("a", NEEDED + JUST)], "a", []),
        ([judged("a", NEEDED)], None, [NOT_SUPPORTED]),
        ([judged("a", 90.0, foresight=FORESIGHT)], None, [NO_FORESIGHT]),
        ([judged("a", 90.0, foresight=FORESIGHT - JUST)], "a", []),
        ([judged("a", 90.0, foresight=0.99), judged("b", 60.0)], "b", [NO_FORESIGHT]),
        ([judged("a", 90.0), judged("b", 60.0)], "a", []),
        ([judged("form", 90.0), judged("b", 60.0)], None, [NO_LAW]),
        ([judged("form", 90.0), judged("b", 3.0)], None, [NO_LAW, NOT_SUPPORTED]),
        ([*(judged(f"x{i}", 90.0 - i) for i in range(5)), judged("b", 60.0)], "b", [LESS_LIKELY] * 5),
        ([*(judged(f"a{i}", 90.0 - i, foresight=1.0) for i in range(8)), judged("b", 60.0)], None, [NO_FORESIGHT] * 8),
    ],
    ids=[
        "likely",
        "at the odds",
        "no better",
        "hardly better",
        "the next",
        "the likeliest",
        "no law",
        "nothing else",
        "what is seen at once costs nothing",
        "so many are validated",
    ],
)
def test_what_is_accepted(options: list[Judged], named: str | None, reasons: list[str]) -> None:
    state = Search(stub(left=9.0), stub(left=9.0))
    assert accept(state, options, NEEDED) == (named is not None)
    assert [f.effects[0].where["node"] for f in state.findings] == ([] if named is None else [named])
    assert [j.reason for j in state.rejected] == reasons


@pytest.mark.usefixtures("examined")
@pytest.mark.parametrize(
    ("left", "named", "rejected"),
    [((7.0, 0.5), "b", [("a", NO_MORE)]), ((7.0, 7.0), "a", [("b", NO_MORE)]), ((0.5, 0.0), "a", [])],
    ids=["one that stands", "none that does", "the likeliest stands"],
)
def test_what_would_be_withdrawn_is_named_where_no_other_one_passes(
    left: tuple[float, float], named: str, rejected: list[tuple[str, str]]
) -> None:
    state = Search(stub(left=9.0), stub(left=9.0))
    assert accept(state, [judged("a", 90.0, left=left[0]), judged("b", 60.0, left=left[1])], NEEDED)
    assert [f.effects[0].where["node"] for f in state.findings] == [named]
    assert [(j.effects[0].where["node"], j.reason) for j in state.rejected] == rejected
    assert not state.findings[0].alternatives


@pytest.mark.parametrize(
    ("before", "left", "kept"),
    [
        (2.0 * CHANCE, CHANCE, True),
        (DOMINANCE * LEAST + 0.5, 0.5, True),
        (DOMINANCE * LEAST + 0.5 - JUST, 0.5, False),
        (50.0 + DOMINANCE * MOST - JUST, 50.0, False),
    ],
    ids=["fits to the noise", "just enough", "too little", "beside what is no coarseness"],
)
def test_open_loop_residuals_are_asked_too_where_a_name_would_be_withdrawn(
    before: float, left: float, kept: bool
) -> None:
    assert stands(stub(left=before), stub(load("n0"), left=left)) == kept


@pytest.mark.parametrize("foresight", [1.0, 0.8, DOMINANCE**-0.5, 0.6, 0.3])
def test_what_foretells_has_less_to_explain(monkeypatch: pytest.MonkeyPatch, foresight: float) -> None:
    """In proportion to the variance that it leaves of what it was not fitted to, from half of it on."""
    asked = DOMINANCE * LEAST * min(1.0, DOMINANCE * foresight**2)
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(0.0, 1.0))
    for more, kept in ((JUST, True), (-JUST, False)):
        rich = stub(load("n0"), left=0.5, foresight=foresight)
        simple = stub(left=0.5 + asked + more)
        assert stands(simple, rich) == kept
        state = Search(rich, simple, findings=[Finding(judged("n0", 50.0))])
        withdraw(state, NEEDED)
        assert bool(state.findings) == kept


def test_what_cannot_be_computed_is_not_foretold(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(simple: Trial, rich: Trial) -> Validation:
        raise np.linalg.LinAlgError

    monkeypatch.setattr(coarseness, "validate", fails)
    assert coarseness.foretold(stub(), stub(load("n0"))) == 1.0


@pytest.mark.parametrize(
    ("explained", "left", "kept"),
    [
        ([5.0, 0.2], 0.0, ["n0", "n1"]),
        ([9.0, DOMINANCE * CHANCE], CHANCE, ["n0", "n1"]),
        ([9.0, DOMINANCE * LEAST], 2.0 * CHANCE, ["n0", "n1"]),
        ([9.0, DOMINANCE * LEAST - JUST], 2.0 * CHANCE, ["n0"]),
        ([0.2, 9.0], 0.5, ["n1"]),
        ([2.0, 2.5], 0.5, []),
        ([DOMINANCE * MOST, 900.0], 50.0, ["n0", "n1"]),
        ([DOMINANCE * MOST - JUST, 900.0], 50.0, ["n1"]),
    ],
    ids=[
        "fits to the noise",
        "by chance",
        "just enough",
        "too little",
        "the weakest",
        "each beside the other",
        "coarsest",
        "within it",
    ],
)
def test_what_explains_no_more_than_what_stays_is_withdrawn(
    monkeypatch: pytest.MonkeyPatch, explained: list[float], left: float, kept: list[str]
) -> None:
    """What a withdrawn finding explained is unexplained from then on."""
    own = {f"n{i}": value for i, value in enumerate(explained)}

    def refitted(effects: tuple[Effect, ...]) -> Trial:
        names = {e.where["node"] for e in effects}
        return stub(*effects, left=left + sum(value for name, value in own.items() if name not in names))

    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: refitted(tuple(effects)))
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(0.0, 1.0))
    state = Search(refitted(tuple(load(name) for name in own)), refitted(()))
    state.findings = [Finding(judged(name, 50.0)) for name in own]
    withdraw(state, NEEDED)
    assert [f.effects[0].where["node"] for f in state.findings] == kept
    assert [e.where["node"] for e in state.trial.effects] == kept
    assert all(j.reason == NO_MORE for j in state.rejected) and len(state.rejected) == len(own) - len(kept)


def test_a_model_without_a_finding_is_fitted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pruning and withdrawing ask for the same fits; another trial asks for its own."""
    fitted: list[tuple[str, ...]] = []

    def refitted(effects: tuple[Effect, ...]) -> Trial:
        names = tuple(e.where["node"] for e in effects)
        fitted.append(names)
        return stub(*effects, left=9.0 * (2 - len(names)))

    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: refitted(tuple(effects)))
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(50.0, 1.0))
    state = Search(stub(load("a"), load("b"), left=0.5), stub(left=18.0))
    state.findings = [Finding(judged("a", 50.0)), Finding(judged("b", 50.0))]
    prune(state, NEEDED)
    withdraw(state, NEEDED)
    assert [f.effects[0].where["node"] for f in state.findings] == ["a", "b"]
    once = [("a",), ("a",), ("b",), ("b",)]  # from the model with both, and from the one with none
    assert sorted(fitted) == once
    state.trial = stub(load("a"), load("b"), left=0.6)
    withdraw(state, NEEDED)
    assert sorted(fitted) == sorted(2 * once)


def test_without_a_finding_the_search_is_where_it_was_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was fitted beside another effect may be caught far from where it belongs alone: its own fit is kept."""

    def caught(trial: Trial, effects: Sequence[Effect], n_passes: int) -> Trial:
        return stub(*effects, left=9.0)

    monkeypatch.setattr(revision, "try_effects", caught)
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(50.0, 1.0))
    before = stub(load("a"), left=1.5)
    state = Search(stub(load("a"), load("b"), left=0.5), stub(left=18.0), past=(stub(left=18.0), before))
    state.findings = [Finding(judged("a", 50.0)), Finding(judged("b", 50.0))]
    withdraw(state, NEEDED)
    assert state.trial is before and [f.effects[0].where["node"] for f in state.findings] == ["a"]


def test_what_was_compared_with_a_set_is_no_alternative_to_what_stays_of_it() -> None:
    pair, other = judged("a", 50.0), judged("c", 49.0)
    pair = replace(pair, effects=(load("a"), load("b")))
    alike = replace(pair, effects=(load("a"), load("d")))
    left = Finding(pair, (alike, other)).without(load("b").place, 20.0, stub(load("a")))
    assert [e.where["node"] for e in left.effects] == ["a"] and left.alternatives == (other,)


@pytest.mark.parametrize(
    ("nats", "explains", "reason", "foresight", "kept"),
    [
        (NEEDED + JUST, LEAST_EXCESS + JUST, NO_FORESIGHT, 2.0, ["a", "b"]),
        (NEEDED, 9.0, "", 0.5, ["a"]),
        (90.0, LEAST_EXCESS - JUST, "", 0.5, ["a"]),
        (NEEDED, 9.0, SIZE_NOT_DETERMINED, 0.5, []),
        (NEEDED, 9.0, NO_FORESIGHT, 1.0 - JUST, ["a"]),
        (NEEDED, 9.0, NO_FORESIGHT, 1.0, []),
    ],
    ids=["enough", "hardly supported", "next to nothing", "nothing by itself", "no worse by itself", "worse by itself"],
)
def test_beside_the_others_each_must_be_supported_and_explain_something(
    monkeypatch: pytest.MonkeyPatch, nats: float, explains: float, reason: str, foresight: float, kept: list[str]
) -> None:
    """The search would not look for less: it is no finding because it came with another, which stands alone or not at all."""
    own = {"a": 9.0, "b": 0.5 * explains}  # at one sensor of two twice as much as in the mean
    support = {"a": 90.0, "b": nats}

    def refitted(effects: Sequence[Effect]) -> Trial:
        names = {str(e.where["node"]) for e in effects}
        return stub(*effects, left=sum(value for name, value in own.items() if name not in names))

    def weighed(simple: Trial, rich: Trial, n_tried: int) -> Evidence:
        (lost,) = {str(e.where["node"]) for e in rich.effects} - {str(e.where["node"]) for e in simple.effects}
        return Evidence(support[lost], 0.0)

    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: refitted(effects))
    monkeypatch.setattr(revision, "weigh", weighed)
    told = Validation(foresight, 1.0, foresight, 0.1, 1.0, 1, False)
    monkeypatch.setattr(
        revision, "examine", lambda simple, option, needed: (replace(option, validation=told, reason=reason), False)
    )
    pair = refitted((load("a"), load("b")))
    state = Search(pair, refitted(()), findings=[Finding(Judged(pair.effects, Evidence(99.0, 0.0), pair))])
    prune(state, NEEDED)
    assert [e.where["node"] for f in state.findings for e in f.effects] == kept
    assert [e.where["node"] for e in state.trial.effects] == kept


def test_without_its_thresholds_nothing_is_withdrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """As an ablation sets them."""
    monkeypatch.setattr(policy, "DOMINANCE", THRESHOLDS["DOMINANCE"].off)
    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: stub(*effects, left=1.0))
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(0.0, 1.0))
    state = Search(stub(load("n0"), left=1.0), stub(left=1.0), findings=[Finding(judged("n0", 50.0))])
    withdraw(state, NEEDED)
    assert state.findings


@pytest.mark.parametrize(
    ("own", "reason", "kept"),
    [
        ((DOMINANCE * LEAST - JUST, 90.0), "", ["n1"]),
        ((DOMINANCE * LEAST - JUST, 90.0), SMALL_REMAINDER, ["n1"]),
        ((DOMINANCE * LEAST - JUST, 90.0), NO_FORESIGHT, []),
        ((DOMINANCE * LEAST, DOMINANCE * LEAST), NO_FORESIGHT, ["n0", "n1"]),
    ],
    ids=["one too little", "the other leaves little", "the other is nothing by itself", "both enough"],
)
def test_of_effects_found_together_each_must_explain_something(
    monkeypatch: pytest.MonkeyPatch, own: tuple[float, float], reason: str, kept: list[str]
) -> None:
    """Both together explain enough, in a network that is hardly seen to be coarse; what is left alone is examined anew."""
    parts, left = {"n0": own[0], "n1": own[1]}, 2.0 * CHANCE

    def refitted(effects: tuple[Effect, ...]) -> Trial:
        names = {e.where["node"] for e in effects}
        return stub(*effects, left=left + sum(value for name, value in parts.items() if name not in names))

    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: refitted(tuple(effects)))
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(0.0, 1.0))
    asked: list[tuple[Effect, ...]] = []

    def examined(simple: Trial, option: Judged, needed: float) -> tuple[Judged, bool]:
        asked.append(option.effects)
        return replace(option, reason=reason), False

    monkeypatch.setattr(revision, "examine", examined)
    both = (load("n0"), load("n1"))
    state = Search(refitted(both), refitted(()))
    state.findings = [Finding(Judged(both, Evidence(50.0, 0.0), state.trial))]
    withdraw(state, NEEDED)
    assert [effect.where["node"] for finding in state.findings for effect in finding.effects] == kept
    assert asked == ([] if len(kept) == 2 else [both[1:]])


@pytest.mark.parametrize(("explained", "stands"), [(DOMINANCE * 50.0, True), (DOMINANCE * 50.0 - JUST, False)])
def test_beside_a_heat_without_a_name_all_that_stays_counts(
    monkeypatch: pytest.MonkeyPatch, explained: float, stands: bool
) -> None:
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(0.0, 1.0))
    free = unnamed()
    option = Judged((free,), Evidence(50.0, 0.0), stub(free))
    state = Search(stub(free, left=50.0), stub(left=50.0 + explained))
    state.findings = [Finding(option)]
    withdraw(state, NEEDED)
    assert bool(state.findings) == stands


SCORE = score_needed(NEEDED)


@pytest.mark.parametrize(
    ("change", "score", "reason"),
    [(0.0, SCORE, ""), (-JUST, SCORE, LESS_LIKELY), (0.0, SCORE - JUST, SIZE_NOT_DETERMINED)],
    ids=["both are enough", "less likely along its trajectories", "of no size"],
)
def test_a_correction_is_told_by_its_own_trajectories(
    monkeypatch: pytest.MonkeyPatch, change: float, score: float, reason: str
) -> None:
    """However much heat that wanders at the nodes may speak for it."""
    option = judged("a", 900.0)
    along = {True: 5.0, False: 5.0 + change}
    simple = stub()
    monkeypatch.setattr(
        Stub, "calibration", lambda own: SimpleNamespace(log_posterior=along[own is simple]), raising=False
    )
    monkeypatch.setattr(judge, "validate", lambda *trials: option.validation)
    monkeypatch.setattr(judge, "least_wald_score", lambda *trials: score)
    monkeypatch.setattr(judge, "_merely_resembles", lambda *arguments: "")
    assert judge.examine(simple, option, NEEDED)[0].reason == reason


@pytest.mark.parametrize(("rate", "score"), [(0.05, 1.959964), (0.01, 2.575829), (0.001, 3.290527)])
def test_the_score_asked_for_is_that_of_normal_tables(rate: float, score: float) -> None:
    assert score_needed(threshold(rate)) == pytest.approx(score, abs=1e-6)


SMALL = REPEATABLE_SHARE * (10.0 - 1.0)


@pytest.mark.parametrize(
    ("beside", "instead", "left", "reason"),
    [
        (None, None, 1.0, ""),
        (SMALL, None, 1.0, SMALL_REMAINDER),
        (None, SMALL, 1.0, SMALL_REMAINDER),
        (SMALL + JUST, None, 1.0, NO_LAW),
        (0.1, SMALL + JUST, 1.0, NO_LAW),
        (MOST_COARSENESS, None, 9000.0, SMALL_REMAINDER),
        (MOST_COARSENESS + JUST, None, 9000.0, NO_LAW),
    ],
    ids=["a law", "little beside it", "little better", "beside it", "better", "as coarse as can be", "coarser"],
)
def test_what_a_name_leaves_is_weighed_against_what_it_removes(
    monkeypatch: pytest.MonkeyPatch, beside: float | None, instead: float | None, left: float, reason: str
) -> None:
    option = judged("a", 90.0, left=1.0)
    simple = stub(left=10.0 if left == 1.0 else left)
    found = Repeatable() if beside is None else Repeatable(9e9, beside)
    monkeypatch.setattr(judge, "acts_at", lambda *arguments: {"a"})
    monkeypatch.setattr(judge, "repeatable_heat", lambda *arguments: found)
    monkeypatch.setattr(judge, "outdone_by_a_free_form", lambda *arguments: instead)
    monkeypatch.setattr(judge, "more_is_left_elsewhere", lambda *arguments: False)
    assert judge._merely_resembles(simple, option, NEEDED) == reason
    monkeypatch.setattr(judge, "more_is_left_elsewhere", lambda *arguments: True)
    assert judge._merely_resembles(simple, option, NEEDED) == ""


def test_beside_much_that_stays_as_large_a_share_is_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """What stays beside name and heat is no coarseness: a heat of a share of it does not tell the law wrong."""
    option = judged("a", 90.0, left=100.0)
    monkeypatch.setattr(judge, "acts_at", lambda *arguments: {"a"})
    monkeypatch.setattr(judge, "outdone_by_a_free_form", lambda *arguments: None)
    monkeypatch.setattr(judge, "more_is_left_elsewhere", lambda *arguments: False)
    at_most = REPEATABLE_SHARE * 100.0 / (1.0 + REPEATABLE_SHARE)
    for removed, reason in ((at_most - JUST, SMALL_REMAINDER), (at_most + JUST, NO_LAW)):
        monkeypatch.setattr(judge, "repeatable_heat", lambda *a, removed=removed: Repeatable(9e9, removed))
        assert judge._merely_resembles(stub(left=9000.0), option, NEEDED) == reason


def test_beside_a_sensors_effect_a_heat_may_be_left() -> None:
    """Only one that explains the readings better in its place speaks against it."""
    lag = REGISTRY["sensor_lag"]({"sensor": "T"}, {"tau_s": 30.0})
    option = Judged((lag,), Evidence(90.0, 0.0), stub(lag))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(judge, "more_is_left_elsewhere", lambda *arguments: False)
        patch.setattr(judge, "repeatable_heat", lambda *arguments: Repeatable(9e9, 1e9))
        patch.setattr(judge, "outdone_by_a_free_form", lambda *arguments: None)
        assert judge._merely_resembles(stub(left=10.0), option, NEEDED) == ""
        patch.setattr(judge, "outdone_by_a_free_form", lambda *arguments: 1e9)
        assert judge._merely_resembles(stub(left=10.0), option, NEEDED) == NO_LAW


@pytest.mark.parametrize(
    ("foresight", "nats", "names"),
    [
        (None, 0.0, ["a"]),
        (0.5 / FORESIGHT + JUST, 900.0, ["a"]),
        (0.5 / FORESIGHT - JUST, 900.0, ["f"]),
        (0.5 * FORESIGHT + JUST, 90.0 - JUST, ["a"]),
        (0.5 * FORESIGHT + JUST, 90.0, ["f"]),
        (0.5 * FORESIGHT - JUST, 0.0, ["f"]),
    ],
    ids=["no heat", "predicts better", "as well, less likely", "as well, likelier", "as likely", "predicts worse"],
)
def test_what_leaves_little_is_named_where_no_heat_predicts_as_well(
    foresight: float | None, nats: float, names: list[str]
) -> None:
    state = Search(stub(), stub())
    if foresight is not None:
        state.findings = [Finding(replace(judged("f", nats, foresight=foresight), effects=(unnamed(),)))]
    likely, less = (replace(judged(node, nats), reason=SMALL_REMAINDER) for node, nats in (("a", 90.0), ("b", 60.0)))
    state.rejected = [replace(judged("c", 99.0), reason=NO_LAW), less, likely]
    reconsider(state, NEEDED)
    named = names == ["a"]
    assert [effect.fallback for f in state.findings for effect in f.effects] == [not named]
    assert [j.effects[0].where["node"] for j in state.rejected] == (["c", "b"] if named else ["c", "b", "a"])
    assert (state.trial is likely.trial) == named


@pytest.mark.parametrize(
    ("nats", "foresight", "names"),
    [
        (90.0, 0.5, ["a"]),
        (60.0, 0.5, ["f"]),
        (90.0, 0.7, ["f"]),
    ],
    ids=["likelier and predicts better", "less likely", "predicts worse"],
)
def test_no_name_stands_that_one_refused_for_the_little_it_leaves_excels(
    nats: float, foresight: float, names: list[str]
) -> None:
    """Less likely, and it predicts worse: what the other one leaves is no reason to name this one."""
    found = judged("f", 70.0, foresight=0.6)
    state = Search(found.trial, stub(), findings=[Finding(found)])
    state.rejected = [replace(judged("a", nats, foresight=foresight), reason=SMALL_REMAINDER)]
    reconsider(state, NEEDED)
    assert [f.effects[0].where["node"] for f in state.findings] == names
    assert [j.reason for j in state.rejected] == ([OUTDONE] if names == ["a"] else [SMALL_REMAINDER])


def test_what_stands_in_part_only_gives_way_to_what_stands_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the likelier pair one effect explains next to nothing: its other half is no answer to what the pair was found for."""
    left = 2.0 * CHANCE

    def refitted(effects: Sequence[Effect]) -> Trial:
        names = {str(e.where["node"]) for e in effects}
        return stub(*effects, left=left + (0.0 if names & {"a", "c"} else 99.0))

    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: refitted(effects))
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(0.0, 1.0))
    monkeypatch.setattr(revision, "examine", lambda simple, judged, needed: (judged, False))
    both = (load("a"), load("b"))
    pair = Judged(both, Evidence(99.0, 0.0), refitted(both), None, SMALL_REMAINDER)
    single = Judged((load("c"),), Evidence(70.0, 0.0), refitted([load("c")]), None, SMALL_REMAINDER)
    state = Search(refitted(()), refitted(()), rejected=[pair, single])
    reconsider(state, NEEDED)
    assert [e.where["node"] for f in state.findings for e in f.effects] == ["c"]
    assert pair in state.rejected and single not in state.rejected


def kind_at(kind: str, node: str, nats: float, reason: str = "") -> Judged:
    effect = REGISTRY[kind]({"node": node}, {})
    return Judged((effect,), Evidence(nats, 0.0), stub(effect), None, reason)


@pytest.mark.parametrize(
    ("option", "alone", "reason", "named"),
    [
        (kind_at("thermostat_heater", "n0", 90.0), 30.0 + NEEDED + JUST, "", "thermostat_heater"),
        (kind_at("thermostat_heater", "n0", 90.0), 30.0 + NEEDED, "", "heat_load_step"),
        (kind_at("thermostat_heater", "n0", 90.0), 99.0, NO_LAW, "heat_load_step"),
        (kind_at("thermostat_heater", "n0", 20.0), 99.0, "", "heat_load_step"),
        (kind_at("thermostat_heater", "n1", 90.0), 99.0, "", "heat_load_step"),
    ],
    ids=["explains more", "hardly more", "is no law", "was worth less beside it", "acts elsewhere"],
)
def test_what_was_refused_beside_a_finding_may_stand_in_its_place(
    monkeypatch: pytest.MonkeyPatch, option: Judged, alone: float, reason: str, named: str
) -> None:
    monkeypatch.setattr(revision, "touched_nodes", lambda effect, layout: {effect.where["node"]})
    monkeypatch.setattr(revision, "_attempted_without", lambda state, places: (stub(), 30.0))
    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: stub(*effects))
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(alone, 0.0))
    monkeypatch.setattr(revision, "examine", lambda simple, judged, needed: (replace(judged, reason=reason), False))
    found = kind_at("heat_load_step", "n0", 30.0)
    cast(Any, found.trial.fit).network = SimpleNamespace(layout=None)
    refused = replace(option, reason=NO_FORESIGHT)
    state = Search(found.trial, stub(), findings=[Finding(found)], rejected=[refused])
    assert exchange(state, [refused], NEEDED) == (named != "heat_load_step")
    assert [f.effects[0].name for f in state.findings] == [named] == [e.name for e in state.trial.effects]
    assert [j.reason for j in state.rejected] == ([NO_FORESIGHT] if named == "heat_load_step" else [OUTDONE])


@pytest.mark.parametrize(
    ("nats", "reason", "node", "left", "added", "undecided"),
    [
        (30.0 + NEEDED + JUST, SIZE_NOT_DETERMINED, "n1", 2.0 + JUST, NEEDED, True),
        (30.0 + NEEDED + JUST, SIZE_NOT_DETERMINED, "n1", 2.0 + JUST, NEEDED + JUST, False),
        (30.0 + NEEDED + JUST, SIZE_NOT_DETERMINED, "n1", 2.0, NEEDED, False),
        (30.0 + NEEDED, SIZE_NOT_DETERMINED, "n1", 9.0, 0.0, False),
        (90.0, NO_FORESIGHT, "n1", 9.0, 0.0, False),
        (90.0, SIZE_NOT_DETERMINED, "n0", 9.0, 0.0, False),
    ],
    ids=["explains it", "leaves some", "explains no less", "hardly likelier", "predicts nothing", "is the same"],
)
def test_a_name_that_adds_nothing_to_a_likelier_one_of_unknown_size_is_none(
    monkeypatch: pytest.MonkeyPatch, nats: float, reason: str, node: str, left: float, added: float, undecided: bool
) -> None:
    """The other one leaves one noise variance, the finding more."""
    weighed: list[tuple[Trial, Trial]] = []

    def weigh(simple: Trial, rich: Trial, n_tried: int) -> Evidence:
        weighed.append((simple, rich))
        return Evidence(added, 0.0)

    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: stub(*effects))
    monkeypatch.setattr(revision, "weigh", weigh)
    found, option = kind_at("constant_heat_load", "n0", 30.0), kind_at("constant_heat_load", node, nats, reason)
    option = replace(option, trial=stub(*option.effects, left=1.0))
    state = Search(stub(*found.effects, left=left), stub(), findings=[Finding(found)])
    assert is_undecided(state, [option], NEEDED) == undecided
    for simple, rich in weighed:
        assert simple is option.trial and [e.where["node"] for e in rich.effects] == [node, "n0"]


@pytest.mark.parametrize(
    ("nats", "alone", "reason", "leads"),
    [
        (60.0 + NEEDED + JUST, 60.0 + NEEDED + JUST, "", "boundary_mix"),
        (60.0 + NEEDED, 99.0, "", "constant_heat_load"),
        (90.0, 60.0 + NEEDED, "", "constant_heat_load"),
        (90.0, 99.0, NO_FORESIGHT, "constant_heat_load"),
    ],
    ids=["likelier", "hardly likelier", "refitted hardly likelier", "predicts no better"],
)
def test_the_likeliest_of_the_names_that_cannot_be_told_apart_leads(
    monkeypatch: pytest.MonkeyPatch, nats: float, alone: float, reason: str, leads: str
) -> None:
    """The finding that it takes the place of is among its alternatives then, and not refused."""
    found, other = judged("a", 60.0), judged("b", 10.0)
    mix = REGISTRY["boundary_mix"]({"boundary": "bus"}, {"alpha": 0.5, "T_w_K": 280.0})
    option = Judged((mix,), Evidence(nats, 0.0), stub(mix))
    told = Finding(found, (option, other))
    monkeypatch.setattr(revision, "add_coarse_alternatives", lambda state, simple, finding, needed: told)
    monkeypatch.setattr(revision, "_attempted_without", lambda state, places: (stub(), 60.0))
    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: stub(*effects))
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(alone, 0.0))
    monkeypatch.setattr(revision, "examine", lambda simple, judged, needed: (replace(judged, reason=reason), False))
    state = Search(found.trial, stub(), findings=[Finding(found)])
    tell_alternatives(state, NEEDED)
    (finding,) = state.findings
    assert [e.name for e in finding.effects] == [leads] == [e.name for e in state.trial.effects]
    names = [a.effects[0].name for a in finding.alternatives]
    assert names == (["constant_heat_load"] * 2 if leads == "boundary_mix" else ["boundary_mix", "constant_heat_load"])
    assert state.rejected == []


@pytest.mark.parametrize(
    ("alone", "reason", "leads"),
    [(NEEDED + JUST, "", "constant_heat_load"), (NEEDED, "", "boundary_mix"), (50.0, NO_LAW, "boundary_mix")],
    ids=["supported", "not supported", "no law"],
)
def test_the_simplest_of_the_names_that_cannot_be_told_apart_leads(
    monkeypatch: pytest.MonkeyPatch, alone: float, reason: str, leads: str
) -> None:
    """Less likely by many nats, which say little where both explain as much: of the simple ones the likelier leads."""
    mix = REGISTRY["boundary_mix"]({"boundary": "bus"}, {"alpha": 0.5, "T_w_K": 280.0})
    found = Judged((mix,), Evidence(90.0, 0.0), stub(mix))
    told = Finding(found, (judged("a", 60.0), judged("b", 10.0)))
    monkeypatch.setattr(revision, "add_coarse_alternatives", lambda state, simple, finding, needed: told)
    monkeypatch.setattr(revision, "_attempted_without", lambda state, places: (stub(), 90.0))
    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: stub(*effects))
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(alone, 0.0))
    monkeypatch.setattr(revision, "examine", lambda simple, judged, needed: (replace(judged, reason=reason), False))
    state = Search(found.trial, stub(), findings=[Finding(found)])
    tell_alternatives(state, NEEDED)
    (finding,) = state.findings
    assert [e.name for e in finding.effects] == [leads]
    names = [a.effects[0].name for a in finding.alternatives]
    assert names == (["boundary_mix", "constant_heat_load"] if leads != "boundary_mix" else ["constant_heat_load"] * 2)
    if leads == "constant_heat_load":
        assert finding.effects[0].where == {"node": "a"}


@pytest.mark.parametrize(
    ("left", "foresight", "leads"),
    [(2.0 - JUST, 0.9 * FORESIGHT - JUST, "b"), (2.0 - JUST, 0.9 * FORESIGHT, "a"), (2.0, 0.1, "a")],
    ids=["predicts better", "hardly better", "leaves as much"],
)
def test_of_names_alike_the_one_leads_that_leaves_less_and_predicts_better(
    monkeypatch: pytest.MonkeyPatch, left: float, foresight: float, leads: str
) -> None:
    """However little the evidence speaks for it: where a network is coarse, nats say little."""
    found = judged("a", 90.0)
    option = judged("b", 40.0, left=left, foresight=foresight)
    told = Finding(found, (option,))
    trials = {"b": option.trial}
    monkeypatch.setattr(revision, "add_coarse_alternatives", lambda state, simple, finding, needed: told)
    monkeypatch.setattr(revision, "_attempted_without", lambda state, places: (stub(), 90.0))
    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: trials[effects[0].where["node"]])
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(40.0, 0.0))
    monkeypatch.setattr(
        revision, "examine", lambda simple, judged, needed: (replace(judged, validation=option.validation), False)
    )
    state = Search(stub(load("a"), left=2.0, foresight=0.9), stub(), findings=[Finding(found)])
    tell_alternatives(state, NEEDED)
    (finding,) = state.findings
    assert [e.where["node"] for e in finding.effects] == [leads]
    assert [a.effects[0].where["node"] for a in finding.alternatives] == [{"a": "b", "b": "a"}[leads]]


def test_nothing_is_named_that_was_tried_beside_what_no_longer_stands() -> None:
    state = Search(stub(), stub())
    option = judged("a", 90.0)
    state.rejected = [replace(option, trial=stub(load("a"), load("b")), reason=SMALL_REMAINDER)]
    reconsider(state, NEEDED)
    assert not state.findings


@given(st.floats(0.0, 1e6), st.floats(1.0, 2.0), st.integers(10, 10**7))
def test_what_a_name_must_explain_grows_with_what_stays_without_a_cliff(left: float, factor: float, n: int) -> None:
    """It never grows faster than it does where a network begins to be seen as coarse."""
    least, more = (least_explained(value, value, n) for value in (left, left * factor))
    steepest = DOMINANCE * max(1.0, LEAST / (VISIBLE_COARSENESS * np.sqrt(2.0 / n)))
    assert 0.0 <= least <= more <= DOMINANCE * MOST
    assert more - least <= steepest * (factor - 1.0) * left * (1.0 + 1e-9)


def test_thresholds_are_few_and_each_says_what_it_is() -> None:
    stated = {name for name, value in vars(policy).items() if name.isupper() and isinstance(value, float)}
    assert stated == set(THRESHOLDS) and len(stated) <= 12
    for name, about in THRESHOLDS.items():
        assert about.unit and about.asks and about.origin, name
        assert len({about.off, about.half, about.double, getattr(policy, name)}) == 4, name


def test_a_costly_value_is_computed_once_and_holds_up_no_other_object() -> None:
    both, calls = Barrier(2, timeout=20.0), list[int]()

    class Costly:
        @once
        def value(self) -> int:
            both.wait()  # passes only while the other object is at it too
            calls.append(1)
            return 7

    objects = (Costly(), Costly())
    threads = [Thread(target=thing.value) for thing in objects]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=30.0)
    assert [thing.value() for thing in objects] == [7, 7] and len(calls) == 2


@pytest.mark.parametrize(
    ("reason", "is_kept"),
    [(NO_FORESIGHT, True), (LESS_LIKELY, True), (SIZE_NOT_DETERMINED, True), (NOT_SUPPORTED, False), (NO_LAW, False)],
)
def test_what_may_show_beside_another_effect_only_is_tried_with_others(reason: str, is_kept: bool) -> None:
    single, likelier = (replace(judged(node, nats), reason=reason) for node, nats in (("a", 50.0), ("b", 90.0)))
    both = replace(likelier, effects=(load("a"), load("b")), evidence=Evidence(200.0, 0.0), reason=reason)
    kept = searching._unseen_by_trajectories([single, both, likelier])
    assert [trial is likelier.trial for trial in kept] == ([True] if is_kept else [])


@pytest.mark.parametrize(("nats", "is_settled"), [(NEEDED - 40.0 + JUST, True), (NEEDED - 40.0, False), (90.0, True)])
def test_an_option_is_settled_that_may_become_likely(
    monkeypatch: pytest.MonkeyPatch, nats: float, is_settled: bool
) -> None:
    option, settled = judged("a", nats), judged("a", 200.0).trial
    monkeypatch.setattr(trajectories, "resettled", lambda simple, trial: settled)
    monkeypatch.setattr(trajectories, "weigh", lambda *arguments: Evidence(200.0, 0.0))
    found = trajectories._settled(Search(stub(), stub()), [option], 1, NEEDED)
    assert [j.trial for j in found] == ([settled] if is_settled else [])


@pytest.mark.parametrize(
    ("nats", "kept"),
    [(None, "first"), (-1.0, "first"), (0.0, "first"), (JUST, "settled")],
    ids=["no answer", "less likely", "as likely", "likelier"],
)
def test_a_finding_goes_on_from_the_likelier_of_its_fits(
    monkeypatch: pytest.MonkeyPatch, nats: float | None, kept: str
) -> None:
    """What is tried beside it is weighed against that fit."""

    def fitted(watts: float, log_posterior: float) -> Trial:
        effect = REGISTRY["constant_heat_load"]({"node": "a"}, {"Q_W": watts})
        trial = Stub((load("known"), effect))
        trial.fit = cast(Any, SimpleNamespace(problem=Problem(3), log_posterior=log_posterior))
        return cast(Trial, trial)

    def resettled(simple: Trial, rich: Trial) -> Trial:
        assert (simple, rich) == (before, first)
        if nats is None:
            raise np.linalg.LinAlgError
        return fitted(2.0, nats)

    before, first = stub(load("known")), fitted(1.0, 0.0)
    monkeypatch.setattr(searching, "resettled", resettled)
    monkeypatch.setattr(searching, "weigh", lambda simple, rich, n_tried: Evidence(70.0 + n_tried, 0.0))
    found = Judged(first.effects[1:], Evidence(50.0, 0.0), first)
    state = Search(first, before, findings=[Finding(found)])
    searching._settle(state, before, 7)
    (finding,) = state.findings
    assert state.trial is finding.judged.trial
    assert [e.values["Q_W"] for e in finding.effects] == [2.0 if kept == "settled" else 1.0]
    assert finding.judged.evidence.log_bayes_factor == (77.0 if kept == "settled" else 50.0)
