"""Judgement: what was tried, what speaks for it, and whether that is enough to name it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from twin_core.discover.confirm import Evidence, Trial, Validation, validate
from twin_core.discover.form import leaves_a_repeatable_heat, outdone_by_a_free_form
from twin_core.effects.base import Effect

N_VALIDATED, N_VALIDATED_FREE = 3, 8
"""Options that are validated at most: of named effects, and of free forms, which come in several degrees."""

ALTERNATIVE_NATS = 3.0
FORESIGHT = 0.97
"""An effect must lower the error on what it was not fitted to by 3 % at least, or it is not worth its name."""

UNEXPLAINED_SHARE = 1.0
"""Misfit over noise beyond which a record without a supported effect is called unexplained."""

REPEATABLE_SHARE = 0.1
"""A name stands while the repeatable heat that it leaves is worth less than so much of its own evidence."""


@dataclass(frozen=True)
class Judged:
    """A set of effects that was tried on top of a simpler model, and what speaks for it."""

    effects: tuple[Effect, ...]
    evidence: Evidence
    trial: Trial
    validation: Validation | None = None


@dataclass(frozen=True)
class Finding:
    """Effects that the record supports together, and what it cannot tell them from."""

    judged: Judged
    alternatives: tuple[Judged, ...] = ()

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects, at the values of the trial that found them."""
        return self.judged.effects

    def without(self, place: object, worth_of_it: float, trial: Trial) -> "Finding":
        """Return the finding without its effect at a place, whose log Bayes factor was ``worth_of_it``, if it has one."""
        kept = tuple(effect for effect in self.effects if effect.place != place)
        if len(kept) == len(self.effects):
            return self
        rest = self.judged.evidence.log_bayes_factor - worth_of_it
        evidence = replace(self.judged.evidence, log_bayes_factor=rest)
        return replace(self, judged=replace(self.judged, effects=kept, evidence=evidence, trial=trial))


@dataclass
class Search:
    """The state of a search: the model so far and how it came about; ``n_named`` candidates were tried before a fallback."""

    trial: Trial
    base: Trial
    n_named: int = 0
    findings: list[Finding] = field(default_factory=list)
    rejected: list[Judged] = field(default_factory=list)

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
    """Keep the best option that passes evidence and validation; False if none does."""
    judged = simplest_first(once_each(options))
    failed: list[Judged] = []
    is_free = any(effect.fallback for j in judged[:1] for effect in j.effects)
    for best in judged[: N_VALIDATED_FREE if is_free else N_VALIDATED]:
        if best.evidence.log_bayes_factor <= needed:
            continue
        validation = validate(state.trial, best.trial)
        own = replace(best, validation=validation)
        if is_valid(validation):
            if _merely_resembles(state.trial, own, needed):
                state.rejected.append(own)  # what explains less is no better a name for this heat
                break
            elsewhere = [j for j in judged if _places(j) != _places(best) and j not in failed]
            close = [j for j in elsewhere if is_close(j, best)]
            state.trial = best.trial
            state.findings.append(Finding(own, tuple(close)))
            return True
        failed.append(best)
        state.rejected.append(own)
    state.rejected += [j for j in judged if j.evidence.log_bayes_factor <= needed]
    return False


def _merely_resembles(simple: Trial, judged: Judged, needed: float) -> bool:
    """Return whether named effects are not the law of the heat that they stand for; a free form claims no law."""
    named = [effect for effect in judged.effects if not effect.fallback]
    most = max(needed, REPEATABLE_SHARE * judged.evidence.log_bayes_factor)
    return bool(named) and (
        leaves_a_repeatable_heat(judged.trial, named, needed, most)
        or outdone_by_a_free_form(simple, judged.trial, named, needed, most)
    )


def once_each(options: Sequence[Judged]) -> list[Judged]:
    """Return the options, best first, every set of effects, places and numbers of amplitudes once."""
    best: dict[object, Judged] = {}
    for judged in sorted(options, key=worth):
        best.setdefault(frozenset((effect.place, len(effect.amplitudes)) for effect in judged.effects), judged)
    return list(best.values())


def _places(judged: Judged) -> frozenset[object]:
    return frozenset(effect.place for effect in judged.effects)


def simplest_first(judged: Sequence[Judged]) -> list[Judged]:
    """Return options, best first, with the simplest of those in front that the data hardly tell from the best."""
    close = [j for j in judged if j is judged[0] or is_close(j, judged[0])]
    rest = [j for j in judged if all(j is not c for c in close)]
    return sorted(close, key=lambda j: j.trial.fit.problem.n_free) + rest


def is_valid(validation: Validation) -> bool:
    """Return whether effects predict what they were not fitted to: blocks from the others, the end from the beginning.

    One event may be seen by one of the two alone, so it is their geometric mean that must fall.
    """
    return bool(np.sqrt(validation.ratio * validation.forward_ratio) < FORESIGHT)


def worth(judged: Judged) -> float:
    return -judged.evidence.log_bayes_factor


def is_close(other: Judged, best: Judged) -> bool:
    """Return whether the data hardly tell another option from the best one."""
    return other.evidence.log_bayes_factor > best.evidence.log_bayes_factor - ALTERNATIVE_NATS
