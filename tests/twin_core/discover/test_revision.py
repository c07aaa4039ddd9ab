"""Revision at its boundaries: what is withdrawn and what goes first, what is exchanged, and which alternative leads."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.twin_core.discover.stubs import (
    CHANCE,
    JUST,
    LEAST,
    MOST,
    N_READINGS,
    NEEDED,
    judged,
    load,
    stub,
    unnamed,
)
from twin_core.discover import policy, revision
from twin_core.discover.coarseness import stands
from twin_core.discover.evidence import Evidence, Validation
from twin_core.discover.judge import (
    NO_FORESIGHT,
    NO_FORESIGHT_TOGETHER,
    NO_LAW,
    NO_MORE,
    NOT_SUPPORTED,
    OUTDONE,
    SIZE_NOT_DETERMINED,
    SMALL_REMAINDER,
    SUPERFLUOUS,
    UNDECIDED,
    Finding,
    Judged,
    Search,
)
from twin_core.discover.policy import (
    ALTERNATIVE_NATS,
    DOMINANCE,
    FORESIGHT,
    LEAST_EXCESS,
    REPEATABLE_SHARE,
    THRESHOLDS,
)
from twin_core.discover.revision import (
    foretell_together,
    prune,
    reconsider,
    tell_alternatives,
    withdraw,
    withdraw_superfluous,
)
from twin_core.discover.trial import Trial
from twin_core.effects import REGISTRY
from twin_core.effects.base import Effect

pytestmark = pytest.mark.usefixtures("foreseen")


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
    beside = stub(load("n1"), left=0.5 + DOMINANCE * LEAST - JUST)
    assert not stands(beside, stub(load("n1"), load("n0"), left=0.5, foresight=foresight))


FAR = DOMINANCE * (N_READINGS / 2) ** 0.5 + 0.5 * float(np.log(N_READINGS))
"""Gain in log-likelihood, one parameter paid, from which a name is no coarseness whatever it explains."""


@pytest.mark.parametrize(
    ("along", "beside", "foresight", "kept"),
    [
        (FAR + JUST, None, 0.9, True),
        (FAR - JUST, None, 0.9, False),
        (9.0 * FAR, FAR + JUST, 0.9, True),
        (9.0 * FAR, FAR - JUST, 0.9, False),
        (FAR - JUST, 9.0 * FAR, 0.9, False),
        (9.0 * FAR, 9.0 * FAR, FORESIGHT, False),
    ],
    ids=["just", "too little", "both", "gradients take it up", "it makes up for gradients", "foretells nothing"],
)
def test_what_is_likelier_by_far_whatever_the_misfit_is_no_coarseness(
    monkeypatch: pytest.MonkeyPatch, along: float, beside: float | None, foresight: float, kept: bool
) -> None:
    """Gradients within the nodes took up all that an undeclared coupling did, at 164 nats less, and nothing was its own."""
    rich = of_likelihood(stub(load("n0"), left=0.5, foresight=foresight), along, beside)
    simple = of_likelihood(stub(left=0.5), 0.0, None if beside is None else 0.0)
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(0.0, 1.0))
    state = Search(rich, simple, findings=[Finding(judged("n0", 50.0))])
    withdraw(state, NEEDED)
    assert bool(state.findings) == kept
    assert not stands(simple, rich)  # one that explains it goes before it where several pass


def of_likelihood(trial: Trial, along: float, beside: float | None) -> Trial:
    of: Any = trial
    of.along, of.beside = along, beside
    return trial


@pytest.mark.parametrize(("foresight", "kept"), [(1.0, ["n1"]), (0.2, ["n0"])])
def test_what_a_name_foretells_by_itself_counts_beside_others_too(
    monkeypatch: pytest.MonkeyPatch, foresight: float, kept: list[str]
) -> None:
    """A sensor's lag that gradients beside a step resemble, say, foretells the other blocks by itself; the step does not."""
    left = {"": 9.0, "n0": 0.5 + DOMINANCE * LEAST - JUST, "n1": 0.5 + DOMINANCE * LEAST - 2.0 * JUST, "n0 n1": 0.5}

    def refitted(effects: tuple[Effect, ...]) -> Trial:
        name = " ".join(sorted(e.where["node"] for e in effects))
        return stub(*effects, left=left[name], foresight=foresight if name == "n0" else 1.0)

    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: refitted(tuple(effects)))
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(0.0, 1.0))
    state = Search(refitted((load("n0"), load("n1"))), refitted(()))
    state.findings = [Finding(judged("n0", 50.0)), Finding(judged("n1", 40.0))]
    withdraw(state, NEEDED)
    assert [f.effects[0].where["node"] for f in state.findings] == kept


