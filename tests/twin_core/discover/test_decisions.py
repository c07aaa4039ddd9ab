"""The deciding rooms at their boundaries: what is likely enough, what predicts, what is named."""

from dataclasses import replace
from threading import Barrier, Thread
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.twin_core.discover.stubs import CHANCE, JUST, LEAST, MOST, NEEDED, Problem, Stub, judged, leak, load, stub
from twin_core.discover import coarseness, judge, policy, trajectories
from twin_core.discover import search as searching
from twin_core.discover.coarseness import least_explained, stands
from twin_core.discover.evidence import Evidence, Validation
from twin_core.discover.form import Repeatable
from twin_core.discover.judge import (
    AT_AN_END,
    COINCIDES,
    LESS_LIKELY,
    NO_FORESIGHT,
    NO_LAW,
    NO_MORE,
    NOT_EXAMINED,
    NOT_SUPPORTED,
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
from twin_core.discover.policy import (
    ALTERNATIVE_NATS,
    DOMINANCE,
    FORESIGHT,
    MOST_COARSENESS,
    REPEATABLE_SHARE,
    THRESHOLDS,
    VISIBLE_COARSENESS,
)
from twin_core.discover.search import WIDENED
from twin_core.discover.trial import Trial
from twin_core.discover.wald import score_needed
from twin_core.effects import REGISTRY
from twin_core.effects.base import Effect
from twin_core.once import once

pytestmark = pytest.mark.usefixtures("foreseen")


@pytest.mark.parametrize("rate", [0.5, 0.01, 1e-6])
def test_the_odds_of_the_false_alarm_rate_are_asked_for(rate: float) -> None:
    assert np.exp(-threshold(rate)) == pytest.approx(rate)


@pytest.mark.parametrize(
    ("ratio", "forward", "at_best", "n_sessions", "is_law", "foresight"),
    [
        (0.5, 0.5, 0.4, 1, True, 0.5),
        (0.25, 1.0, 0.0, 1, True, 0.5),
        (0.25, 1.0, 0.0, 1, False, 0.5),
        (0.25, 0.64, 0.36, 1, True, 0.48),
        (0.25, 1.0, 1.0, 1, False, 1.0),
        (0.64, 0.25, 0.2, 1, False, 0.4),
        (0.25, 2.0, 1.0, 1, True, 2.0**2 * np.sqrt(2.0)),
        (1.44, 0.25, 0.2, 1, False, 1.44**2 * 0.6),
        (0.5, 0.7, 0.7, 3, True, 0.7),
        (0.5, 0.75, 0.75, 3, True, 0.75),
        (0.5, 0.75 + JUST, 0.75, 3, True, 1.0),
        (1.2, 0.9, 0.9, 3, True, 1.2**2 * 0.9),
        (0.5, 0.9, 0.9, 3, False, np.sqrt(0.45)),
    ],
    ids=[
        "alike",
        "geometric mean",
        "an event at rest",
        "blocks gain more than the end can",
        "an event of blocks alone",
        "the end gains more",
        "worse at the end",
        "worse on blocks",
        "told between sessions",
        "half of the gain",
        "less than half",
        "worse within sessions",
        "event, sessions",
    ],
)
def test_foresight(
    ratio: float, forward: float, at_best: float, n_sessions: int, is_law: bool, foresight: float
) -> None:
    told = Validation(ratio, 1.0, forward, 0.1, 1.0, n_sessions, is_law, at_best)
    assert told.foresight == pytest.approx(foresight)


@pytest.mark.parametrize(("nats", "most"), [(0.0, NEEDED), (46.0, NEEDED), (460.0, 46.0)])
def test_what_a_name_may_leave_is_weighed_against_what_it_explains(nats: float, most: float) -> None:
    assert most_left(nats, NEEDED) == pytest.approx(most)
    assert REPEATABLE_SHARE < 1.0


@pytest.mark.parametrize(("behind", "close"), [(0.0, True), (ALTERNATIVE_NATS - JUST, True), (ALTERNATIVE_NATS, False)])
def test_alternatives(behind: float, close: bool) -> None:
    assert is_close(judged("a", 50.0 - behind), judged("b", 50.0)) == close


def test_the_simplest_of_those_that_the_data_hardly_tell_comes_first() -> None:
    film = REGISTRY["nonlinear_convection"]({"node": "a", "boundary": "bus"}, {"k": 1.0, "p": 1.0})
    options = [Judged((film,), Evidence(50.0, 0.0), stub(film)), judged("b", 48.0), judged("c", 40.0)]
    assert [j.effects[0].where["node"] for j in simplest_first(options)] == ["b", "a", "c"]


@pytest.mark.parametrize(
    ("behind", "conducted", "leads"),
    [
        (ALTERNATIVE_NATS - JUST, (), "radiation_to_sink"),
        (ALTERNATIVE_NATS, (), "leak_to_boundary"),
        (ALTERNATIVE_NATS - JUST, ("space",), "leak_to_boundary"),
    ],
    ids=["hardly told apart", "told apart", "matter joins them"],
)
def test_what_is_declared_to_be_radiated_to_takes_radiation(
    behind: float, conducted: tuple[str, ...], leads: str
) -> None:
    """Deep space conducts nothing: of a leak there and radiation, hardly told apart, the latter is told first."""
    leak = REGISTRY["leak_to_boundary"]({"node": "a", "boundary": "space"}, {"G_W_per_K": 1.0})
    radiation = REGISTRY["radiation_to_sink"]({"node": "a", "sink": "space"}, {"R_m2": 1.0})
    options = [Judged((e,), Evidence(50.0, 0.0), stub(e)) for e in (leak, radiation)]
    options[1] = replace(options[1], evidence=Evidence(50.0 - behind, 0.0))
    for option in options:
        cast(Any, option.trial).fit.problem = Problem(3, conducted, ("space",))
    assert simplest_first(options)[0].effects[0].name == leads


def test_every_set_of_effects_counts_once_at_its_best() -> None:
    kept = once_each([judged("a", 1.0), judged("b", 2.0), judged("a", 3.0)])
    assert [(j.effects[0].where["node"], j.evidence.log_bayes_factor) for j in kept] == [("a", 3.0), ("b", 2.0)]


@pytest.fixture
def examined(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the foresight of an option as it stands, a load at node ``form`` for no law, and one at ``x…`` for less likely."""

    def told(simple: Trial, option: Judged, needed: float) -> tuple[Judged, bool]:
        assert option.validation is not None
        if option.effects[0].where["node"].startswith("x"):
            return replace(option, validation=None, reason=LESS_LIKELY), False
        if not option.validation.foresight < FORESIGHT:
            return replace(option, reason=NO_FORESIGHT), False
        is_form = option.effects[0].place == load("form").place
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
        ([judged("form", 90.0), judged("b", 60.0)], "b", [NO_LAW]),
        ([judged("form", 90.0), leak(judged("form", 60.0))], None, [NO_LAW]),
        ([judged("form", 90.0, left=CHANCE + JUST), leak(judged("form", 60.0))], "form", [NO_LAW]),
        ([judged("form", 90.0, left=CHANCE - JUST), leak(judged("form", 60.0))], None, [NO_LAW]),
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
        "no law there, but elsewhere",
        "no law",
        "explains more than what is no law",
        "explains more by chance alone",
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
def test_an_option_that_cannot_be_computed_ends_no_choice() -> None:
    """Not even where what it leaves is compared with what a name left that is no law."""

    def fails() -> Any:
        raise np.linalg.LinAlgError("no number")

    option = leak(judged("form", 60.0))
    option.trial.excess = fails  # type: ignore[method-assign]
    state = Search(stub(left=9.0), stub(left=9.0))
    accept(state, [judged("form", 90.0, left=1.0), option, judged("c", 50.0)], NEEDED)
    assert any("no number" in reason for reason in state.failures)
    assert [j.reason for j in state.rejected] == [NO_LAW, NOT_EXAMINED]
    assert [f.effects[0].where["node"] for f in state.findings] == ["c"]


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


def test_what_cannot_be_computed_is_not_foretold(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(simple: Trial, rich: Trial) -> Validation:
        raise np.linalg.LinAlgError

    monkeypatch.setattr(coarseness, "validate", fails)
    simple, rich = stub(left=9.0), stub(load("n0"), left=3.0)
    assert coarseness.times_asked(simple, rich, 12.0, shown=lambda: (simple, rich)) == 0.5


SCORE = score_needed(NEEDED)


@pytest.mark.parametrize(
    ("change", "score", "channel", "at_an_end", "reason"),
    [
        (0.0, SCORE, None, False, ""),
        (-JUST, SCORE, None, False, LESS_LIKELY),
        (0.0, SCORE - JUST, None, False, SIZE_NOT_DETERMINED),
        (0.0, SCORE, "P", False, COINCIDES),
        (0.0, SCORE, None, True, AT_AN_END),
    ],
    ids=["all are enough", "less likely along its trajectories", "of no size", "with an input", "all along"],
)
def test_a_correction_is_told_by_its_own_trajectories(
    monkeypatch: pytest.MonkeyPatch, change: float, score: float, channel: str | None, at_an_end: bool, reason: str
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
    monkeypatch.setattr(judge, "coinciding_channel", lambda *arguments: channel)
    monkeypatch.setattr(judge, "at_an_end", lambda *arguments: at_an_end)
    monkeypatch.setattr(judge, "_merely_resembles", lambda *arguments: "")
    assert judge.examine(simple, option, NEEDED)[0].reason == reason


@pytest.mark.parametrize(
    ("foresight", "without", "reason", "n_asked"),
    [(0.5, 0.6, "", 2), (0.5, 1.0, NO_FORESIGHT, 2), (1.0, 0.5, NO_FORESIGHT, 1)],
    ids=["passes", "predicts by what is not paid for", "refused as it is"],
)
def test_what_passes_must_pass_without_what_readings_do_not_pay_for(
    monkeypatch: pytest.MonkeyPatch, foresight: float, without: float, reason: str, n_asked: int
) -> None:
    """It gains what it no longer pays for, and is told so that the search goes on from there."""
    option, less, asked = judged("a", 90.0), stub(load("a")), []

    def validated(simple: Trial, rich: Trial) -> SimpleNamespace:
        asked.append(rich)
        return SimpleNamespace(foresight=without if rich is less else foresight)

    monkeypatch.setattr(Stub, "calibration", lambda own: SimpleNamespace(log_posterior=0.0), raising=False)
    monkeypatch.setattr(judge, "without_spare", lambda simple, rich: less)
    monkeypatch.setattr(judge, "weigh", lambda simple, rich, n_tried: Evidence(-3.0, 1.0))
    monkeypatch.setattr(judge, "validate", validated)
    monkeypatch.setattr(judge, "least_wald_score", lambda *trials: np.inf)
    monkeypatch.setattr(judge, "coinciding_channel", lambda *arguments: None)
    monkeypatch.setattr(judge, "_merely_resembles", lambda *arguments: "")
    examined, _ = judge.examine(stub(), option, NEEDED)
    assert (examined.reason, len(asked)) == (reason, n_asked)
    assert examined.trial is asked[-1] is (less if n_asked > 1 else option.trial)
    assert examined.evidence.log_bayes_factor == 90.0 + 3.0 * (n_asked - 1)


@pytest.mark.parametrize(("rate", "score"), [(0.05, 1.959964), (0.01, 2.575829), (0.001, 3.290527)])
def test_the_score_asked_for_is_that_of_normal_tables(rate: float, score: float) -> None:
    assert score_needed(threshold(rate)) == pytest.approx(score, abs=1e-6)


SMALL = REPEATABLE_SHARE * (5.0 - 1.0)
NEARLY_ALL = REPEATABLE_SHARE**2 * (5.0 - 1.0)
HALF = 0.5 * (1.0 - CHANCE)


@pytest.mark.parametrize(
    ("beside", "instead", "before", "after", "reason"),
    [
        (None, None, 5.0, 1.0, ""),
        (SMALL, None, 5.0, 1.0, SMALL_REMAINDER),
        (None, SMALL, 5.0, 1.0, SMALL_REMAINDER),
        (SMALL + JUST, None, 5.0, 1.0, NO_LAW),
        (0.1, SMALL + JUST, 5.0, 1.0, NO_LAW),
        (MOST_COARSENESS, None, 100.0, 9.0, SMALL_REMAINDER),
        (MOST_COARSENESS + JUST, None, 100.0, 9.0, NO_LAW),
        (NEARLY_ALL - JUST, None, 5.0, 1.0, ""),
        (NEARLY_ALL + JUST, None, 5.0, 1.0, SMALL_REMAINDER),
        (0.01, NEARLY_ALL + JUST, 5.0, 1.0, SMALL_REMAINDER),
        (HALF - JUST, None, 9000.0, 1.0, ""),
        (HALF - JUST, None, 8.0, 1.0, SMALL_REMAINDER),
        (HALF + JUST, None, 8.0, 1.0, NO_LAW),
    ],
    ids=[
        *("a law", "little beside it", "little better", "beside it", "better", "as coarse as can be", "coarser"),
        *("a tenth of its temperatures", "more than that", "more than that better"),
        *("less than stays beside much", "less than stays beside it", "more than stays beside it"),
    ],
)
def test_what_a_name_leaves_is_weighed_against_what_it_removes(
    monkeypatch: pytest.MonkeyPatch,
    beside: float | None,
    instead: float | None,
    before: float,
    after: float,
    reason: str,
) -> None:
    option = judged("a", 90.0, left=after)
    simple = stub(left=before)
    found = Repeatable() if beside is None else Repeatable(9e9, beside)
    monkeypatch.setattr(judge, "acts_at", lambda *arguments: {"a"})
    monkeypatch.setattr(judge, "against_free_forms", lambda *arguments: (found, instead))
    monkeypatch.setattr(judge, "more_is_left_elsewhere", lambda *arguments: False)
    assert judge._merely_resembles(simple, option, NEEDED) == reason
    monkeypatch.setattr(judge, "more_is_left_elsewhere", lambda *arguments: True)
    assert judge._merely_resembles(simple, option, NEEDED) == ""


@pytest.mark.parametrize("rounding", [-4e-16, 0.0, 4e-16])
def test_a_heat_that_explains_as_much_as_a_name_that_leaves_nothing_is_an_objection(
    monkeypatch: pytest.MonkeyPatch, rounding: float
) -> None:
    """A heater stood for a resonance by rounding alone: the curve in its place was likelier by 8 nats and left as little.

    Where nothing else stays the network is not seen to be coarse, so that no part of the heat is its remainder.
    """
    monkeypatch.setattr(judge, "acts_at", lambda *arguments: {"a"})
    monkeypatch.setattr(judge, "against_free_forms", lambda *arguments: (Repeatable(), rounding))
    monkeypatch.setattr(judge, "more_is_left_elsewhere", lambda *arguments: False)
    assert judge._merely_resembles(stub(left=10.0), judged("a", 32.0, left=0.0), NEEDED) == NO_LAW


def test_beside_much_that_stays_as_large_a_share_is_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """What stays beside name and heat is no coarseness: a heat of a share of it does not tell the law wrong."""
    option = judged("a", 90.0, left=100.0)
    monkeypatch.setattr(judge, "acts_at", lambda *arguments: {"a"})
    monkeypatch.setattr(judge, "more_is_left_elsewhere", lambda *arguments: False)
    at_most = REPEATABLE_SHARE * (100.0 - CHANCE) / (1.0 + REPEATABLE_SHARE)
    for removed, reason in ((at_most - JUST, SMALL_REMAINDER), (at_most + JUST, NO_LAW)):
        found = Repeatable(9e9, removed), None
        monkeypatch.setattr(judge, "against_free_forms", lambda *a, found=found: found)
        assert judge._merely_resembles(stub(left=500.0), option, NEEDED) == reason


def test_beside_a_sensors_effect_a_heat_may_be_left() -> None:
    """Only one that explains the readings better in its place speaks against it."""
    lag = REGISTRY["sensor_lag"]({"sensor": "T"}, {"tau_s": 30.0})
    option = Judged((lag,), Evidence(90.0, 0.0), stub(lag))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(judge, "more_is_left_elsewhere", lambda *arguments: False)
        patch.setattr(judge, "acts_at", lambda trial, effects: {"a"} if effects else set())

        def compared(
            simple: object, trial: object, nodes: set[str], *others: object
        ) -> tuple[Repeatable, float | None]:
            return Repeatable(9e9, 1e9) if nodes else Repeatable(), instead

        instead: float | None = None
        patch.setattr(judge, "against_free_forms", compared)
        assert judge._merely_resembles(stub(left=10.0), option, NEEDED) == ""
        instead = 1e9
        assert judge._merely_resembles(stub(left=10.0), option, NEEDED) == NO_LAW


@given(st.just(0.0) | st.floats(1e-300, 1e6), st.floats(1.0, 2.0), st.integers(10, 10**7))
def test_what_a_name_must_explain_grows_with_what_stays_without_a_cliff(left: float, factor: float, n: int) -> None:
    """It never grows faster than it does where a network begins to be seen as coarse."""
    least, more = (least_explained(value, value, n) for value in (left, left * factor))
    steepest = DOMINANCE * max(1.0, LEAST / (VISIBLE_COARSENESS * np.sqrt(2.0 / n)))
    assert 0.0 <= least <= more <= DOMINANCE * MOST
    rounding = 4.0 * np.finfo(float).eps * more
    assert more - least <= steepest * (factor - 1.0) * left * (1.0 + 1e-9) + rounding


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


@pytest.mark.parametrize("n_together", [1, 2])
def test_what_the_filter_suggests_is_an_option_and_no_seed(monkeypatch: pytest.MonkeyPatch, n_together: int) -> None:
    """Pairs grow from what trajectories suggest; single effects come from both."""
    by_trajectory, by_filter = judged("a", 50.0), judged("b", 90.0)
    asked: list[list[Judged]] = []

    def accepted(state: Search, options: list[Judged], needed: float) -> bool:
        asked.append(list(options))
        return True

    base = stub()
    monkeypatch.setattr(trajectories, "_extensions", lambda *arguments, fallback: [(base, load("a"), 5)])
    monkeypatch.setattr(trajectories, "_near_extensions", lambda *arguments, fallback: [(base, load("b"), 5)])
    fitted = {"a": by_trajectory, "b": by_filter}

    def tried(state: Search, seed: Trial, effect: Effect, n_tried: int, *, beside_heat: bool) -> Judged:
        assert beside_heat == (effect.where["node"] == "b")
        return fitted[str(effect.where["node"])]

    monkeypatch.setattr(trajectories, "_fitted", tried)
    monkeypatch.setattr(trajectories, "_settled", lambda *arguments: [])
    monkeypatch.setattr(trajectories, "_alone", lambda *a: [])
    monkeypatch.setattr(trajectories, "accept", accepted)
    state = Search(base, base, n_named=5)
    told, seeds = trajectories.extend_by_trajectory(state, NEEDED, [base], [], n_together, fallback=False)
    assert told and seeds == [by_trajectory.trial]
    assert asked == [[by_filter, by_trajectory] if n_together == 1 else [by_trajectory]]


@pytest.mark.parametrize(
    ("known", "foresight", "seeded"),
    [("a", DOMINANCE**-0.5 - JUST, False), ("a", DOMINANCE**-0.5, True), ("c", 0.1, True)],
    ids=["foretells", "foretells little", "another one is likelier"],
)
def test_what_is_known_to_hold_is_not_examined_again_but_extended_by_another_one(
    monkeypatch: pytest.MonkeyPatch, known: str, foresight: float, *, seeded: bool
) -> None:
    """A power law was the likeliest single effect, held, and no pair was looked for, though 67 times the noise stayed."""
    option, asked, base = judged("a", 50.0), list[object](), stub()
    monkeypatch.setattr(trajectories, "_extensions", lambda *arguments, fallback: [(base, load("a"), 5)])
    monkeypatch.setattr(trajectories, "_near_extensions", lambda *arguments, fallback: [])
    monkeypatch.setattr(trajectories, "_fitted", lambda *arguments, beside_heat: option)
    monkeypatch.setattr(trajectories, "_settled", lambda *arguments: [])
    monkeypatch.setattr(trajectories, "accept", lambda *arguments: asked.append(arguments) or True)
    finding = Finding(judged(known, 50.0, foresight=foresight))
    told, seeds = trajectories.extend_by_trajectory(
        Search(base, base, n_named=5), NEEDED, [base], [], 1, fallback=False, known=finding
    )
    assert told == bool(asked) == (known != "a")
    assert seeds == ([option.trial] if seeded else [])


@pytest.mark.parametrize("is_by_heat", [False, True])
@pytest.mark.parametrize(
    ("beside", "pairs", "leads"),
    [(3.0 - JUST, 0.1, "single"), (3.0, 0.1, "pair"), (3.0, 0.6, "single")],
    ids=["leaves little", "predicts better", "predicts worse"],
)
def test_pairs_are_looked_for_where_a_single_effect_leaves_much(
    monkeypatch: pytest.MonkeyPatch, beside: float, pairs: float, leads: str, *, is_by_heat: bool
) -> None:
    """Whichever look has found the single one."""

    def trial(*effects: Effect, misfit: float) -> Trial:
        made = stub(*effects, left=9.0)
        made.misfit_share = lambda: misfit  # type: ignore[method-assign]
        return made

    def look(
        fork: Search, needed: float, seeds: list[Trial], near: object, n: int, *, fallback: bool, known: object
    ) -> tuple[bool, list[Trial]]:
        node, foresight = ("single", 0.5) if n == 1 else ("pair", pairs)
        if is_by_heat and n == 1:
            return False, [base]
        fork.trial = trial(load(node), misfit=beside)
        fork.findings.append(Finding(replace(judged(node, 50.0, foresight=foresight), trial=fork.trial)))
        return True, [fork.trial]

    def by_heat(fork: Search, needed: float, *, fallback: bool) -> tuple[bool, list[list[Any]]]:
        if is_by_heat:
            fork.trial = trial(load("single"), misfit=beside)
            fork.findings.append(Finding(replace(judged("single", 50.0), trial=fork.trial)))
        return is_by_heat, [[]]

    base = trial(misfit=20.0)
    base.fit = cast(Any, None)  # type: ignore[misc]
    monkeypatch.setattr(searching, "gain_of_undeclared_heat", lambda fit: 99.0)
    monkeypatch.setattr(searching, "_extend_by_heat", by_heat)
    monkeypatch.setattr(searching, "_pairs_by_heat", lambda *arguments: False)
    monkeypatch.setattr(searching, "extend_by_trajectory", look)
    state = Search(base, base)
    assert searching._extend(state, NEEDED, fallback=False)
    assert [f.effects[0].where["node"] for f in state.findings] == [leads]


def test_a_look_that_finds_nothing_counts_what_it_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is reconsidered after it paid nothing for the names that it was chosen among."""

    def look(fork: Search, *arguments: object, fallback: bool) -> tuple[bool, list[list[Any]]]:
        fork.count(7, fallback=fallback)
        return False, [[]]

    base = stub(left=9.0)
    base.fit = cast(Any, None)  # type: ignore[misc]
    base.misfit_share = lambda: 0.0  # type: ignore[method-assign]
    monkeypatch.setattr(searching, "gain_of_undeclared_heat", lambda fit: 99.0)
    monkeypatch.setattr(searching, "_extend_by_heat", look)
    monkeypatch.setattr(searching, "_pairs_by_heat", lambda *arguments: False)
    state = Search(base, base)
    assert not searching._extend(state, NEEDED, fallback=False)
    assert state.n_named == 7


@pytest.mark.parametrize(
    ("known", "left", "by_heat", "by_trajectory"),
    [([], 0.2, True, True), (["a"], WIDENED + JUST, False, True), (["a"], WIDENED, False, False)],
    ids=["nothing is found yet", "more stays than the noise", "no more stays than the noise"],
)
def test_two_effects_are_tried_together_as_long_as_much_stays(
    monkeypatch: pytest.MonkeyPatch, known: list[str], left: float, *, by_heat: bool, by_trajectory: bool
) -> None:
    asked: list[int | str] = []

    def pairs_by_heat(*arguments: object) -> bool:
        asked.append("heat")
        return False

    def look(
        fork: Search, needed: float, seeds: list[Trial], near: object, n: int, *, fallback: bool, known: object
    ) -> tuple[bool, list[Trial]]:
        asked.append(n)
        return False, [fork.trial]

    base = stub(*map(load, known), left=left)
    base.fit = cast(Any, None)  # type: ignore[misc]
    base.misfit_share = lambda: 20.0  # type: ignore[method-assign]
    monkeypatch.setattr(searching, "gain_of_undeclared_heat", lambda fit: 99.0)
    monkeypatch.setattr(searching, "_extend_by_heat", lambda *arguments, fallback: (False, [[]]))
    monkeypatch.setattr(searching, "_pairs_by_heat", pairs_by_heat)
    monkeypatch.setattr(searching, "extend_by_trajectory", look)
    state = Search(base, base, findings=[Finding(judged(name, 50.0)) for name in known])
    assert not searching._extend(state, NEEDED, fallback=False)
    assert asked == ["heat"] * by_heat + [1, 2] * by_trajectory
    asked.clear()
    assert not searching._extend(state, NEEDED, fallback=True)
    assert asked == [1] * by_trajectory


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
