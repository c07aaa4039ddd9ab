"""The decision in a form for machines and people: report.json and what its page plots."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from twin_core._typing import Json
from twin_core.calibrate.containment import attempted
from twin_core.calibrate.criteria import acceptance, with_met
from twin_core.calibrate.identifiability import resting, strong_correlations
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.second_order import Calibration
from twin_core.calibrate.statistics import residual_whiteness, score
from twin_core.calibrate.summary import stated_guesses
from twin_core.discover.judge import Finding, Judged, Search
from twin_core.discover.trial import mean_excess
from twin_core.effects.base import Effect
from twin_core.holdout import HeldOut, Prediction
from twin_core.network.model import told_values
from twin_core.report.dossier import Moment, ensemble, heat_flow_maps, left_out, sensitivity
from twin_core.report.experiments import separating
from twin_core.report.holdout_doubts import doubts
from twin_core.telemetry import Record

MOSTLY = 0.5
"""Share of a misfit from which it is said what explains it."""

MOST_REJECTED = 8
"""Rows of what was tried and not supported."""


def where_json(effect: Effect) -> Json:
    """Return the place of an effect with the contract's keys; a pair is a list."""
    return {key: value if isinstance(value, str) else list(value) for key, value in effect.where.items()}


def parameters_json(effect: Effect, stds: dict[str, float]) -> Json:
    """Return mean and standard deviation of an effect's parameters; tables become lists, instants their own form."""
    rows: dict[str, Any] = {}
    for quality in effect.parameter_specs():
        mean = effect.presented(quality)
        std = stds.get(f"{effect.label}.{quality.name}")
        std = None if std is None else quality.spread(std)
        base, bracket, _ = quality.name.partition("[")
        if bracket:
            row = rows.setdefault(base, {"mean": [], "std": []})
            row["mean"].append(mean)
            row["std"].append(std)
        else:
            rows[base] = {"mean": mean, "std": std}
            if std is not None and quality.told_from_below(float(effect.values[quality.name]), std):
                rows[base]["unbounded_above"] = True
    for name in effect.reported_settings:
        if name not in effect.settings:
            continue
        value = effect.settings[name]
        rows[name] = {"mean": list(value) if isinstance(value, tuple) else value, "std": None}
    return rows


def evidence_json(judged: Judged) -> Json:
    """Return what speaks for an effect."""
    row: Json = {"log_bayes_factor": judged.evidence.log_bayes_factor, "p_value": judged.evidence.p_value}
    if judged.validation is not None:
        row |= {
            "validation_ratio": judged.validation.ratio,
            "blocks_better": judged.validation.blocks_better,
            "forward_ratio": judged.validation.forward_ratio,
            "removed_share": judged.validation.removed_share,
            "explained_share": judged.validation.explained_share,
        }
    return row


def findings_json(findings: Sequence[Finding], model: CalibratedModel, failures: list[str]) -> list[Json]:
    """Return the findings in the order of their evidence; effects judged together stand next to each other.

    Where no experiment can be told for want of finite numbers, the reason is added to ``failures``.
    """
    stds = {p["name"]: p["std"] for p in model.summary["parameters"]}
    fitted = {effect.place: effect for effect in model.effects}
    rows = []
    for finding in sorted(findings, key=lambda f: -f.judged.evidence.log_bayes_factor):
        what = f"experiments for {finding.judged.labels}"
        told = attempted(partial(separating, finding), what, failures) or []
        experiments = [experiment.row() for experiment in told]
        together = {effect.place for effect in finding.effects}
        for effect in finding.effects:
            own = fitted[effect.place]
            rows.append(
                {
                    "effect": own.name,
                    "where": where_json(own),
                    "sentence": own.told(own.where),
                    "parameters": parameters_json(own, stds),
                    "equation": own.equation,
                    "evidence": evidence_json(finding.judged),
                    "judged_with": [e.label for e in finding.effects if e is not effect],
                    "alternatives": [
                        {
                            "effect": other.name,
                            "where": where_json(other),
                            "log_bayes_factor": option.evidence.log_bayes_factor,
                        }
                        for option in finding.alternatives
                        # What an alternative has as well is not in doubt, and no alternative to anything.
                        if effect.place not in {other.place for other in option.effects}
                        for other in option.effects
                        if other.place not in together
                    ],
                    "experiments": experiments,
                }
            )
    return rows


