"""Judgement: what was tried, what speaks for it, and whether that is enough to name it."""

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from twin_core._typing import Progress, no_progress
from twin_core.calibrate.containment import NO_DEADLINE, TimeIsUpError, attempted, check_time, limited
from twin_core.discover import policy
from twin_core.discover.coarseness import stands
from twin_core.discover.coincidence import at_an_end, coinciding_channel
from twin_core.discover.evidence import Evidence, Validation, validate, weigh
from twin_core.discover.form import acts_at, against_free_forms, more_is_left_elsewhere
from twin_core.discover.spare import without_spare
from twin_core.discover.trial import Trial, by_chance, explained, mean_excess
from twin_core.discover.wald import least_wald_score, score_needed
from twin_core.effects.base import Effect, Place
from twin_core.errors import ModelError
from twin_core.once import keep, known
from twin_core.progress import Part
from twin_core.side_by_side import ahead
from twin_core.simulate.rollout import hurried

T = TypeVar("T")

N_VALIDATED = 8
"""Options that are validated at most, a limit of time: a right one has been the seventh likeliest in a coarse network."""

Without = tuple[Trial, float]
"""A trial without some of its effects, and their log Bayes factor."""

NOT_SUPPORTED = "the evidence does not reach the odds asked for"
NO_FORESIGHT = "it does not predict what it was not fitted to better than the model without it"
NO_FORESIGHT_TOGETHER = (
    "with the other findings it does not predict what it was not fitted to better than the declared model"
)
SIZE_NOT_DETERMINED = "the record does not determine its size: other parameters of the model make up for it"
LESS_LIKELY = "the readings are less likely along its trajectories than along those of the model without it"
NO_MODEL = "the corrected model could not be computed"
MISTAKE = "a mistake of the declaration would explain the readings better without any missing physics"
NO_MORE = "it explains no more than what stays unexplained beside it, which a lumped network may leave as well"
OUTDONE = "another effect in its place explains the readings better"
UNDECIDED = "one name predicts better and another one is far likelier, so that neither is told"
SUPERFLUOUS = "a far likelier effect, which cannot be named itself, explains what it explains"
COINCIDES = "it sets in when an input changes as nowhere else, which a law of that input would look like"
AT_AN_END = "it sets in or ends where the record does, where too little tells it from what was so all along"
NOT_EXAMINED = "its predictions could not be examined"
NO_LAW = "a heat that repeats with temperature is left where it acts, so that the name would be wrong"
SMALL_REMAINDER = "a heat that repeats with temperature is left where it acts, though little beside what it explains"


@dataclass(frozen=True)
class Judged:
    """A set of effects that was tried on top of a simpler model, and what speaks for it."""

    effects: tuple[Effect, ...]
    evidence: Evidence
    trial: Trial
    validation: Validation | None = None
    reason: str = ""
    """Why it was not named, in words."""

    @property
    def labels(self) -> str:
        """Return its effects and their places: ``radiation_to_sink(px,space)``."""
        return " with ".join(effect.label for effect in self.effects)

    @property
    def places(self) -> frozenset[Place]:
        """Return names and places of its effects as a key."""
        return frozenset(effect.place for effect in self.effects)


