"""The closed loop: calibrate, find what is missing, add it, and measure on telemetry that no choice has seen."""

import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from twin_core._typing import Json, Progress, no_progress
from twin_core.calibrate.containment import TimeIsUpError, attempted, limited
from twin_core.calibrate.discrepancy import stated
from twin_core.calibrate.explained import advised
from twin_core.calibrate.identifiability import resting
from twin_core.calibrate.problem import measured_temperatures
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.second_order import Calibration, fit_network
from twin_core.calibrate.summary import to_model
from twin_core.calibrate.undeclared.model import HeatFit
from twin_core.compiled import deadline_after
from twin_core.discover import policy
from twin_core.discover.judge import MISTAKE, NO_MODEL, Search
from twin_core.discover.long_records import on_all_samples, searched
from twin_core.discover.screen import survey_of
from twin_core.discover.search import search
from twin_core.discover.trial import Trial
from twin_core.effects.base import Effect
from twin_core.errors import ModelError, NoSolutionError, TelemetryError
from twin_core.holdout import HeldOut, Prediction, predict, split_burn_in, split_fraction
from twin_core.missing_heat.driven import driven_heat
from twin_core.missing_heat.smoothed import added_to_report, smooth_missing_heat
from twin_core.network.screened import all_screened, segments
from twin_core.network.spec import TwinSpec
from twin_core.progress import Part
from twin_core.quality import quality_json, quality_strip
from twin_core.report.build import build_report
from twin_core.report.dossier import Moment, check_moments, provenance
from twin_core.report.mistakes import look_for_mistakes, told_mistakes
from twin_core.report.plots import build_plots
from twin_core.telemetry import Record

AFTERWARDS = 0.1
"""Share of the deadline that smoothing the missing heat may take beyond it."""


@dataclass(frozen=True, repr=False)
class ClosedLoop:
    """What a closed loop leaves: the report, the corrected model, the declared one, and what the page plots."""

    report: Json
    model: CalibratedModel
    before_model: CalibratedModel
    plots: Json

    def __repr__(self) -> str:
        """Tell what came of it in one line."""
        found = ", ".join(finding["effect"] for finding in self.report["findings"]) or "nothing"
        before, after = self.report["before"]["rmse_K"], self.report["after"]["rmse_K"]
        twin, verdict = self.report["twin"], self.report["verdict"]
        return (
            f"<ClosedLoop {twin}: {verdict}, {found} added; held-out rmse {before:.3g} K before, {after:.3g} K after>"
        )


