"""The workbench of ``twin_core``. Runs in worker processes only: every heavy import is inside a function."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from service.workbench.interface import (
    CalibrationTask,
    DiagnosisTask,
    Filtered,
    Forecasted,
    ForecastTask,
    Json,
    Masks,
    Outcome,
    Progress,
    Stretch,
    Telemetry,
)
from twin_core.errors import ModelError, TwinError

MOST_MODELS = 1024
"""So many models a worker process knows at a time, at some tens of kilobytes each."""

LEAST_SIBLINGS = 3
OWN = ""
"""Among its siblings the model at hand goes by no name: twins have one."""


class CoreWorkbench:
    """The workbench of ``twin_core``."""

    def __init__(self, effects: Sequence[Path] = ()) -> None:
        """Know the effects of plug-in files; PluginError names the file that cannot be used."""
        if effects:
            from twin_core.effects import load_effects

            load_effects(effects)

    def calibrate(self, task: CalibrationTask, progress: Progress) -> Outcome:
        """Fit the declared network."""
        from twin_core.calibrate import calibrate
        from twin_core.compiled import deadline_after

        deadline = deadline_after(task.deadline_s)
        siblings = {name: _model_of(document) for name, document in task.siblings.items()}
        spec = _with_prior(_spec(task.specification), siblings)
        whole, telemetry = _screened(spec, task.telemetry)
        train, recent = telemetry.before(task.validation_us), telemetry.since(task.validation_us)
        model = calibrate(
            spec,
            [replace(_record(spec, train), flaws=whole.flaws, notices=whole.notices)],
            method=task.method,
            deadline=deadline,
            progress=lambda fraction, message: progress(0.9 * fraction, message),
        )
        progress(0.92, "scoring on recent data")
        held = _held_out(spec, train, recent)
        rmse_K = _rmse_K(model, held)
        rival = None if task.rival is None else _rmse_K(_model_of(task.rival), held)
        validation = {
            "rmse_K": rmse_K if held else model.summary.get("rmse_K"),
            "on": "recent data held back" if held else "the training data: too few to hold any back",
            "samples": int(recent.time_us.size),
        }
        outcome = _outcome(model, validation, rival)
        extra = outcome.extra | _beside_family(model, siblings)
        return replace(outcome, extra=extra, cut_short=model.summary["status"] == "deadline")

    def diagnose(self, task: DiagnosisTask, progress: Progress) -> Outcome:
        """Close the loop."""
        from twin_core.closed_loop import close_loop
        from twin_core.report.html import render

        spec = _spec(task.specification)
        loop = close_loop(
            spec,
            [_record(spec, task.telemetry)],
            holdout=task.holdout,
            burn_in_s=task.burn_in_s,
            false_alarm_rate=task.false_alarm_rate,
            deadline_s=task.deadline_s,
            first=[effect for document in task.siblings.values() for effect in _model_of(document).effects],
            progress=progress,
        )
        loop.report["document"] = {"date": datetime.now(UTC).date().isoformat()}
        before, after = loop.report["before"]["rmse_K"], loop.report["after"]["rmse_K"]
        validation = {"rmse_K": after, "before_rmse_K": before, "on": "the hold-out of the diagnosis"}
        outcome = _outcome(loop.model, validation, None)
        return Outcome(
            outcome.document,
            loop.report["train"],
            validation,
            outcome.effects,
            report=loop.report,
            page=render(loop.report, loop.plots),
            extra=outcome.extra,
            cut_short=not loop.report["search"]["complete"],
        )

    def inspect(self, document: Json) -> Outcome:
        """Check a model that was made elsewhere."""
        model = _model_of(document)
        return _outcome(model, {"rmse_K": model.summary.get("rmse_K"), "on": "its own training data"}, None)

    def assimilate(self, stretches: Sequence[Stretch]) -> list[Filtered | Exception]:
        """Filter stretches of telemetry together; each state carries the evidence against its model along."""
        from twin_core.assimilate.together import Question, assimilate_together

        questions: list[Question | Exception] = []
        for stretch in stretches:
            try:
                member = _cached_member(stretch.document)
                questions.append(Question(member, _record(member.model.spec, stretch.telemetry), stretch.state))
            except Exception as error:
                questions.append(error)
        done = iter(assimilate_together([question for question in questions if isinstance(question, Question)]))
        found = [question if isinstance(question, Exception) else next(done) for question in questions]
        return [
            one if isinstance(one, Exception) else _filtered(one, stretch.state)
            for one, stretch in zip(found, stretches, strict=True)
        ]

    def memory_s(self, document: str, telemetry: Telemetry) -> float:
        """Return the longest time constant."""
        from twin_core.assimilate import memory_s

        model = _cached_model(document)
        return memory_s(model, _record(model.spec, telemetry))

    def score(self, document: str, telemetry: Telemetry) -> float | None:
        """Roll a model out over some telemetry."""
        from twin_core.holdout import split_burn_in
        from twin_core.network.screened import segments
        from twin_core.telemetry import LEAST_PART

        model = _cached_model(document)
        record, _ = _screened(model.spec, telemetry)
        parts = segments(model.spec, [record])
        return _rmse_K(model, [split_burn_in(part, None) for part in parts if part.time_s.size >= LEAST_PART])

    def screen(self, units: Mapping[str, str | None], inputs: Collection[str], telemetry: Telemetry) -> Masks:
        """Look for samples that are no readings."""
        from twin_core.quality import screen
        from twin_core.units import to_si

        columns = {name: to_si(column, units[name]) for name, column in telemetry.values.items()}
        return screen((telemetry.time_us - telemetry.epoch_us) / 1e6, columns, units, inputs).masks

    def forecast(self, document: str, task: ForecastTask) -> Forecasted:
        """Look ahead."""
        from twin_core.forecast import WHOLE, forecast
        from twin_core.units import from_si

        model = _cached_model(document)
        spec = model.spec
        ahead = forecast(
            model,
            _record(spec, task.telemetry),
            task.horizon_s,
            step_s=task.step_s,
            plan=None if task.plan is None else _record(spec, task.plan),
            inputs=task.inputs,
            past=None if task.past is None else _screened(spec, task.past)[0],
            quantiles=task.quantiles,
            state=task.state,
        )

        if not all(np.isfinite(values).all() for values in (ahead.mean_K, *ahead.quantiles_K.values(), *ahead.whole_K)):
            raise ModelError("the forecast is not finite; recalibrate, or activate another model")

        def columns(values: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
            return {name: from_si(values[:, i], spec.channels[name].unit) for i, name in enumerate(ahead.sensors)}

        time_us = task.telemetry.epoch_us + np.rint(ahead.time_s * 1e6).astype(np.int64)
        quantiles = {q: columns(values) for q, values in ahead.quantiles_K.items()}
        low, high = (columns(end) for end in ahead.whole_K)
        whole = {name: (low[name], high[name]) for name in ahead.sensors}
        present = {name: float(column[0]) for name, column in columns(ahead.present_K[None, :]).items()}
        return Forecasted(time_us, columns(ahead.mean_K), quantiles, present, ahead.notices, whole, WHOLE, ahead.inputs)

    def flows(self, document: str, telemetry: Telemetry, state: Json) -> Json:
        """Return temperatures and heat flows of the moment that the state describes."""
        from twin_core.flows import heat_flows

        model = _cached_model(document)
        return heat_flows(model, _record(model.spec, telemetry), state)


def _spec(specification: Json) -> Any:
    from twin_core.network.spec_io import load_spec

    return load_spec(specification)


def _alike(spec: Any, siblings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the siblings that calibrated the parameters of a specification, no more and no fewer; none of under three."""
    from twin_core.network.model import build_network

    names = build_network(spec).parameters.free_names
    found = {name: model for name, model in siblings.items() if model.free_names == names}
    return found if len(found) >= LEAST_SIBLINGS else {}


