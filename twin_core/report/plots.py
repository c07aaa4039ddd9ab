"""What the report's page plots: temperatures, missing heat, the network. Plain lists, thinned for a browser."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from twin_core._typing import FloatArray, Json
from twin_core.calibrate.result import CalibratedModel
from twin_core.discover.judge import Search
from twin_core.gp.polynomial import ForcePolynomial
from twin_core.holdout import HeldOut, Prediction
from twin_core.missing_heat.driven import thinned
from twin_core.missing_heat.smoothed import MissingHeat, NodeHeat
from twin_core.report.dossier import histograms, limits
from twin_core.telemetry import Record

MAX_POINTS = 1600
LAW_POINTS = 60


def _thin(n: int) -> np.ndarray:
    return np.unique(np.linspace(0, n - 1, min(n, MAX_POINTS)).round().astype(int))


def _listed(values: FloatArray) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def _axis(record: Record, time_s: FloatArray) -> list[float]:
    """Return times as unix seconds where the record is dated, else its own seconds."""
    shift = 0.0 if record.epoch_ns is None else record.epoch_ns / 1e9
    return [float(t) + shift for t in time_s]


def build_plots(
    search: Search,
    before: CalibratedModel,
    after: CalibratedModel,
    held: Sequence[HeldOut],
    predictions: tuple[Sequence[Prediction], Sequence[Prediction]],
    report: Json,
    missing: MissingHeat,
    driven: Sequence[Json],
) -> Json:
    """Return everything that the page of a report draws.

    Parameters
    ----------
    search, before, after, held, predictions
        As in ``report.build_report``.
    report
        The finished report, for its criteria and words.
    missing
        The heat that the declared model lacks.
    driven
        The heat of couplings over what drives it, as ``driven.driven_heat``.
    """
    first = search.base.fit.nominals[-1].segment.record
    return {
        "dated": first.epoch_ns is not None,
        **_temperatures(search, held, predictions),
        "missing_heat": [_missing_heat(heat, first) for heat in missing.heats],
        "driven_heat": thinned(driven, MAX_POINTS),
        "histograms": histograms(before.spec, predictions),
        "limits": limits(before.spec, before.noise_K),
        "network": _network(after),
        "criteria": {
            "bias_K": before.spec.criteria.bias_K,
            "q99_abs_K": before.spec.criteria.q99_abs_K,
            "std_K": before.spec.criteria.std_K,
            "before": report["criteria"]["before"],
            "after": report["criteria"]["after"],
        },
        "notices": list(report["notices"]),
        "words": list(report["words"]),
    }


def _temperatures(
    search: Search, held: Sequence[HeldOut], predictions: tuple[Sequence[Prediction], Sequence[Prediction]]
) -> Json:
    """Return measured and modelled temperatures of the last training segment and the hold-out that follows."""
    segment = search.base.fit.problem.segments[-1]
    follows = held[0].lead.time_s[0] == segment.record.time_s[0]
    sensors = search.base.fit.problem.network.spec.sensors
    fits = [trial.calibration().optimum.fit.predicted_K[-1] for trial in (search.base, search.trial)]
    times, measured = [p.time_s for p in predictions[0]], [p.measured_K for p in predictions[0]]
    modelled = [[p.predicted_K for p in ps] for ps in predictions]
    if follows:
        times, measured = [segment.record.time_s, *times], [segment.measured_K, *measured]
        modelled = [[fit, *rest] for fit, rest in zip(fits, modelled, strict=True)]
    time_s = np.concatenate(times[:2] if follows else times[:1])
    keep = _thin(time_s.size)
    columns = [np.concatenate(m[:2] if follows else m[:1])[keep] for m in (measured, *modelled)]
    return {
        "time": _axis(held[0].scored, time_s[keep]),
        "holdout_start": _axis(held[0].scored, predictions[0][0].time_s[:1])[0],
        "sensors": {
            sensor: dict(zip(("measured", "before", "after"), (_listed(c[:, i]) for c in columns), strict=True))
            for i, sensor in enumerate(sensors)
        },
    }


def _missing_heat(heat: NodeHeat, record: Record) -> Json:
    """Return the heat that a node of the declared model lacks, with its band, and what the effects say it is."""
    keep = _thin(heat.time_s.size)
    return {
        "node": heat.node,
        "time": _axis(record, heat.time_s[keep]),
        "temperature_K": _listed(heat.temperature_K[keep]),
        "mean_W": _listed(heat.mean_W[keep]),
        "std_W": _listed(heat.std_W[keep]),
        "effect_W": None if heat.effect_W is None else _listed(heat.effect_W[keep]),
        "law": None if heat.law is None else _law(heat.law, heat.temperature_K),
    }


def _law(law: ForcePolynomial, visited_K: FloatArray) -> Json:
    """Return the missing heat over the visited temperatures, as a curve with its band."""
    grid = np.linspace(float(visited_K.min()), float(visited_K.max()), LAW_POINTS)
    predicted = law.predict(grid)
    return {
        "degree": law.basis.degree,
        "temperature_K": _listed(grid),
        "mean_W": _listed(predicted.mean_W),
        "std_W": _listed(predicted.std_W),
    }


def _network(model: CalibratedModel) -> Json:
    """Return the network as a drawing needs it."""
    spec, values = model.spec, model.values
    conductors: list[list[Any]] = [[*c.between, values[c.name]] for c in spec.conductors]
    return {
        "nodes": [node.id for node in spec.nodes],
        "boundaries": list(spec.boundaries),
        "conductors": conductors,
        "radiators": [[r.node, r.sink] for r in spec.radiators],
        "effects": [
            {"effect": e.name, "where": {k: v if isinstance(v, str) else list(v) for k, v in e.where.items()}}
            for e in model.effects
        ],
    }