@pytest.mark.parametrize(
    ("of_all", "of_rests", "kept"),
    [
        (1.0 - JUST, {"n0 n1": 0.2, "n0 n2": 0.2, "n1 n2": 0.2}, ["n0", "n1", "n2"]),
        (1.0, {"n0 n1": 0.9, "n0 n2": 0.8, "n1 n2": 0.85}, ["n0", "n2"]),
        (np.nan, {"n0 n1": 0.9, "n0 n2": 0.95, "n1 n2": 0.85}, ["n1", "n2"]),
        (1.0, {"n0 n1": np.nan, "n0 n2": 0.8, "n1 n2": np.nan}, ["n0", "n2"]),
        (1.5, {"n0 n1": 1.1, "n0 n2": 1.2, "n1 n2": 1.3, "n0": 0.9, "n1": 0.8}, ["n1"]),
        (1.5, {"n0 n1": 1.1, "n0 n2": 1.2, "n1 n2": 1.3, "n0": 1.9, "n1": 1.0}, []),
    ],
    ids=["better", "no better", "no number", "no number without one", "two of three", "all"],
)
def test_findings_together_must_foretell_more_than_the_declared_model(
    monkeypatch: pytest.MonkeyPatch, of_all: float, of_rests: dict[str, float], kept: list[str]
) -> None:
    """In a house a lag and a hidden mass passed, then a step of the Sun's gain, and all together predicted 2.2 times worse."""
    foresight = {"": 1.0, "n0 n1 n2": of_all, **of_rests}

    def refitted(effects: Sequence[Effect]) -> Trial:
        return stub(*effects, foresight=foresight[" ".join(sorted(e.where["node"] for e in effects))])

    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: refitted(effects))
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(0.0, 1.0))
    names = ["n0", "n1", "n2"]
    state = Search(refitted([load(name) for name in names]), refitted(()))
    state.findings = [Finding(judged(name, 50.0)) for name in names]
    foretell_together(state)
    assert [f.effects[0].where["node"] for f in state.findings] == kept
    assert sorted(e.where["node"] for e in state.trial.effects) == kept
    assert [j.reason for j in state.rejected] == [NO_FORESIGHT_TOGETHER] * (len(names) - len(kept))


def test_a_single_finding_is_not_asked_again_what_it_foretells() -> None:
    found = judged("n0", 50.0)
    state = Search(stub(load("n0"), foresight=2.0), stub(), findings=[Finding(found)])
    foretell_together(state)
    assert state.findings == [Finding(found)]