def _with_prior(spec: Any, siblings: Mapping[str, Any]) -> Any:
    """Return a specification whose guesses are those of its family; as it is where too few siblings are known."""
    from twin_core.family import declared, pool

    alike = _alike(spec, siblings)
    try:
        return declared(spec, pool(alike)) if alike else spec
    except (TwinError, np.linalg.LinAlgError):  # siblings that tell nothing must not stop a calibration
        return spec


def _beside_family(model: Any, siblings: Mapping[str, Any]) -> Json:
    """Return how many siblings a model was compared with, and the p-values of the parameters in which it is unlike them."""
    from twin_core.family import pool

    alike = _alike(model.spec, siblings) if len(model.free_names) else {}
    if not alike:
        return {}
    try:
        own = pool({**alike, OWN: model}).members[OWN]
    except (TwinError, np.linalg.LinAlgError):
        return {}
    return {"family": {"siblings": len(alike), "differs": own.differs}}


def _record(spec: Any, telemetry: Telemetry) -> Any:
    """Return the telemetry as a record in SI on the model's time axis."""
    from twin_core.telemetry import Record
    from twin_core.units import to_si

    time_s = (telemetry.time_us - telemetry.epoch_us) / 1e6
    values = {
        name: to_si(column, spec.channels[name].unit)
        for name, column in telemetry.values.items()
        if name in spec.channels
    }
    return Record(time_s, values, telemetry.epoch_us * 1000, "archive")