def held_out_scores(sensors: Sequence[str], predictions: Sequence[Prediction]) -> Json:
    """Return the open-loop errors over all hold-out stretches."""
    return score(sensors, [p.measured_K for p in predictions], [p.predicted_K for p in predictions])


def _counts(sensors: Sequence[str], predictions: Sequence[Prediction]) -> dict[str, int]:
    """Return how many readings of each sensor are scored."""
    scored = sum(np.isfinite(p.measured_K - p.predicted_K).sum(axis=0) for p in predictions)
    return dict(zip(sensors, np.broadcast_to(scored, len(sensors)).tolist(), strict=True))


def span_json(records: Sequence[Record], counted: int) -> Json:
    """Return start, stop and number of samples of a set of records, times in their own form."""
    first, last = records[0], records[-1]
    return {"start": first.present(first.time_s[0]), "stop": last.present(last.time_s[-1]), "samples": counted}


def noise_floor_K(model: CalibratedModel) -> float:
    """Return the rms noise of the sensors: no model can predict readings better."""
    return float(np.sqrt(np.mean(model.noise_vector_K() ** 2)))


def best_rejected(search: Search) -> list[Judged]:
    """Return what was tried and not supported, best first, every set of effects once and none that was found after all."""
    found = {effect.place for finding in search.findings for effect in finding.effects}
    once: dict[frozenset[object], Judged] = {}
    for judged in sorted(search.rejected, key=lambda j: -j.evidence.log_bayes_factor):
        places = frozenset(effect.place for effect in judged.effects)
        if not places & found:
            once.setdefault(places, judged)
    return list(once.values())


def _left_out(search: Search) -> list[str]:
    """Return what the deadline cut off, in words."""
    if not search.left_out:
        return []
    some = "; ".join(dict.fromkeys(search.left_out[:5]))
    more = f" and {len(search.left_out) - 5} more" if len(search.left_out) > 5 else ""
    return [f"the deadline ended the search: this is the best answer so far; not looked at: {some}{more}"]


def _thinned(search: Search) -> list[str]:
    """Return what of a long record the search looked at, in words."""
    if search.every == 1:
        return []
    share = f"one of {search.every} samples"
    return [f"the record is long: effects were searched on {share}; both models were calibrated on all of them"]


def _beside_gradients(search: Search) -> list[str]:
    """Say where what trajectories leave is what temperature gradients within the nodes would leave: the network is coarse."""
    trial, gradients = search.trial, search.trial.beside_gradients()
    if gradients is None or gradients.log_posterior <= max(trial.fit.log_posterior, trial.calibration().log_posterior):
        return []  # heat that wanders, or a misfit that does, describes it better
    share = 1.0 - trial.unexplained() / mean_excess(trial)
    if share <= MOSTLY:
        return []
    return [
        f"the model leaves more than the sensors' noise; temperature gradients within the nodes explain {share:.0%} of that: a "
        "sensor reads one place of a body, a node stands for its mean, so a finer network would describe it"
    ]


def unexplained_share(calibration: Calibration) -> float:
    """Return the part of the open-loop residuals' variance over the training part that is beyond the sensors' noise."""
    scaled = np.concatenate(calibration.residuals) / calibration.problem.noise_K
    mean_square = float(np.nanmean(scaled**2))
    return max(0.0, 1.0 - 1.0 / mean_square) if mean_square > 0.0 else 0.0


def parameter_rows(search: Search, before: CalibratedModel, after: CalibratedModel) -> list[Json]:
    """Return every declared parameter as it was declared, calibrated, and corrected with the findings in place."""
    declared = search.base.fit.problem.network
    values = told_values(declared)
    guesses = stated_guesses(declared) | {p.name: values[p.name] for p in declared.parameters.parameters if p.frozen}
    corrected = {row["name"]: row for row in after.summary["parameters"]}
    return [
        {
            "name": row["name"],
            "unit": row["unit"],
            "declared": guesses.get(row["name"]),
            "calibrated": {"mean": row["mean"], "std": row["std"]},
            "corrected": {key: corrected[row["name"]][key] for key in ("mean", "std")},
            "identified": corrected[row["name"]]["identified"],
        }
        for row in before.summary["parameters"]
        if row["name"] in corrected
    ]


