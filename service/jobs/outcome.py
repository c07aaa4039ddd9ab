"""What becomes of a finished job: a new model version, perhaps active, and the messages that say so."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from service.instants import now_us, parse_instant
from service.store import anomalies, events, jobs, models
from service.store.connection import Connection
from service.stream.messages import EventStretch, Stretch
from service.workbench.interface import Outcome
from twin_core.anomaly.hysteresis import TOGETHER

Json = dict[str, Any]


@dataclass(frozen=True)
class Finished:
    """A job's outcome on its way into the store."""

    job: str
    kind: str
    outcome: Outcome
    provenance: Json
    rival: int | None
    activate: bool | None
    part: str = ""
    """Which part of the archive it looked at, in words; empty: all."""
    held: jobs.Claim | None = None
    """Without it in hand nothing is stored; None for a model that no job made."""


@dataclass(frozen=True)
class Decision:
    """Whether a new model becomes the active one, and why."""

    activate: bool
    reason: str


def save(connection: Connection, twin: int, finished: Finished) -> tuple[int | None, Sequence[Stretch]]:
    """Store version, activation and result in one transaction; return the version that is active now if it changed."""
    if finished.held is not None:
        jobs.hold(connection, finished.held)
    if finished.kind == "diagnosis" and not (finished.outcome.report or {}).get("findings"):
        return None, _end(connection, twin, finished, None, Decision(False, "nothing was found to add"))
    version = models.add(connection, twin, finished.kind, _summary(finished), finished.outcome.document)
    decision = _decide(connection, twin, finished)
    if decision.activate:
        models.activate(connection, twin, version, decision.reason)
    _explain(connection, twin, finished)
    unlike = finished.outcome.extra.get("family", {}).get("differs", {})
    rows = anomalies.tell_family(connection, twin, version, finished.provenance["epoch_us"], unlike)
    news = [("anomaly", {"anomaly": row.wire()}) for row in rows if decision.activate]
    told = [EventStretch(tuple(events.append(connection, twin, now_us(), news)))] if news else []
    ended = _end(connection, twin, finished, version, decision)
    return (version if decision.activate else None), [*told, *ended]


def _summary(finished: Finished) -> Json:
    outcome = finished.outcome
    return {
        "train": outcome.train,
        "validation": outcome.validation,
        "effects": outcome.effects,
        "epoch_us": finished.provenance["epoch_us"],
        "provenance": {**finished.provenance, "job": finished.job},
        **outcome.extra,
    }


def _explain(connection: Connection, twin: int, finished: Finished) -> None:
    """Give the anomalies that the findings explain their cause: at their places, and where the first one let the error fall."""
    report = finished.outcome.report
    if report is None:
        return
    span_us = _instant(report, "train", "start"), _instant(report, "holdout", "stop")
    causes = [
        {"effect": finding["effect"], "where": finding["where"], "diagnosis": finished.job}
        for finding in report["findings"]
    ]
    for cause in causes:
        sensors = _sensors_at(finished.outcome.document["spec"], cause["where"])
        anomalies.explain(connection, twin, sensors, cause, span_us)
    anomalies.explain(connection, twin, [*_relieved(report), TOGETHER], causes[0], span_us)


FELL = 0.7
"""A sensor whose held-out error fell to this share of what it was owed it to what was found."""


def _relieved(report: Json) -> list[str]:
    """Return the sensors whose held-out error fell by much."""
    before, after = (report.get(name, {}).get("per_sensor", {}) for name in ("before", "after"))
    errors = {name: (before[name].get("rmse_K"), after.get(name, {}).get("rmse_K")) for name in before}
    return sorted(name for name, (old, new) in errors.items() if old and new is not None and new <= FELL * old)


def _instant(report: Json, part: str, end: str) -> int | None:
    """Return the instant of one end of a part of the record; None where the report does not date it."""
    value = report.get(part, {}).get(end)
    return parse_instant(value, end) if isinstance(value, str) else None


def _sensors_at(specification: Json, where: Json) -> list[str]:
    """Return the sensors at the place of an effect; an input concerns the nodes that it heats."""
    nodes = {where.get("node"), *where.get("nodes", ())}
    nodes |= {load["node"] for load in specification.get("loads", ()) if load["channel"] == where.get("channel")}
    found = {where["sensor"]} if "sensor" in where else set()
    for node in specification["nodes"]:
        sensors = node.get("sensor") or []
        found |= set([sensors] if isinstance(sensors, str) else sensors) if node["id"] in nodes else set()
    return sorted(found)