def close_loop(
    spec: TwinSpec,
    records: Sequence[Record],
    *,
    holdout: float | None = 0.3,
    holdout_records: Sequence[Record] | None = None,
    burn_in_s: float | None = None,
    false_alarm_rate: float = 0.01,
    deadline_s: float | None = None,
    moments: Sequence[Moment] = (),
    first: Collection[Effect] = (),
    progress: Progress = no_progress,
) -> ClosedLoop:
    """Close the loop on telemetry.

    Parameters
    ----------
    spec
        The declared network.
    records
        Segments of telemetry in SI.
    holdout
        Share of the time span kept back at the end; unused where ``holdout_records`` are given.
    holdout_records
        Separate telemetry to be predicted.
    burn_in_s
        First seconds of each separate hold-out record that tell its initial state and are not scored.
    false_alarm_rate
        Tolerated rate of findings on healthy records, between 0 and 1.
    deadline_s
        Seconds after which the search ends with the best answer so far; none by default.
    moments
        Instants and phases of the training telemetry at which the report tells heat flows; by default the average, the
        hottest and the coldest moment of its last segment.
    first
        Effects that spacecraft of the same design have: at their places they are tried wherever they could matter.
    progress
        Called with the fraction done; may raise to cancel.

    Returns
    -------
    ClosedLoop

    Raises
    ------
    TelemetryError, ModelError
        If the telemetry cannot be used, or the declared balance has no solution; over the hold-out alone: where nothing that is
        found gives it one.
    """
    if not 0.0 < false_alarm_rate < 1.0:
        raise TelemetryError(f"false_alarm_rate: must be between 0 and 1, exclusive (got {false_alarm_rate:g})")
    if deadline_s is not None and not deadline_s > 0.0:
        raise TelemetryError(f"deadline_s: must be a positive number of seconds (got {deadline_s:g})")
    deadline = deadline_after(deadline_s)
    begun, whole_loop = time.perf_counter(), Part(progress)
    # The search ends at the deadline; what only illustrates its findings has a little longer.
    latest = deadline if deadline_s is None else deadline + AFTERWARDS * deadline_s
    with threadpool_limits(1):  # compiled loops run side by side; threads within their small products only contend
        records = all_screened(spec, records)
        holdout_records = all_screened(spec, holdout_records or ())
        train, held = _split(spec, records, holdout, holdout_records, burn_in_s)
        check_moments(train, moments)
        fit, calibration = _calibrated(spec, train, deadline, whole_loop.part(0.0, 0.2))
        before = to_model(calibration, ())
        declared, lost = _predicted(before, held)
        whole = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
        base, every = searched(whole)
        found = Search(base, base)
        # Beside a sensor that is stuck whatever is found would be wrong: a steady reading amid moving ones needs some effect.
        if not resting(spec.sensors, train):
            tried_first = {effect.place for effect in first}
            told = whole_loop.part(0.2, 0.8)
            found = search(base, false_alarm_rate=false_alarm_rate, deadline=deadline, first=tried_first, progress=told)
        found.every = every
        progress(0.8, "checking the specification for mistakes")
        doubts = look_for_mistakes(found, deadline=latest)
        if doubts.outdo(found):
            found.give_up(MISTAKE)
        progress(0.85, "predicting the hold-out")
        after, predicted = _corrected(whole, found, held) or (before, declared)
        is_corrected = after is not before
        if not found.findings and doubts.looked is None:  # given up since: the declared model is asked
            doubts = look_for_mistakes(found, deadline=latest)
        if lost is not None and not is_corrected:
            raise lost
        progress(0.9, "writing the report")
        before = _stated(before, found, found.base, latest)
        after = _stated(after, found, found.trial, latest) if is_corrected else before
        predictions = (declared, predicted)
        report = build_report(found, before, after, held, predictions, verdict_of(found), moments)
        progress(0.95, "smoothing the missing heat")
        missing = smooth_missing_heat(found, deadline=latest)
        report |= added_to_report(missing, report)
        report |= told_mistakes(found, doubts, report)
        driven, notices = driven_heat(found, deadline=latest)
        report["notices"] += notices
        progress(0.98, "drawing")
        plots = build_plots(found, before, after, held, predictions, report, missing, driven)
        report["quality"] = quality_json([*records, *holdout_records])
        plots["quality_strip"] = quality_strip([*records, *holdout_records])
        report["provenance"] = provenance(spec, [*records, *holdout_records])
        report["elapsed_s"] = time.perf_counter() - begun
        progress(1.0, "done")
        return ClosedLoop(report, after, before, plots)


def _calibrated(
    spec: TwinSpec, train: Sequence[Record], deadline: float, progress: Progress
) -> tuple[HeatFit, Calibration]:
    """Return the fits of the declared network; where it has no solution the error names what is most likely wrong."""
    try:
        return fit_network(spec, train, deadline=deadline, progress=progress)
    except NoSolutionError as error:
        raise NoSolutionError(advised(str(error), spec, train, deadline)) from error


def _predicted(declared: CalibratedModel, held: Sequence[HeldOut]) -> tuple[list[Prediction], ModelError | None]:
    """Return what the declared model predicts, and what is to be raised where nothing corrects it.

    It may have no solution over the hold-out because of what it lacks: parameters that stood in for that in training have run
    away. The error tells which of them the training part leaves open.
    """
    try:
        return [predict(declared, h) for h in held], None
    except ModelError as error:
        words = declared.summary["words"]
        advice = (
            f"; the training part leaves open: {'; '.join(words)}; give such parameters a value or bounds"
            if words
            else ""
        )
        return [predict(declared, h, holding=True) for h in held], ModelError(f"{error}{advice}")