@pytest.mark.parametrize(
    ("explained", "left", "kept"),
    [
        ([5.0, 0.2], 0.0, ["n0", "n1"]),
        ([9.0, DOMINANCE * CHANCE], CHANCE, ["n0", "n1"]),
        ([9.0, DOMINANCE * LEAST], 2.0 * CHANCE, ["n0", "n1"]),
        ([9.0, DOMINANCE * LEAST - JUST], 2.0 * CHANCE, ["n0"]),
        ([0.2, 9.0], 0.5, ["n1"]),
        ([0.9, 1.2], 0.5, []),
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


@pytest.mark.usefixtures("one_core")
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
    before = stub(load("a"), left=1.4)
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


@pytest.mark.parametrize(("nats", "kept"), [(NEEDED, []), (NEEDED + JUST, ["b"])])
def test_what_is_left_of_a_set_must_be_supported_by_itself(
    monkeypatch: pytest.MonkeyPatch, nats: float, kept: list[str]
) -> None:
    """Of a healthy spacecraft a radiation was named that was worth 1.7 nats, after the conductor beside it had been dropped."""
    support = {"a": NEEDED, "b": nats}

    def weighed(simple: Trial, rich: Trial, n_tried: int) -> Evidence:
        (lost,) = {str(e.where["node"]) for e in rich.effects} - {str(e.where["node"]) for e in simple.effects}
        return Evidence(support[lost], 0.0)

    monkeypatch.setattr(
        revision, "try_effects", lambda trial, effects, n_passes: stub(*effects, left=9.0 * (2 - len(effects)))
    )
    monkeypatch.setattr(revision, "weigh", weighed)
    monkeypatch.setattr(revision, "examine", lambda simple, option, needed: (option, False))
    pair = stub(load("a"), load("b"))
    state = Search(pair, stub(left=18.0), findings=[Finding(Judged(pair.effects, Evidence(99.0, 0.0), pair))])
    prune(state, NEEDED)
    assert [e.where["node"] for f in state.findings for e in f.effects] == kept
    assert [f.judged.evidence.log_bayes_factor for f in state.findings] == [nats] * len(kept)
    assert [j.reason for j in state.rejected] == ([] if kept else [NOT_SUPPORTED])


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
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(NEEDED + JUST, 1.0))
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


@pytest.mark.parametrize(
    ("left", "asked"),
    [(50.0, DOMINANCE * 50.0), (2.0 * CHANCE, DOMINANCE * LEAST), (LEAST + 0.5, DOMINANCE * (LEAST + 0.5))],
    ids=["much stays", "the network is seen to be coarse", "more stays than such a network may leave"],
)
def test_beside_a_heat_without_a_name_all_that_stays_counts(
    monkeypatch: pytest.MonkeyPatch, left: float, asked: float
) -> None:
    """And no less than against a name: a healthy spacecraft of which the network is coarse lacks no heat."""
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(0.0, 1.0))
    free = unnamed()
    option = Judged((free,), Evidence(50.0, 0.0), stub(free))
    for more, kept in ((JUST, True), (-JUST, False)):
        state = Search(stub(free, left=left), stub(left=left + asked + more))
        state.findings = [Finding(option)]
        withdraw(state, NEEDED)
        assert bool(state.findings) == kept


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
    ("left", "explained", "named"),
    [
        (2.0 * CHANCE, 1.0 - REPEATABLE_SHARE + JUST, True),
        (2.0 * CHANCE, 1.0 - REPEATABLE_SHARE - JUST, False),
        (CHANCE, 1.0, False),
        (MOST, 1.0, True),
        (MOST + JUST, 1.0, False),
    ],
    ids=["coarse", "explains less", "not seen to be coarse", "coarsest", "more than coarse"],
)
def test_a_name_that_explains_as_much_goes_before_a_heat_without_one_where_a_network_is_coarse(
    monkeypatch: pytest.MonkeyPatch, left: float, explained: float, *, named: bool
) -> None:
    """Nats, and a foresight a little better, say nothing there, and the heat has more freedom."""
    monkeypatch.setattr(revision, "withdraw", lambda state, needed: None)
    before = 40.0
    heat = replace(judged("f", 200.0, left=left, foresight=0.45), effects=(unnamed(),))
    option = judged("a", 90.0, left=before - explained * (before - left), foresight=0.5)
    state = Search(heat.trial, stub(left=before), findings=[Finding(heat)])
    state.rejected = [replace(option, reason=SMALL_REMAINDER)]
    reconsider(state, NEEDED)
    assert [effect.fallback for f in state.findings for effect in f.effects] == [not named]


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
    ("nats", "alone", "reason", "leads"),
    [
        (60.0 + NEEDED + JUST, 60.0 + NEEDED + JUST, "", "boundary_mix"),
        (60.0 + NEEDED, 99.0, "", "constant_heat_load"),
        (90.0, 60.0 + NEEDED, "", "constant_heat_load"),
        (90.0, 99.0, NO_LAW, "constant_heat_load"),
    ],
    ids=["likelier", "hardly likelier", "refitted hardly likelier", "no law"],
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
    monkeypatch.setattr(revision, "attempted_without", lambda state, places: (stub(), 60.0))
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
    ("alone", "reason", "told"),
    [
        (60.0 + NEEDED + JUST, NO_FORESIGHT, []),
        (60.0 + NEEDED, NO_FORESIGHT, ["constant_heat_load"]),
        (60.0 + NEEDED + JUST, SIZE_NOT_DETERMINED, ["constant_heat_load"]),
    ],
    ids=["contradicted", "hardly likelier", "no size"],
)
def test_a_name_is_withdrawn_where_a_far_likelier_one_predicts_no_better(
    monkeypatch: pytest.MonkeyPatch, alone: float, reason: str, told: list[str]
) -> None:
    """Neither is named: what is likelier and what foretells are different effects."""
    found, option = judged("a", 60.0), judged("b", 90.0)
    without = stub()
    compared = Finding(found, (option,))
    monkeypatch.setattr(revision, "add_coarse_alternatives", lambda state, simple, finding, needed: compared)
    monkeypatch.setattr(revision, "attempted_without", lambda state, places: (without, 60.0))
    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: stub(*effects))
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(alone, 0.0))
    monkeypatch.setattr(revision, "examine", lambda simple, judged, needed: (replace(judged, reason=reason), False))
    state = Search(found.trial, stub(), findings=[Finding(found)])
    tell_alternatives(state, NEEDED)
    assert [e.name for f in state.findings for e in f.effects] == told
    assert [j.reason for j in state.rejected] == ([] if told else [UNDECIDED] * 2)
    assert (state.trial is without) == (not told)