def build_report(
    search: Search,
    before: CalibratedModel,
    after: CalibratedModel,
    held: Sequence[HeldOut],
    predictions: tuple[Sequence[Prediction], Sequence[Prediction]],
    verdict: str,
    moments: Sequence[Moment] = (),
) -> Json:
    """Return the report of a closed loop (contract section 6).

    Parameters
    ----------
    search
        What was tried and found.
    before, after
        The declared model at its best, and with the findings.
    held
        The hold-out.
    predictions
        Open-loop predictions of both models over it.
    verdict
        ``effect_added``, ``no_effect_supported`` or ``unexplained``.
    moments
        Of the training telemetry, at which heat flows are told.
    """
    scores = [with_met(before.spec, held_out_scores(before.spec.sensors, p)) for p in predictions]
    train = [segment.record for segment in search.base.fit.problem.segments]
    counted = int(sum(np.isfinite(p.measured_K).any(axis=1).sum() for p in predictions[0]))
    failures = search.failures
    flows = attempted(lambda: heat_flow_maps(search, after, moments), "heat flows", failures) or []
    moved = attempted(lambda: sensitivity(search.trial.calibration()), "sensitivity matrix", failures) or {}
    return {
        "twin": before.spec.twin,
        "verdict": verdict,
        "train": span_json(train, before.summary["train"]["samples"]),
        "holdout": span_json([h.scored for h in held], counted),
        "before": scores[0],
        "findings": findings_json(search.findings, after, failures),
        "after": scores[1],
        "resting_sensors": resting(before.spec.sensors, train),
        "noise_floor_K": noise_floor_K(before),
        **_of_holdout((before, after), scores, predictions),
        "training": {"before_rmse_K": before.summary["rmse_K"], "after_rmse_K": after.summary["rmse_K"]},
        **_of_search(search),
        "parameters": parameter_rows(search, before, after),
        "correlations": strong_correlations(after.network().parameters, after.covariance, 0.5, 15)
        if after.free_names
        else [],
        "sensitivity": moved,
        "heat_flows": flows,
        "excluded": left_out(before.spec),
        "failures": list(dict.fromkeys(failures)),
        "words": after.summary["words"],
        "notices": [
            *doubts(
                before.noise_K,
                _counts(before.spec.sensors, predictions[0]),
                scores[0],
                scores[1],
                after.summary["rmse_K"],
                found=bool(search.findings),
            ),
            *(attempted(lambda: _beside_gradients(search), "gradients within nodes", failures) or []),
            *_left_out(search),
            *_thinned(search),
            *dict.fromkeys([*before.summary["notices"], *(notice for h in held for notice in h.scored.notices)]),
            *dict.fromkeys(notice for stretches in predictions for p in stretches for notice in p.notices),
        ],
    }


def _of_holdout(
    models: tuple[CalibratedModel, CalibratedModel],
    scores: Sequence[Json],
    predictions: tuple[Sequence[Prediction], Sequence[Prediction]],
) -> Json:
    """Return what is told of the predictions over the hold-out beside their errors, before and after."""
    told: Json = {"residual_whiteness": {}, "criteria": {}, "ensemble": {}}
    for when, model, scored, predicted in zip(("before", "after"), models, scores, predictions, strict=True):
        residuals = [p.measured_K - p.predicted_K for p in predicted]
        told["residual_whiteness"][when] = residual_whiteness(residuals)
        told["criteria"][when] = acceptance(model.spec, scored["per_sensor"])
        told["ensemble"][when] = ensemble(model.spec, scored["per_sensor"], predicted)
    return told


def _of_search(search: Search) -> Json:
    """Return what the search looked at and did not support, and what it left unexplained."""
    return {
        "not_supported": [
            {"effects": [e.label for e in judged.effects], "evidence": evidence_json(judged), "reason": judged.reason}
            for judged in best_rejected(search)[:MOST_REJECTED]
        ],
        "unexplained_share": {
            "before": unexplained_share(search.base.calibration()),
            "after": unexplained_share(search.trial.calibration()),
        },
        "search": {"complete": not search.left_out, "left_out": len(search.left_out), "every": search.every},
    }
