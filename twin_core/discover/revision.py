"""Revision: what is withdrawn, exchanged or told beside what a search has found, once more than it is known."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from twin_core.calibrate.containment import those_that_work
from twin_core.discover import policy
from twin_core.discover.alternatives import add_coarse_alternatives
from twin_core.discover.coarseness import least_explained, times_asked, times_likely
from twin_core.discover.evidence import paid, validate, weigh
from twin_core.discover.judge import (
    NO_FORESIGHT,
    NO_FORESIGHT_TOGETHER,
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
    Without,
    complexity,
    examine,
    foresight_of,
    is_close,
    worth,
)
from twin_core.discover.trial import Trial, by_chance, explained, mean_excess, try_effects
from twin_core.effects.base import Effect

N_EXCHANGED = 2
"""Refused options that are tried in the place of a finding."""

N_RECONSIDERED = 4
"""Options refused for the little that they leave that are looked at once more."""


def withdraw(state: Search, needed: float) -> None:
    """Withdraw what explains no more than a lumped network may leave: both may be its coarseness.

    A finding must explain more than what stays beside it, and each of its effects more than any coarse network may have left, or
    be likelier by far whatever the misfit is taken for.
    Where the model fits to the noise nothing stays, and every finding stands. The weakest goes first: what it explained then
    counts as unexplained, unless the others explain it too; what is left of a set that lost a member is examined as any option.
    """
    while state.findings:
        left, n_readings = mean_excess(state.trial), state.trial.n_samples
        if left <= by_chance(n_readings):
            return
        named = {f.judged.places for f in state.findings if not all(effect.fallback for effect in f.effects)}
        asked: dict[frozenset[object], float] = {}
        for finding in state.findings:
            places = finding.judged.places
            asked |= {frozenset([place]): least_explained(0.0, left, n_readings) for place in places}
            asked[places] = least_explained(state.trial.unexplained(), left, n_readings, is_named=places in named)
        without = _without_each(state, asked)
        told = {
            places: _times(state, kept[0], asked[places], places, named) for places, kept in without.items() if kept
        }
        weakest = min(told, key=lambda places: told[places], default=None)
        if weakest is None or told[weakest] >= 1.0:
            return
        for finding in state.findings:
            effects = tuple(effect for effect in finding.effects if effect.place in weakest)
            if effects:
                state.rejected.append(replace(finding.judged, effects=effects, reason=NO_MORE))
        kept = without[weakest]
        assert kept is not None
        shrunk = [f for f in state.findings if any(e.place in weakest for e in f.effects)]
        rests = [{e.place for e in f.effects} - weakest for f in shrunk]
        _drop(state, weakest, *kept)
        for rest in filter(None, rests):
            _examine_again(state, rest, needed)


def foretell_together(state: Search) -> None:
    """Drop findings until those left predict, together, what they were not fitted to better than the declared model does.

    Each finding was examined beside the earlier ones only, with the parameters fitted at that time. The finding is dropped whose
    removal leaves the rest predicting best. A single finding was compared with the declared model when it was made; it is asked
    again only after others have been dropped.
    """
    n_found = len(state.findings)
    while len(state.findings) > 1 or 0 < len(state.findings) < n_found:
        together = _foretold(state, state.trial, "what all findings foretell together")
        if together is None or together < 1.0:
            return
        rests = _without_each(state, [finding.judged.places for finding in state.findings])
        foretold: list[tuple[float, Finding, Without]] = []
        for finding in state.findings:
            kept = rests[finding.judged.places]
            rest = kept and _foretold(state, kept[0], f"what is foretold without {finding.judged.labels}")
            foretold += [(rest, finding, kept)] if kept and rest is not None else []
        if not foretold:
            return
        _, gone, kept = min(foretold, key=lambda item: item[0])
        state.rejected.append(replace(gone.judged, validation=None, reason=NO_FORESIGHT_TOGETHER))
        _drop(state, gone.judged.places, *kept)


def withdraw_superfluous(state: Search, needed: float) -> None:
    """Withdraw a name beside which more stays than a coarse network leaves, if a far likelier option makes it superfluous.

    The option was refused because its size is not determined, or because it does not predict well enough, so that it cannot be
    named; but the readings speak for it by far, and no longer for the name once the option is there. Each name is asked against
    the same options, and what is left is examined as before.
    """
    likelier = state.attempt(
        partial(_far_likelier, state, needed), "refused options that are likelier than what was found"
    )
    gone: list[Finding] = []
    for finding in [f for f in state.findings if not all(effect.fallback for effect in f.effects)]:
        unlike = [j for j in likelier or () if not {e.place for e in j.trial.effects} & finding.judged.places]
        if any(_makes_superfluous(state, option, finding, needed) for option in unlike):
            gone.append(finding)
    for finding in gone:
        kept = attempted_without(state, finding.judged.places)
        if kept is not None:
            state.rejected += [replace(j, reason=SUPERFLUOUS) for j in (finding.judged, *finding.alternatives)]
            _drop(state, finding.judged.places, *kept)
    if gone and state.findings:
        withdraw(state, needed)


def _far_likelier(state: Search, needed: float) -> list[Judged]:
    """Return refused options that are likelier than all that was found, the likeliest first, where more stays than coarseness.

    By the odds asked for, chosen among all that were tried, and by so many times what chance makes of the log-likelihood of so
    many readings as a name must be likelier by that explains too little (``DOMINANCE``).
    """
    if not state.findings or state.trial.unexplained() <= policy.MOST_COARSENESS:
        return []
    margin = needed + policy.DOMINANCE * float(np.sqrt(0.5 * state.trial.n_samples))
    refused = [j for j in state.rejected if j.reason in (NO_FORESIGHT, SIZE_NOT_DETERMINED)]
    found = state.trial.log_evidence()
    gains = [(paid(j.trial.log_evidence() - found, state.trial, j.trial, max(state.n_named, 1)), j) for j in refused]
    return [j for gain, j in sorted(gains, key=lambda item: -item[0]) if gain > margin]


def _makes_superfluous(state: Search, option: Judged, finding: Finding, needed: float) -> bool:
    """Return whether a finding is not supported beside an option: by the likelier of fits from either."""

    def gained() -> float:
        both = (*option.trial.effects, *finding.effects)
        fits = those_that_work(
            [partial(try_effects, start, both, n_passes=12) for start in (option.trial, state.trial)]
        )
        return max(weigh(option.trial, fit, 1).log_bayes_factor for fit in fits)

    nats = state.attempt(gained, f"{finding.judged.labels} beside {option.labels}")
    return nats is not None and nats <= needed


def _foretold(state: Search, trial: Trial, what: str) -> float | None:
    """Return the error of a trial on what it was not fitted to, over that of the declared model; None where it is not known."""
    if not trial.effects:
        return 1.0
    validation = state.attempt(partial(validate, state.base, trial), what)
    if validation is None:
        return None
    return validation.foresight if np.isfinite(validation.foresight) else np.inf


def _times(
    state: Search, without: Trial, asked: float, places: frozenset[object], named: Collection[frozenset[object]]
) -> float:
    """Return how many times as much as is asked of them the effects at places explain, or are likelier, beside all others."""
    shown = partial(_alone, state, places, named)
    times = times_asked(without, state.trial, asked, shown)
    return times if times >= 1.0 else max(times, times_likely(without, state.trial, shown))


def _alone(
    state: Search, places: frozenset[object], named: Collection[frozenset[object]]
) -> tuple[Trial, Trial] | None:
    """Return the trials without any finding and with those of names at places alone; None where that cannot be computed."""
    if places not in named:
        return None
    others = frozenset(effect.place for finding in state.findings for effect in finding.effects) - places
    if not others:
        return state.base, state.trial
    kept = attempted_without(state, others)
    return None if kept is None else (state.base, kept[0])


def _examine_again(state: Search, places: Collection[object], needed: float, *, foresight: float = -np.inf) -> None:
    """Withdraw the finding at places if by itself it is not supported or does not pass what any option must.

    Little that it leaves was explained by what has gone. Error on what it was not fitted to, after over before, is enough below
    ``foresight`` too.
    """
    without = attempted_without(state, places)
    finding = next(f for f in state.findings if f.judged.places == places)
    if without is None:
        return
    simple, nats = without
    option = replace(
        finding.judged, trial=state.trial, evidence=replace(finding.judged.evidence, log_bayes_factor=nats)
    )
    if nats <= needed:
        state.rejected.append(replace(option, reason=NOT_SUPPORTED))
        _drop(state, places, *without)
        return
    examined = state.attempt(partial(examine, simple, option, needed), option.labels)
    if examined is None:
        return
    own, _ = examined
    predicts = own.reason == NO_FORESIGHT and foresight_of(own) < foresight
    if predicts or own.reason in ("", SMALL_REMAINDER):
        again = replace(finding, judged=replace(own, reason=""))
        state.trial = own.trial
        state.findings = [again if f is finding else f for f in state.findings]
        return
    state.rejected.append(own)
    _drop(state, places, *without)


def _in_place_of(
    state: Search, finding: Finding, option: Judged, needed: float, margin: float, foresight: float
) -> Judged | None:
    """Put an option in the place of a finding if it is likelier by a margin and passes the examination.

    The option must be supported by the odds asked for in any case, and its error on what it was not fitted to must be below
    ``foresight`` times that of the finding. Returns the option as refitted there, with the reason if it does not pass; None
    where it is not likely enough to be examined, or predicts too little to replace the finding.
    """
    places = finding.judged.places
    kept = attempted_without(state, places)
    if kept is None:
        return None
    without, lost = kept
    trial = try_effects(option.trial, (*without.effects, *option.effects), n_passes=12)
    instead = Judged(trial.effects[len(without.effects) :], weigh(without, trial, max(state.n_named, 1)), trial)
    if instead.evidence.log_bayes_factor <= max(needed, lost + margin):
        return None
    examined, _ = examine(without, instead, needed)
    if examined.reason:
        return examined
    if foresight < np.inf and not foresight_of(examined) < foresight * validate(without, state.trial).foresight:
        return None
    state.rejected = [j for j in state.rejected if j.effects != option.effects]
    state.rejected.append(replace(finding.judged, reason=OUTDONE))
    state.findings = [Finding(examined) if f is finding else f for f in state.findings]
    state.trial = examined.trial
    return examined


def prune(state: Search, needed: float) -> None:
    """Drop findings, and members of a set that was found together, that the others have made superfluous.

    Beside the others each must be supported by the odds asked for, and explain at one sensor at least what the search would
    look for. What is left of a set that lost a member is examined as any option, for nobody has asked whether it holds alone;
    as the set has shown its foresight, no more is asked than that the rest predicts no worse.
    """
    for finding in list(state.findings):
        rest = set(finding.judged.places)
        for effect in finding.effects:
            if all(other.place == effect.place for other in state.trial.effects):
                continue
            kept = attempted_without(state, {effect.place})
            if kept is not None and (kept[1] <= needed or _explains_nothing(kept[0], state.trial)):
                _drop(state, {effect.place}, *kept)
                rest.discard(effect.place)
        if rest and len(rest) < len(finding.effects):
            _examine_again(state, rest, needed, foresight=1.0)


def _explains_nothing(without: Trial, trial: Trial) -> bool:
    """Return whether a trial has no sensor that leaves less than without an effect by what counts as missing."""
    return bool((without.excess() - trial.excess()).max() < policy.LEAST_EXCESS)


def reconsider(state: Search, needed: float) -> None:
    """Name an option that was refused for the little heat that it leaves, if what was found instead is no better.

    Nothing was found, a heat without a name that predicts no better or hardly explains more beside a coarse network, or one name
    that is less likely and predicts worse. The likeliest such option is named that stands whole: what a part of it explains
    beside a coarse network may be no effect of its own. A search that was cut short may have left out a better one, so that what
    it refused stays refused.
    """
    if len(state.findings) > 1 or state.left_out:
        return
    named = [f for f in state.findings if not all(effect.fallback for effect in f.effects)]
    little = [
        j
        for j in state.rejected
        if j.reason == SMALL_REMAINDER
        and len(j.trial.effects) == len(j.effects)
        and all(worth(j) < worth(f.judged) and foresight_of(j) < f.foresight for f in named)
    ]
    for option in sorted(little, key=worth)[:N_RECONSIDERED]:
        rest = [j for j in state.rejected if j.effects != option.effects]
        instead = replace(state, trial=option.trial, findings=[Finding(replace(option, reason=""))], rejected=rest)
        withdraw(instead, needed)
        stands_whole = [len(f.effects) for f in instead.findings] == [len(option.effects)]
        as_much = not named and _explains_as_much(state.base, instead.trial, state.trial)
        if stands_whole and (as_much or all(_is_better(instead.findings[0], other) for other in state.findings)):
            instead.rejected += [replace(f.judged, reason=OUTDONE) for f in named]
            state.join(instead)
            return


def _explains_as_much(simple: Trial, named: Trial, heat: Trial) -> bool:
    """Return whether a name explains all but a little of what a heat without one explains, where the network is coarse.

    What stays beside the heat is then visible and no more than coarseness, which leans towards whatever has more freedom.
    """
    if mean_excess(heat) <= by_chance(heat.n_samples) or heat.unexplained() > policy.MOST_COARSENESS:
        return False
    return explained(simple, named) >= (1.0 - policy.REPEATABLE_SHARE) * explained(simple, heat, named)


def _is_better(name: Finding, heat: Finding) -> bool:
    """Return whether a name predicts better than what was found, or is likelier where chance tells them apart no further."""
    if heat.foresight * policy.FORESIGHT <= name.foresight <= heat.foresight / policy.FORESIGHT:
        return worth(name.judged) < worth(heat.judged)
    return name.foresight < heat.foresight


def tell_alternatives(state: Search, needed: float) -> None:
    """Tell beside each finding the names that a coarse network cannot tell from it; they count as refused no more.

    A name is withdrawn where another one in its place is likelier by the odds asked for but predicts too little to be named:
    likelihood and prediction then contradict each other, and neither name can be told.
    """
    findings = list(state.findings)
    for i, finding in enumerate(findings):
        kept = attempted_without(state, finding.judged.places)
        if kept is None:
            continue
        with state.during(i / len(findings), (i + 1) / len(findings)):
            compared = state.attempt(
                partial(add_coarse_alternatives, state, kept[0], finding, needed),
                f"alternatives to {finding.judged.labels}",
            )
        if compared is None:
            continue
        position = next(i for i, f in enumerate(state.findings) if f is finding)
        state.findings[position] = compared
        unforeseen = _lead_with_the_best(state, position, needed)
        told = state.findings[position]
        least = kept[1] if told.judged is finding.judged else told.judged.evidence.log_bayes_factor
        contradicting = {j.places for j in unforeseen if j.evidence.log_bayes_factor > least + needed}
        places = {e.place for option in told.alternatives for e in option.effects}
        state.rejected = [j for j in state.rejected if not (len(j.effects) == 1 and j.effects[0].place in places)]
        if contradicting and not all(effect.fallback for effect in told.effects):
            undecided = {told.judged.places, *contradicting}
            options = (told.judged, *told.alternatives)
            state.rejected += [replace(j, reason=UNDECIDED if j.places in undecided else OUTDONE) for j in options]
            _drop(state, told.judged.places, *kept)


def _lead_with_the_best(state: Search, position: int, needed: float) -> list[Judged]:
    """Exchange a finding for the best of its alternatives that passes, if it is simpler, likelier, or predicts better.

    A simpler one leads that the readings hardly tell from it, and of those as simple the likeliest. The first look ranks by
    linear responses, and what it left out may turn out to explain more: likelier by the odds asked for, or leaving less and
    predicting better what it was not fitted to. The finding is an alternative then. Returns the options that were likely enough
    in its place and were refused because they do not predict better than the model without them.
    """
    finding = state.findings[position]
    own = finding.judged
    ranked = sorted(finding.alternatives, key=worth)
    simple = [j for j in ranked if is_close(j, own) and (complexity(j), worth(j)) < (complexity(own), worth(own))]
    likelier = [j for j in ranked if worth(j) < worth(own) - needed and all(j is not s for s in simple)]
    better = [(j, -policy.ALTERNATIVE_NATS, np.inf) for j in simple] + [(j, needed, np.inf) for j in likelier]
    no_freer = [j for j in ranked if complexity(j)[0] <= complexity(own)[0]]
    asked = ((j, state.attempt(j.trial.unexplained, j.labels)) for j in no_freer)
    less = [(value, j) for j, value in asked if value is not None and value < state.trial.unexplained()]
    better += [(j, -np.inf, policy.FORESIGHT) for _, j in sorted(less, key=lambda option: option[0])[:N_EXCHANGED]]
    unforeseen = []
    for best, margin, foresight in better:
        replaced = partial(_in_place_of, state, finding, best, needed, margin, foresight)
        instead = state.attempt(replaced, f"{best.labels} in place of {finding.judged.labels}")
        if instead is None:
            continue
        if not instead.reason:
            others = [option for option in finding.alternatives if option is not best]
            alternatives = tuple(sorted((finding.judged, *others), key=worth))
            state.findings[position] = replace(state.findings[position], alternatives=alternatives)
            break
        unforeseen += [instead] if instead.reason == NO_FORESIGHT else []
    return unforeseen


def attempted_without(state: Search, places: Collection[object]) -> Without | None:
    """Return the trial without the effects at places, and their log Bayes factor; None where it cannot be computed.

    The answer is kept with the trial, of which it is asked several times.
    """
    gone = frozenset(places)
    return _without_each(state, [gone])[gone]


def _refitted(effects: Sequence[Effect], state: Search) -> Trial:
    """Return the likeliest trial of some effects of a search: one it went on from, or a fit from above and one from below.

    What was fitted beside effects that are taken away may be caught far from where it belongs without them.
    """
    wanted = _forms(effects)
    known = {_forms(trial.effects): trial for trial in (state.base, *state.past)}
    if wanted in known:
        return known[wanted]
    below = known[max((forms for forms in known if forms < wanted), key=len)]
    there = {effect.place for effect in below.effects}
    more = [effect for effect in effects if effect.place not in there]
    starts = [(state.trial, effects), (below, (*below.effects, *more))]
    fits = those_that_work([partial(try_effects, *start, n_passes=10) for start in starts])
    return max(fits, key=lambda trial: weigh(state.base, trial, 1).log_bayes_factor)


def _forms(effects: Sequence[Effect]) -> frozenset[object]:
    """Return what effects are and where, and with how many parameters."""
    return frozenset((effect.place, effect.n_free) for effect in effects)


def _without_each(state: Search, sets: Collection[frozenset[object]]) -> dict[frozenset[object], Without | None]:
    """Return what :func:`attempted_without` does for each of several sets of places, computed side by side."""
    if state.without is None or state.without[0] is not state.trial:
        state.without = state.trial, {}
    known = state.without[1]

    def weighed(gone: frozenset[object]) -> Without:
        without = _refitted([effect for effect in state.trial.effects if effect.place not in gone], state)
        return without, weigh(without, state.trial, 1).log_bayes_factor

    new = [gone for gone in dict.fromkeys(sets) if gone not in known]
    labels = {gone: [effect.label for effect in state.trial.effects if effect.place in gone] for gone in new}
    works = [(partial(weighed, gone), "the model without " + " and ".join(labels[gone])) for gone in new]
    known |= zip(new, state.attempt_each(works), strict=True)
    return {gone: known[gone] for gone in sets}


def _drop(state: Search, places: Collection[object], without: Trial, lost: float) -> None:
    """Go on without the effects at places, whose log Bayes factor was ``lost``."""
    state.trial = without
    for place in places:
        state.findings = [f.without(place, lost, without) for f in state.findings]
    state.findings = [f for f in state.findings if f.effects]