FAR_LIKELIER = 60.0 + NEEDED + FAR
"""Log-likelihood from which an option with as many parameters is likelier by far than findings of 60 nats."""


def with_nats(judged: Judged, nats: float) -> Judged:
    """Return an option whose trial has a log-likelihood."""
    stubbed: Any = judged.trial
    stubbed.nats = nats
    return judged


@pytest.mark.parametrize(
    ("nats", "beside", "left", "place", "reason", "kept"),
    [
        (FAR_LIKELIER + JUST, NEEDED, MOST + JUST, "b", SIZE_NOT_DETERMINED, False),
        (FAR_LIKELIER + JUST, NEEDED, MOST + JUST, "b", NO_FORESIGHT, False),
        (FAR_LIKELIER - JUST, NEEDED, MOST + JUST, "b", SIZE_NOT_DETERMINED, True),
        (FAR_LIKELIER + JUST, NEEDED + JUST, MOST + JUST, "b", SIZE_NOT_DETERMINED, True),
        (FAR_LIKELIER + JUST, NEEDED, MOST, "b", SIZE_NOT_DETERMINED, True),
        (FAR_LIKELIER + JUST, NEEDED, MOST + JUST, "a", SIZE_NOT_DETERMINED, True),
        (FAR_LIKELIER + JUST, NEEDED, MOST + JUST, "b", NO_LAW, True),
    ],
    ids=["no size", "no foresight", "less", "both supported", "coarseness", "holds it itself", "another reason"],
)
def test_a_name_is_withdrawn_that_a_far_likelier_option_makes_superfluous(
    monkeypatch: pytest.MonkeyPatch, nats: float, beside: float, left: float, place: str, reason: str, kept: bool
) -> None:
    """A power law of 16 nats, say, where a hidden mass with a lag has 343, of undetermined size: one foretold nothing."""
    found = with_nats(judged("a", 60.0, left=left), 60.0)
    option = with_nats(replace(judged(place, nats), reason=reason), nats)
    without, other = stub(), judged("d", 58.0)
    monkeypatch.setattr(revision, "attempted_without", lambda state, places: (without, 60.0))
    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: stub(*effects))
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(beside, 0.0))
    state = Search(found.trial, stub(), findings=[Finding(found, (other,))], rejected=[option])
    withdraw_superfluous(state, NEEDED)
    assert bool(state.findings) == kept == (state.trial is not without)
    assert [j.reason for j in state.rejected] == [reason, *([] if kept else [SUPERFLUOUS] * 2)]