@dataclass(frozen=True)
class Finding:
    """Effects that the record supports together, and what it cannot tell them from."""

    judged: Judged
    alternatives: tuple[Judged, ...] = ()

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects, at the values of the trial that found them."""
        return self.judged.effects

    @property
    def foresight(self) -> float:
        """Error on what they were not fitted to, after over before."""
        return foresight_of(self.judged)

    def without(self, place: object, worth_of_it: float, trial: Trial) -> "Finding":
        """Return the finding without its effect at a place, whose log Bayes factor was ``worth_of_it``, if it has one."""
        kept = tuple(effect for effect in self.effects if effect.place != place)
        if len(kept) == len(self.effects):
            return self
        rest = self.judged.evidence.log_bayes_factor - worth_of_it
        evidence = replace(self.judged.evidence, log_bayes_factor=rest)
        # A larger set would name again what was withdrawn.
        others = tuple(j for j in self.alternatives if len(j.effects) <= len(kept))
        return Finding(replace(self.judged, effects=kept, evidence=evidence, trial=trial), others)


@dataclass
class Search:
    """The state of a search.

    Attributes
    ----------
    trial, base
        The model so far, and as it was declared.
    n_named
        Candidates that were tried before a fallback.
    deadline
        On the clock of ``time.monotonic``: what is not fitted by then is left out.
    findings, rejected
        What is supported, and what was tried and is not.
    failures
        Candidates whose arithmetic failed, with the reason.
    left_out
        What was not looked at for want of time.
    every
        Of how many samples of the training record the search looked at one.
    first
        Places of effects that spacecraft of the same design have: they are tried wherever they could matter.
    past
        Trials from which the search went on, each with what had been found by then.
    without
        The trial so far, and by places what it is without the effects there, as far as anybody has asked.
    progress
        Told how far the search is, by this process alone: what a forked one told would be lost, or worse.
    """

    trial: Trial
    base: Trial
    n_named: int = 0
    deadline: float = NO_DEADLINE
    findings: list[Finding] = field(default_factory=list)
    rejected: list[Judged] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    every: int = 1
    first: Collection[Place] = ()
    past: tuple[Trial, ...] = ()
    without: tuple[Trial, dict[frozenset[object], "Without | None"]] | None = None
    progress: Part = field(default_factory=Part)

    @contextmanager
    def until(self, deadline: float) -> Iterator[None]:
        """Work to an earlier deadline for a while."""
        own, self.deadline = self.deadline, deadline
        try:
            yield
        finally:
            self.deadline = own

    @contextmanager
    def during(self, start: float, stop: float, words: str = "") -> Iterator[None]:
        """Tell progress as a part of what is under way, for a while."""
        own, self.progress = self.progress, self.progress.part(start, stop, words)
        try:
            yield
        finally:
            self.progress = own

    def fork(self) -> "Search":
        """Return a search that starts from here and shares what failed or was left out."""
        return replace(self, findings=list(self.findings), rejected=list(self.rejected))

    def join(self, fork: "Search") -> None:
        """Go on from where a fork has come to."""
        self.trial, self.findings, self.rejected = fork.trial, fork.findings, fork.rejected
        self.n_named = max(self.n_named, fork.n_named)

    def attempt(self, work: Callable[[], T], what: str) -> T | None:
        """Return what ``work`` returns; None where it fails numerically or time is up, which is kept under ``what``.

        A candidate whose values run away is as unlikely as can be: NumPy's warnings on the way are nobody's business.
        """
        try:
            with limited(self.deadline), hurried(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                check_time()
                return attempted(work, what, self.failures)
        except TimeIsUpError:
            self.left_out.append(what)
        except ModelError as error:
            self.failures.append(f"{what}: {error}")
        return None

    def attempt_each(
        self, works: Sequence[tuple[Callable[[], T], str]], progress: Progress = no_progress
    ) -> list[T | None]:
        """Return what :meth:`attempt` returns of each piece of work and its name, done side by side: what they change is lost."""

        def told(i: int) -> T | None:
            progress(i / len(works), f"{i + 1} of {len(works)}")
            return result(i)

        with self.attempts_ahead(works) as result:
            return [told(i) for i in range(len(works))]

    @contextmanager
    def attempts_ahead(self, works: Sequence[tuple[Callable[[], T], str]]) -> Iterator[Callable[[int], T | None]]:
        """Hand out what :meth:`attempt` returns of each piece of work and its name, as ``side_by_side.ahead`` does."""

        def attempted_apart(work: Callable[[], T], what: str) -> tuple[T | None, list[str], list[str]]:
            apart = replace(self, failures=[], left_out=[])
            return apart.attempt(work, what), apart.failures, apart.left_out

        with ahead([partial(attempted_apart, work, what) for work, what in works]) as told:

            def result(i: int) -> T | None:
                value, failures, left_out = told(i)
                self.failures += failures
                self.left_out += left_out
                return value

            yield result

    def give_up(self, reason: str) -> None:
        """Give all findings up, for a reason: the declared model stays."""
        self.rejected += [replace(finding.judged, reason=reason) for finding in self.findings]
        self.findings, self.trial = [], self.base

    def count(self, n_looked_at: int, *, fallback: bool) -> int:
        """Return how many effects and places were tried: a fallback comes after all the named ones."""
        if fallback:
            return self.n_named + n_looked_at
        self.n_named = n_looked_at
        return n_looked_at


def threshold(false_alarm_rate: float) -> float:
    """Return the log Bayes factor that an effect must reach: the odds of the false-alarm rate."""
    return float(np.log(1.0 / false_alarm_rate))


def accept(state: Search, options: Sequence[Judged], needed: float) -> bool:
    """Keep the best option that passes evidence and validation; False if none does.

    A name that would be withdrawn, for it explains too little beside what stays, is kept only where no other one passes.
    """
    judged = simplest_first(once_each(options))
    is_free = any(effect.fallback for j in judged[:1] for effect in j.effects)
    weak = [replace(j, reason=NOT_SUPPORTED) for j in judged if j.evidence.log_bayes_factor <= needed]
    refused: list[Judged] = []
    passed: list[Judged] = []
    unlike: list[Judged] = []
    likely = [j for j in judged if j.evidence.log_bayes_factor > needed]
    with _examined(state, likely, needed) as examined:
        for i, best in enumerate(likely):
            if sum(j.validation is not None for j in refused) + len(passed) >= N_VALIDATED:
                break
            same_heat = [r for r in unlike if acts_at(r.trial, r.effects) == acts_at(best.trial, best.effects)]
            if same_heat:
                left = state.attempt(best.trial.unexplained, best.labels)
                if left is None:
                    refused.append(replace(best, reason=NOT_EXAMINED))
                more_than_chance = by_chance(best.trial.n_samples)
                if left is None or any(left + more_than_chance >= r.trial.unexplained() for r in same_heat):
                    continue  # what explains no more where it acts is no better a name for this heat
            own, resembles = examined(i)
            if own.reason:
                refused.append(own)
                if resembles:
                    unlike.append(own)
            else:
                passed.append(own)
                if is_free or stands(state.trial, own.trial):
                    break
    state.rejected += refused
    if not passed:
        state.rejected += weak
        return False
    named = passed[-1] if is_free or stands(state.trial, passed[-1].trial) else passed[0]
    # What passed before it but explains too little is no alternative to a name that stands.
    less = [j for j in passed if j is not named and (named is not passed[0] or not is_close(j, named))]
    state.rejected += [replace(j, reason=NO_MORE) for j in less]
    others = [j for j in judged if j.places != named.places and all(j.effects != r.effects for r in refused + less)]
    state.findings.append(Finding(named, tuple(j for j in others if is_close(j, named))))
    state.trial = named.trial
    return True


@contextmanager
def _examined(
    state: Search, options: Sequence[Judged], needed: float
) -> Iterator[Callable[[int], tuple[Judged, bool]]]:
    """Hand out what :func:`examine` returns of each option: the first alone, as it mostly passes, then more side by side."""
    simple = state.trial

    def apart(option: Judged) -> tuple[tuple[Judged, bool], dict[str, Any]]:
        examined = examine(simple, option, needed)
        return examined, known(examined[0].trial)

    with state.attempts_ahead([(partial(apart, j), j.labels) for j in options[1:]]) as told:

        def result(i: int) -> tuple[Judged, bool]:
            if i == 0:
                examined = state.attempt(partial(examine, simple, options[0], needed), options[0].labels)
            else:
                examined, learnt = told(i - 1) or (None, {})
                keep(options[i].trial if examined is None else examined[0].trial, learnt)
            return examined or (replace(options[i], reason=NOT_EXAMINED), False)

        yield result


def examine(simple: Trial, judged: Judged, needed: float) -> tuple[Judged, bool]:
    """Return an option with how it predicts, the reason why it cannot be named if there is one, and whether it is no law.

    What passes must pass without the amplitudes that the readings do not pay for too, and is returned without them.
    """
    examined = _as_it_is(simple, judged, needed)
    less = judged if examined[0].reason else _without_spare(simple, judged)
    return examined if less is judged else _as_it_is(simple, less, needed)


def _as_it_is(simple: Trial, judged: Judged, needed: float) -> tuple[Judged, bool]:
    """Return the same of an option with all that it has.

    A correction is handed out as trajectories: one that wandering heat alone supports must not make these less likely.
    """
    if judged.trial.calibration().log_posterior < simple.calibration().log_posterior:
        return replace(judged, reason=LESS_LIKELY), False
    if least_wald_score(simple, judged.trial) < score_needed(needed):
        return replace(judged, reason=SIZE_NOT_DETERMINED), False
    if coinciding_channel(judged.trial, judged.effects) is not None:
        return replace(judged, reason=COINCIDES), False
    if at_an_end(judged.trial, judged.effects):
        return replace(judged, reason=AT_AN_END), False
    validation = validate(simple, judged.trial)
    if not validation.foresight < policy.FORESIGHT ** len(judged.effects):
        return replace(judged, validation=validation, reason=NO_FORESIGHT), False
    reason = _merely_resembles(simple, judged, needed)
    return replace(judged, validation=validation, reason=reason), bool(reason)


def _without_spare(simple: Trial, judged: Judged) -> Judged:
    """Return an option with the amplitudes only that the readings pay for."""
    trial = without_spare(simple, judged.trial)
    if trial is judged.trial:
        return judged
    places = judged.places
    effects = tuple(effect for effect in trial.effects if effect.place in places)
    gained = judged.evidence.log_bayes_factor - weigh(trial, judged.trial, 1).log_bayes_factor
    return replace(judged, effects=effects, evidence=replace(judged.evidence, log_bayes_factor=gained), trial=trial)


def _merely_resembles(simple: Trial, judged: Judged, needed: float) -> str:
    """Return why named effects are not the law of the heat that they stand for, if they are not; a free form claims no law.

    What a sensor does is no heat: one that is left beside it is another matter, unless it explains the readings far better.
    """
    named = [effect for effect in judged.effects if not effect.fallback]
    if not named:
        return ""
    heats = [effect for effect in named if "sensor" not in effect.where]
    most = most_left(judged.evidence.log_bayes_factor, needed)
    trial = judged.trial
    beside, other = against_free_forms(simple, trial, acts_at(trial, heats), named, needed, most)
    left = [beside.removed] if beside.log_bayes_factor > most else []
    left += [other] if other is not None else []
    if not left or _hardly_shows(simple, trial, max(left)):
        return ""
    if more_is_left_elsewhere(trial, named, needed, beside if heats == named else None):
        return ""
    return SMALL_REMAINDER if max(left) <= _little(simple, trial, max(left)) else NO_LAW


def _hardly_shows(simple: Trial, trial: Trial, removed: float) -> bool:
    """Return whether the temperatures of a repeatable heat are a small share of those that a name explains, and more stays.

    More by what chance leaves at least: where the name explains all, a heat that explains it as well is no small matter.
    """
    stays = trial.unexplained() - removed - by_chance(trial.n_samples)
    return removed <= min(policy.REPEATABLE_SHARE**2 * explained(simple, trial), stays)


def _little(simple: Trial, trial: Trial, removed: float) -> float:
    """Return up to what variance a repeatable heat beside a name is little, in units of the sensors' noise.

    That is a share of what the name removes, and no more than the network is seen to leave beside either, beyond chance, and any
    coarse one may, or than as large a share of what stays: where a model misses so much else, a law is not told wrong by less.
    """
    taken = removed + by_chance(trial.n_samples)
    coarse, stays = min(policy.MOST_COARSENESS, mean_excess(trial) - taken), trial.unexplained() - taken
    share = policy.REPEATABLE_SHARE
    return min(share * explained(simple, trial), max(coarse, share * stays))


def most_left(log_bayes_factor: float, needed: float) -> float:
    """Return how much evidence a repeatable heat beside a name may have, given that of the name."""
    return max(needed, policy.REPEATABLE_SHARE * log_bayes_factor)


def once_each(options: Sequence[Judged]) -> list[Judged]:
    """Return the options, best first, every set of effects, places and numbers of amplitudes once."""
    best: dict[object, Judged] = {}
    for judged in sorted(options, key=worth):
        best.setdefault(frozenset((effect.place, len(effect.amplitudes)) for effect in judged.effects), judged)
    return list(best.values())


def simplest_first(judged: Sequence[Judged]) -> list[Judged]:
    """Return options, best first, with the simplest of those in front that the data hardly tell from the best."""
    close = [j for j in judged if j is judged[0] or is_close(j, judged[0])]
    rest = [j for j in judged if all(j is not c for c in close)]
    return sorted(close, key=complexity) + rest


def complexity(judged: Judged) -> tuple[int, int]:
    """Return how many parameters effects have, and how many of them go against what is declared of their boundary.

    What the declared network radiates to alone is deep space mostly, where nothing conducts or carries heat away: of two names
    that the data hardly tell apart, the one by radiation is told first.
    """
    spec = judged.trial.fit.problem.network.spec
    joined = {end for conductor in spec.conductors for end in conductor.between}
    radiated_to = {radiator.sink for radiator in spec.radiators} - joined
    by_matter = [e for e in judged.effects if "node" in e.where and e.where.get("boundary") in radiated_to]
    return sum(effect.n_free for effect in judged.effects), len(by_matter)


def foresight_of(judged: Judged) -> float:
    """Return the error on what an option was not fitted to, after over before; one where nobody has looked."""
    return 1.0 if judged.validation is None else judged.validation.foresight


def worth(judged: Judged) -> float:
    return -judged.evidence.log_bayes_factor


def is_close(other: Judged, best: Judged) -> bool:
    """Return whether the data hardly tell another option from the best one."""
    return other.evidence.log_bayes_factor > best.evidence.log_bayes_factor - policy.ALTERNATIVE_NATS