def _decide(connection: Connection, twin: int, finished: Finished) -> Decision:
    """Return whether the new model becomes the active one, and why."""
    if finished.activate is not None:
        return Decision(finished.activate, "requested" if finished.activate else "not asked for")
    active = models.active(connection, twin)
    if active is None:
        return Decision(True, "the first model")
    if active.version != finished.rival:
        return Decision(False, f"version {active.version} was activated meanwhile")
    new, old = finished.outcome.validation.get("rmse_K"), finished.outcome.rival_rmse_K
    if new is None or old is None:
        return Decision(False, "no recent data on which to compare it with the active one")
    figures = f"on recent data: {new:.3g} K against {old:.3g} K of version {active.version}"
    return Decision(new < old, f"{'better' if new < old else 'not better'} {figures}")


def _message(finished: Finished, version: int | None, decision: Decision) -> str:
    """Return the outcome in one line, what could not be scored included."""
    part = "; its search ended at its deadline with the best so far" if finished.outcome.cut_short else ""
    part += f"; from {finished.part}" if finished.part else ""
    if version is None:
        return decision.reason + part
    unscored = finished.outcome.validation.get("rmse_K") is None
    score = "; its error is not known: the data held back hold no reading to compare with" if unscored else ""
    return f"version {version} is {'active' if decision.activate else 'not active'}: {decision.reason}{score}{part}"


def _end(
    connection: Connection, twin: int, finished: Finished, version: int | None, decision: Decision
) -> Sequence[Stretch]:
    outcome = finished.outcome
    result: Json = {"model_version": version, "version": version, "activated": decision.activate}
    if outcome.report is not None:
        result = {**outcome.report, **result}
    else:
        result |= {"reason": decision.reason, "validation": outcome.validation, "rival_rmse_K": outcome.rival_rmse_K}
    message = _message(finished, version, decision)
    if not jobs.finish(connection, finished.job, "succeeded", message, result, outcome.page):
        raise LookupError(f"job {finished.job} has ended already")
    messages: list[tuple[str, Json]] = []
    if version is not None:
        messages.append(("model", {"version": version, "active": decision.activate, "source": finished.kind}))
    messages.append(("job", {"job": _brief(connection, twin, finished.kind, finished.job)}))
    return [EventStretch(tuple(events.append(connection, twin, now_us(), messages)))]


def _brief(connection: Connection, twin: int, kind: str, job: str) -> Json:
    """Return a job for the stream; its result may be large and is fetched by those who want it."""
    wire = jobs.get(connection, twin, kind, job).wire()
    if kind == "diagnosis" and wire["result"] is not None:
        wire["result"] = {name: wire["result"].get(name) for name in ("verdict", "model_version", "activated")}
    return wire


def tell(connection: Connection, twin: int, messages: list[tuple[str, Json]]) -> tuple[None, Sequence[Stretch]]:
    """Tell the stream something."""
    return None, [EventStretch(tuple(events.append(connection, twin, now_us(), messages)))]


def announce(
    connection: Connection, twin: int, kind: str, job: str, change: Any, *args: Any
) -> tuple[Json, Sequence[Stretch]]:
    """Apply ``change(connection, ...)`` to a job and tell the stream how it stands now."""
    change(connection, *args)
    wire = _brief(connection, twin, kind, job)
    return wire, [EventStretch(tuple(events.append(connection, twin, now_us(), [("job", {"job": wire})])))]


def activate(connection: Connection, twin: int, version: int, reason: str) -> tuple[models.ModelRow, Sequence[Stretch]]:
    """Make a version the active one and tell the stream."""
    models.activate(connection, twin, version, reason)
    row = models.get(connection, twin, version)
    body = {"version": version, "active": True, "source": row.source}
    return row, [EventStretch(tuple(events.append(connection, twin, now_us(), [("model", body)])))]


def add_manual(
    connection: Connection, twin: int, outcome: Outcome, provenance: Json
) -> tuple[models.ModelRow, Sequence[Stretch]]:
    """Store a model that was made elsewhere as a new, inactive version."""
    summary = _summary(Finished("", "manual", outcome, provenance, None, False))
    version = models.add(connection, twin, "manual", summary, outcome.document)
    row = models.get(connection, twin, version)
    body = {"version": version, "active": False, "source": "manual"}
    return row, [EventStretch(tuple(events.append(connection, twin, now_us(), [("model", body)])))]