@pytest.mark.parametrize(
    "beside", [{"a": 0.0, "c": 0.0}, {"a": 0.0, "c": 9.0}, {"a": 9.0, "c": 0.0}, {"a": 9.0, "c": 9.0}]
)
def test_each_name_is_asked_whether_an_option_makes_it_superfluous(
    monkeypatch: pytest.MonkeyPatch, beside: dict[str, float]
) -> None:
    """Two names that imitate a third effect together go together; what is left is examined as before."""
    names, again = sorted(beside), list[Search]()
    option = with_nats(replace(judged("b", 500.0), reason=NO_FORESIGHT), 500.0)
    both = with_nats(replace(judged("a", 60.0), trial=stub(*map(load, names), left=9.0)), 60.0)

    def weighed(simple: Trial, rich: Trial, n_tried: int) -> Evidence:
        assert simple is option.trial
        return Evidence(beside[str(rich.effects[-1].where["node"])], 0.0)

    monkeypatch.setattr(revision, "attempted_without", lambda state, places: (stub(), 60.0))
    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: stub(*effects))
    monkeypatch.setattr(revision, "weigh", weighed)
    monkeypatch.setattr(revision, "withdraw", lambda state, needed: again.append(state))
    state = Search(both.trial, stub(), findings=[Finding(judged(n, 60.0)) for n in names], rejected=[option])
    withdraw_superfluous(state, NEEDED)
    kept = [name for name in names if beside[name] > NEEDED]
    assert [f.effects[0].where["node"] for f in state.findings] == kept
    assert bool(again) == (len(kept) == 1)


def test_a_likelihood_that_cannot_be_computed_withdraws_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails() -> float:
        raise np.linalg.LinAlgError

    found = with_nats(judged("a", 60.0, left=MOST + JUST), 60.0)
    option: Any = replace(judged("b", 500.0), reason=NO_FORESIGHT)
    option.trial.log_evidence = fails
    state = Search(found.trial, stub(), findings=[Finding(found)], rejected=[option])
    withdraw_superfluous(state, NEEDED)
    assert [f.judged for f in state.findings] == [found]
    assert len(state.failures) == 1


def test_a_heat_without_a_name_is_not_contradicted_by_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """It claims no law, and predicts better than nothing."""
    option, kind = judged("b", 90.0), type(load("a"))
    heat = type("Free", (kind,), {"fallback": True})({"node": "a"}, {"Q_W": 1.0})
    found = Judged((heat,), Evidence(60.0, 0.0), stub(heat))
    compared = Finding(found, (option,))
    monkeypatch.setattr(revision, "add_coarse_alternatives", lambda state, simple, finding, needed: compared)
    monkeypatch.setattr(revision, "attempted_without", lambda state, places: (stub(), 60.0))
    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: stub(*effects))
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(90.0, 0.0))
    refused = lambda simple, judged, needed: (replace(judged, reason=NO_FORESIGHT), False)  # noqa: E731
    monkeypatch.setattr(revision, "examine", refused)
    state = Search(found.trial, stub(), findings=[Finding(found)])
    tell_alternatives(state, NEEDED)
    assert state.findings == [compared]


