"""What the report's page plots: temperatures, missing heat, the network. Plain lists, thinned for a browser."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from twin_core._typing import FloatArray, Json
from twin_core.calibrate.latent_heat import smoothed_states
from twin_core.calibrate.result import CalibratedModel
from twin_core.discover.confirm import Trial
from twin_core.discover.holdout import HeldOut, Prediction
from twin_core.discover.search import Search
from twin_core.effects.base import Effect
from twin_core.network.dynamics import fill_boundaries
from twin_core.network.terms import Along
from twin_core.telemetry import Record

MAX_POINTS = 1600


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
) -> Json:
    """Return everything that the page of a report draws.

    Parameters
    ----------
    search, before, after, held, predictions
        As in ``report.build_report``.
    report
        The finished report, for its criteria and words.
    """
    first = search.base.fit.nominals[0].segment.record
    return {
        "dated": first.epoch_ns is not None,
        **_temperatures(search, held, predictions),
        "missing_heat": [_missing_heat(search, node) for node in _nodes_of_interest(search)],
        "network": _network(after),
        "criteria": {
            "bias_K": before.spec.criteria.bias_K,
            "q99_abs_K": before.spec.criteria.q99_abs_K,
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
    fits = [trial.calibration.optimum.fit.predicted_K[-1] for trial in (search.base, search.trial)]
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


def _nodes_of_interest(search: Search) -> list[str]:
    """Return the nodes that the findings touch, else the two with most latent heat for their size."""
    nodes: list[str] = []
    for finding in search.findings:
        for effect in finding.effects:
            nodes += _touched(effect, search.base)
    if not nodes:
        declared = search.base.fit.problem.network.nodes
        nodes = [declared[i] for i in np.argsort(-search.base.fit.latent.std_W)[:2]]
    return list(dict.fromkeys(nodes))[:4]


def _touched(effect: Effect, base: Trial) -> list[str]:
    """Return the declared nodes at which an effect acts."""
    layout = base.fit.problem.network.layout
    if "node" in effect.where:
        return [effect.where["node"]]
    if "nodes" in effect.where:
        return [n for n in effect.where["nodes"] if n in layout.declared_nodes]
    if "channel" in effect.where:
        return [load.node for load in layout.loads_of(effect.where["channel"])]
    return [layout.sensor_node(effect.where["sensor"])]


def _missing_heat(search: Search, node: str) -> Json:
    """Return the latent heat on a node of the declared model, with its band, and what the effects say it is."""
    fit = search.base.fit
    nominal = fit.nominals[-1]
    problem = fit.problem.with_network(fit.network)
    states, heat, std = smoothed_states(problem, fit.latent, nominal)
    at = nominal.segment.forcing.sample_step[:-1]
    keep = at[_thin(at.size)]
    position = fit.problem.network.layout.node(node)
    record = nominal.segment.record
    time_s = nominal.segment.forcing.stage_time_s[keep, 0]
    said = _effect_heat(search, node, states)
    return {
        "node": node,
        "time": _axis(record, time_s),
        "temperature_K": _listed(states[keep, position]),
        "mean_W": _listed(heat[keep, position]),
        "std_W": _listed(std[keep, position]),
        "effect_W": None if said is None else _listed(said[keep]),
    }


def _effect_heat(search: Search, node: str, states_K: FloatArray) -> FloatArray | None:
    """Return the heat of all findings into a node, (n_steps,), at the smoothed temperatures; None without findings."""
    if not search.findings:
        return None
    network = search.trial.calibration.network
    segment = search.trial.fit.problem.segments[-1]
    values = network.parameters.values
    path = search.trial.calibration.optimum.fit.trajectories[-1]
    stages = path.stages_K.copy()
    declared = search.base.fit.problem.n_nodes
    stages[:, :, :declared] = states_K[1:, None, :]
    forcing = segment.forcing
    boundaries = fill_boundaries(network, values, forcing.boundaries_flat_K(0, forcing.n_steps))
    along: Along = forcing.along(stages.reshape(-1, stages.shape[2]), boundaries, 0, forcing.n_steps)
    position = network.layout.node(node)
    total = np.zeros(2 * forcing.n_steps)
    for effect in search.trial.effects:
        for term in effect.addition(network.layout).terms:
            part = term.evaluate(along, values[network.term_index(term)])
            for local, index in enumerate(part.nodes):
                if index == position:
                    total += part.heat_W[:, local]
    return total.reshape(-1, 2)[:, 1]


def _network(model: CalibratedModel) -> Json:
    """Return the network as a drawing needs it."""
    spec, values = model.spec, model.values
    conductors: list[list[Any]] = [[*c.between, values[f"G:{c.between[0]}|{c.between[1]}"]] for c in spec.conductors]
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