def _screened(spec: Any, telemetry: Telemetry) -> tuple[Any, Telemetry]:
    """Return the telemetry as a record without what cannot be readings, and the same in the channels' own units."""
    from twin_core.network.screened import screened

    record = screened(spec, _record(spec, telemetry))
    values = {name: np.where(np.isnan(record.values[name]), np.nan, telemetry.values[name]) for name in record.values}
    return record, replace(telemetry, values=values)


def _held_out(spec: Any, train: Telemetry, recent: Telemetry) -> list[Any]:
    """Return the recent data as hold-outs, the first of which may follow on the training data; none if there is too little."""
    from twin_core.holdout import HeldOut, split_burn_in
    from twin_core.network.screened import segments
    from twin_core.telemetry import LEAST_PART

    if recent.time_us.size < 3:
        return []
    last = train.since(int(train.time_us[-1]))
    values = {name: np.concatenate([last.values[name], column]) for name, column in recent.values.items()}
    joined = Telemetry(recent.epoch_us, np.concatenate([last.time_us, recent.time_us]), values)
    lead = _record(spec, train)
    parts = segments(spec, [_record(spec, joined)])
    follows = [part.time_s[0] == lead.time_s[-1] for part in parts]
    long = [part.time_s.size >= LEAST_PART for part in parts]
    held = zip(parts, follows, long, strict=True)
    return [HeldOut(lead, p) if follow else split_burn_in(p, None) for p, follow, enough in held if follow or enough]


def _rmse_K(model: Any, held: list[Any]) -> float | None:
    """Return the open-loop error of a model on the hold-outs, over every reading."""
    from twin_core.holdout import predict

    predictions = [predict(model, one) for one in held]
    squares = [((p.measured_K - p.predicted_K) ** 2).ravel() for p in predictions]
    every = np.concatenate([np.empty(0), *squares])
    return float(np.sqrt(np.nanmean(every))) if np.isfinite(every).any() else None


def _model_of(document: Json) -> Any:
    from twin_core.calibrate import CalibratedModel

    return CalibratedModel.from_json(document)


def _filtered(done: Any, state: Json | None) -> Filtered | Exception:
    from twin_core.anomaly.sufficiency import follow_evidence

    if not (np.isfinite(done.mean_K).all() and np.isfinite(done.covariance_K2).all()):
        return ModelError("the filter diverges on these samples; check readings and inputs, or recalibrate")
    scaled = done.innovation_K / done.innovation_std_K
    evidence, _ = follow_evidence((state or {}).get("evidence"), done.sensors, scaled)
    return Filtered(
        done.sensors, done.innovation_K, done.innovation_std_K, done.nis, done.state | {"evidence": evidence}
    )


@lru_cache(maxsize=MOST_MODELS)
def _cached_member(document: str) -> Any:
    from twin_core.assimilate.together import Member

    return Member.of(_model_of(orjson.loads(document)))


def _cached_model(document: str) -> Any:
    return _cached_member(document).model


def _outcome(model: Any, validation: Json, rival_rmse_K: float | None) -> Outcome:
    document = model.to_json()
    summary = dict(model.summary)
    train = summary.pop("train", {})
    extra = {"parameters": summary.get("parameters", []), "notices": summary.get("notices", []), "fit": summary}
    return Outcome(document, train, validation, [_wire(e) for e in model.effects], rival_rmse_K, extra=extra)


def _wire(effect: Any) -> Json:
    """Return an effect of a model as clients see it."""
    from twin_core.effects import effect_to_json

    data = effect_to_json(effect)
    values = {spec.name: effect.presented(spec) for spec in effect.parameter_specs()}
    return {"effect": data["effect"], "where": data["where"], "parameters": values}