@pytest.mark.parametrize(
    ("behind", "alone", "reason", "leads"),
    [
        (ALTERNATIVE_NATS - JUST, 87.0 + JUST, "", "constant_heat_load"),
        (ALTERNATIVE_NATS, 87.0 + JUST, "", "boundary_mix"),
        (ALTERNATIVE_NATS - JUST, 87.0, "", "boundary_mix"),
        (ALTERNATIVE_NATS - JUST, 90.0, NO_LAW, "boundary_mix"),
    ],
    ids=["hardly told apart", "less likely", "less likely in its place", "no law"],
)
def test_the_simplest_of_the_names_that_cannot_be_told_apart_leads(
    monkeypatch: pytest.MonkeyPatch, behind: float, alone: float, reason: str, leads: str
) -> None:
    """What the readings hardly tell from it: what a coarse network leaves is averaged over in the evidence."""
    mix = REGISTRY["boundary_mix"]({"boundary": "bus"}, {"alpha": 0.5, "T_w_K": 280.0})
    found = Judged((mix,), Evidence(90.0, 0.0), stub(mix, n_free=5))
    told = Finding(found, (judged("a", 90.0 - behind), judged("b", 10.0)))
    monkeypatch.setattr(revision, "add_coarse_alternatives", lambda state, simple, finding, needed: told)
    monkeypatch.setattr(revision, "attempted_without", lambda state, places: (stub(), 90.0))
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


@pytest.mark.parametrize(("ahead", "leads"), [(JUST, "b"), (0.0, "a")])
def test_the_likeliest_of_those_as_simple_leads(monkeypatch: pytest.MonkeyPatch, ahead: float, leads: str) -> None:
    found, told = judged("a", 90.0), Finding(judged("a", 90.0), (judged("b", 90.0 + ahead),))
    monkeypatch.setattr(revision, "add_coarse_alternatives", lambda state, simple, finding, needed: told)
    monkeypatch.setattr(revision, "attempted_without", lambda state, places: (stub(), 90.0))
    monkeypatch.setattr(revision, "try_effects", lambda trial, effects, n_passes: stub(*effects))
    monkeypatch.setattr(revision, "weigh", lambda simple, rich, n_tried: Evidence(90.0 + ahead, 0.0))
    monkeypatch.setattr(revision, "examine", lambda simple, judged, needed: (judged, False))
    state = Search(found.trial, stub(), findings=[Finding(found)])
    tell_alternatives(state, NEEDED)
    assert [e.where["node"] for e in state.findings[0].effects] == [leads]


@pytest.mark.parametrize(
    ("left", "foresight", "leads"),
    [(2.0 - JUST, 0.9 * FORESIGHT - JUST, "b"), (2.0 - JUST, 0.9 * FORESIGHT, "a"), (2.0, 0.1, "a")],
    ids=["predicts better", "hardly better", "leaves as much"],
)
def test_of_names_alike_the_one_leads_that_leaves_less_and_predicts_better(
    monkeypatch: pytest.MonkeyPatch, left: float, foresight: float, leads: str
) -> None:
    """However little the evidence speaks for it: what is foretold counts."""
    found = judged("a", 90.0)
    option = judged("b", 40.0, left=left, foresight=foresight)
    told = Finding(found, (option,))
    trials = {"b": option.trial}
    monkeypatch.setattr(revision, "add_coarse_alternatives", lambda state, simple, finding, needed: told)
    monkeypatch.setattr(revision, "attempted_without", lambda state, places: (stub(), 90.0))
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


def test_one_with_more_freedom_leaves_less_and_does_not_lead_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    freer = REGISTRY["nonlinear_convection"]({"node": "a", "boundary": "bus"}, {"k": 1.0, "p": 1.0})
    option = Judged((freer,), Evidence(89.0, 0.0), stub(freer, left=1.0, foresight=0.1))
    told = Finding(judged("a", 90.0), (option,))
    monkeypatch.setattr(revision, "add_coarse_alternatives", lambda state, simple, finding, needed: told)
    monkeypatch.setattr(revision, "attempted_without", lambda state, places: (stub(), 90.0))
    state = Search(stub(load("a"), left=2.0, foresight=0.9), stub(), findings=[Finding(judged("a", 90.0))])
    tell_alternatives(state, NEEDED)
    assert state.findings == [told]


def test_nothing_is_named_that_was_tried_beside_what_no_longer_stands() -> None:
    state = Search(stub(), stub())
    option = judged("a", 90.0)
    state.rejected = [replace(option, trial=stub(load("a"), load("b")), reason=SMALL_REMAINDER)]
    reconsider(state, NEEDED)
    assert not state.findings
