"""Spare freedom: an effect without the amplitudes that readings do not speak for, which must hold as well."""

from dataclasses import replace

from twin_core.discover.evidence import weigh
from twin_core.discover.screen import survey_of
from twin_core.discover.trial import Trial, try_effects
from twin_core.effects.base import Effect


def without_spare(simple: Trial, rich: Trial) -> Trial:
    """Return a trial whose effects have the amplitudes only that the readings pay for.

    Every amplitude is paid for with half the logarithm of the number of readings (Schwarz 1978). One that is not may still move
    long trajectories, together with parameters that it makes up for: then the effect predicts by what nothing speaks for.

    Parameters
    ----------
    simple
        The trial that the effects were tried on top of.
    rich
        With them.
    """
    known = {effect.place for effect in simple.effects}
    for effect in (e for e in rich.present_effects if e.place not in known):
        if type(effect).simplified is Effect.simplified:
            continue
        for form in effect.simplified(survey_of(rich.fit)):
            less = _in_form(rich, form)
            if weigh(less, rich, 1).log_bayes_factor <= 0.0:
                rich = replace(less, simpler=simple, below=simple)
    return rich


def _in_form(trial: Trial, form: Effect) -> Trial:
    """Return a trial with one of its effects in another form, fitted."""
    effects = tuple(form if effect.place == form.place else effect for effect in trial.present_effects)
    return try_effects(trial, effects, n_passes=12)