def _corrected(whole: Trial, found: Search, held: Sequence[HeldOut]) -> tuple[CalibratedModel, list[Prediction]] | None:
    """Return the corrected model and its predictions, None without findings.

    Where either cannot be computed the findings are given up, told, and the declared model stays.
    """

    def done() -> tuple[CalibratedModel, list[Prediction]]:
        model = corrected(whole, found)
        return model, [predict(model, h) for h in held]

    if not found.findings:
        return None
    try:
        after = attempted(done, "the corrected model", found.failures)
    except ModelError as error:
        found.failures.append(f"the corrected model: {error}")
        after = None
    if after is None:
        found.give_up(NO_MODEL)
    return after


def _stated(model: CalibratedModel, found: Search, trial: Trial, deadline: float) -> CalibratedModel:
    """Return a model whose deviations hold what a coarse network makes its parameters wrong by; told where they do not."""
    what = "parameter errors caused by the coarse network"
    try:
        with limited(deadline), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            told = attempted(trial.discrepancy, what, found.failures)
    except (ModelError, TimeIsUpError) as error:
        found.failures.append(f"{what}: {error}")
        told = None
    return model if told is None else stated(model, told)


def corrected(whole: Trial, found: Search) -> CalibratedModel:
    """Return the model with the findings on the whole record; what that leaves open lies in the middle of where it may be."""
    trial = on_all_samples(whole, found.trial)
    return centred(to_model(trial.calibration(), trial.present_effects), trial.fit)


def centred(model: CalibratedModel, fit: HeatFit) -> CalibratedModel:
    """Return a model with what the record leaves open of its effects in the middle."""
    survey = survey_of(fit)
    effects = tuple(effect.centred(survey) for effect in model.effects)
    moved = {p.name: p.value for effect in effects for p in effect.parameters()}
    return replace(model, effects=effects, values=model.values | moved)


def _split(
    spec: TwinSpec,
    records: Sequence[Record],
    holdout: float | None,
    holdout_records: Sequence[Record] | None,
    burn_in_s: float | None,
) -> tuple[list[Record], list[HeldOut]]:
    """Return the training records and the hold-out; TelemetryError where there is nothing to score."""
    if not records:
        raise TelemetryError("no telemetry given")
    records = segments(spec, records)
    if holdout_records:
        separate = segments(spec, holdout_records)
        train, held = list(records), [split_burn_in(record, burn_in_s) for record in separate]
    else:
        train, held = split_fraction(records, 0.3 if holdout is None else holdout)
    if not any(np.isfinite(measured_temperatures(spec, h.scored)[1:]).any() for h in held):
        raise TelemetryError(
            f"{held[0].scored.name}: the hold-out has no usable sample of {', '.join(spec.sensors)}; nothing can be scored"
            f"{_masked_there(spec, held)}"
        )
    given = {b.channel for b in spec.boundaries.values() if b.channel is not None} | {
        load.channel for load in spec.loads
    }
    for part in (part for h in held for part in (h.lead, h.scored)):
        for name in sorted(given & part.values.keys()):
            if not np.isfinite(part.values[name]).any():
                raise TelemetryError(
                    f"{part.name}: channel '{name}' has no samples in the hold-out, and the model needs it as an input;"
                    " choose another hold-out, or give them"
                )
    return train, held


def _masked_there(spec: TwinSpec, held: Sequence[HeldOut]) -> str:
    """Return why readings of the hold-out were left out, in words; empty where none were."""
    reasons = {
        (flaw.channel, flaw.reason): None
        for h in held
        for flaw in h.scored.flaws or ()
        if flaw.channel in spec.sensors and flaw.stop_s > h.scored.time_s[0] and flaw.start_s <= h.scored.time_s[-1]
    }
    if not reasons:
        return ""
    told = ", ".join(f"{channel} as {reason}" for channel, reason in reasons)
    return (
        f", since readings there were masked: {told}; choose another hold-out, or switch masking off if they are sound"
    )


def verdict_of(found: Search) -> str:
    """Return the verdict: an effect was added, the record is healthy, or something is there that nobody can name."""
    if found.findings:
        return "effect_added"
    unexplained = found.base.misfit_share() > policy.UNEXPLAINED_SHARE
    return "unexplained" if unexplained else "no_effect_supported"
