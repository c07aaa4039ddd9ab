"""The shortlist: every candidate of the registry, screened, and the few that are worth a refit."""

from collections.abc import Collection, Sequence
from functools import partial

import numpy as np

from twin_core.calibrate.undeclared.model import HeatFit
from twin_core.discover.metric import beside_gradients
from twin_core.discover.screen import Probe, Screening, screen, screen_in, screen_sizes, survey_of
from twin_core.discover.trial import Trial, about_trajectory
from twin_core.effects import REGISTRY
from twin_core.effects.base import Effect, Place, Survey, touched_nodes
from twin_core.network.doubts import uncoupled

UNDECLARED_SHARES = (1.0, 0.1, 0.01)
"""Sizes of the undeclared heat at which candidates are screened, as shares of the fitted one."""

N_VARIED = 4
"""Places at the head of the shortlist that are tried from more than one start."""


def candidates(
    trial: Trial, fit: HeatFit, *, fallback: bool, nodes: Collection[str] | None = None
) -> tuple[Survey, list[Effect]]:
    """Return the points of a fit, and every candidate effect at every place and setting that the trial lacks.

    With ``nodes`` only those with one of them for their ``node``. At a node without a declared coupling only couplings are
    candidates: heat would warm it without end, and whatever else is named there stands in for the coupling that is missing.
    """
    survey = survey_of(fit)
    taken = {effect.place for effect in trial.effects}
    couplings = [effect for effect in trial.effects if _couples(effect)]
    apart = set(uncoupled(fit.network.spec)) - {n for c in couplings for n in touched_nodes(c, survey.layout)}
    effects = [
        effect
        for kind in REGISTRY.values()
        if kind.fallback == fallback
        for where in kind.places(survey.layout)
        if nodes is None or where["node"] in nodes
        for effect in kind.starts(where, survey)
        if effect.place not in taken
        and (not apart or _couples(effect) or not apart.issuperset(touched_nodes(effect, survey.layout)))
    ]
    return survey, effects


def _couples(effect: Effect) -> bool:
    """Return whether an effect exchanges heat between its place and another one, or a mass that nobody declared."""
    return effect.adds_mass or not {"nodes", "boundary", "sink"}.isdisjoint(effect.where)


def screened(
    trial: Trial, fit: HeatFit, shares: Sequence[float], *, fallback: bool, nodes: Collection[str] | None = None
) -> list[Screening]:
    """Screen the candidates of a trial about a fit, at some nodes or everywhere, once per assumed size of the undeclared heat.

    As fitted, the undeclared heat explains everything a little; smaller, it is as it would be with the right effect in place.
    """
    survey, effects = candidates(trial, fit, fallback=fallback, nodes=nodes)
    return screen_sizes(fit, shares, survey, effects)


def screened_beside_gradients(trial: Trial) -> tuple[HeatFit, list[Screening]] | None:
    """Screen the named candidates of a trial about its trajectories beside gradients within the nodes, and return where.

    Once against a misfit that wanders at the sensors as what stays does, once against their noise alone. None where trajectories
    leave nothing that gradients could explain.
    """
    gradients = trial.beside_any_gradients()
    if gradients is None:
        return None
    about = about_trajectory(gradients.problem, gradients.optimum)
    survey, effects = candidates(trial, about, fallback=False)
    metrics = [partial(beside_gradients, gradients, is_white=is_white) for is_white in (False, True)]
    return about, screen_in(metrics, about, survey, effects)


def shortlist(
    rankings: Sequence[Sequence[Probe]], needed: float, n_wanted: int, first: Collection[Place] = ()
) -> list[Effect]:
    """Return the effects worth a refit: those of the places ``first``, then the best of every ranking in turn, each place once.

    The first few places are joined by the other settings that the rankings prefer there: a set-point or a time constant
    is found by a local search, and one start may be caught.
    """
    chosen: dict[object, Effect] = {}
    for probe in (p for ranked in rankings for p in ranked if p.effect.place in first and p.gain > needed):
        chosen.setdefault(probe.effect.place, probe.effect)
    for rank in range(n_wanted):
        for ranked in rankings:
            if rank < len(ranked) and ranked[rank].gain > needed and len(chosen) < n_wanted:
                chosen.setdefault(ranked[rank].effect.place, ranked[rank].effect)
    varied = list(chosen)[:N_VARIED]
    others = [probe.effect for ranked in rankings for probe in ranked if probe.effect.place in varied]
    return each_start([*chosen.values(), *others])


def each_start(effects: Sequence[Effect]) -> list[Effect]:
    """Return effects whose places, numbers of amplitudes or shapes differ, the first of each."""
    starts: dict[object, Effect] = {}
    for effect in effects:
        starts.setdefault(_start(effect), effect)
    return list(starts.values())


def _start(effect: Effect) -> tuple[object, int, tuple[float, ...]]:
    """Return the place, how many amplitudes the effect has, and the values that shape it without scaling it."""
    shape = tuple(effect.values[q.name] for q in effect.parameter_specs() if q.null is None)
    return effect.place, len(effect.amplitudes), shape


def refined(fit: HeatFit, effects: Sequence[Effect]) -> list[Effect]:
    """Return effects at the best of their finer settings, where the first ones are too coarse for a local search.

    An effect with a fuller form than its simplest one is returned in the best of either: a heat that came and went is none
    that stays.
    """
    survey = survey_of(fit)
    finer = [setting for effect in effects for setting in effect.refined(survey)]
    several = {e.place: e for e in effects if type(e).completed is not Effect.completed}.values()
    starts = [start for effect in several for start in type(effect).starts(effect.where, survey)]
    fuller = [form for start in starts for form in start.completed(survey)]
    simplest = [start for start in starts if any(True for _ in start.completed(survey))]
    n_samples = int(sum(nominal.segment.valid.sum() for nominal in fit.nominals))

    def best(settings: Sequence[Effect]) -> dict[Place, Effect]:
        ranked = best_of_each_place(screen(fit, survey, settings).probes, n_samples) if settings else []
        return {probe.effect.place: probe.effect for probe in ranked}

    own = best(finer)
    forms = [*best(fuller).values(), *best(simplest).values()]
    return each_start([*(own.get(effect.place, effect) for effect in effects), *forms])


def schwarz_gain(probe: Probe, n_samples: int) -> float:
    """Return a probe's gain with each amplitude paid for."""
    return probe.gain - 0.5 * float(np.log(max(n_samples, 2))) * len(probe.effect.amplitudes)


def best_of_each_place(probes: Sequence[Probe], n_samples: int) -> list[Probe]:
    """Return the best setting of each effect and place, best first, each amplitude paid for by its Schwarz penalty."""
    best: dict[object, tuple[float, Probe]] = {}
    for probe in probes:
        worth = schwarz_gain(probe, n_samples)
        if probe.effect.place not in best or worth > best[probe.effect.place][0]:
            best[probe.effect.place] = (worth, probe)
    return [probe for _, probe in sorted(best.values(), key=lambda item: -item[0])]
