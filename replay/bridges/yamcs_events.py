"""What operators are to hear: anomalies, limits, findings and models of a twin as events of Yamcs.

An event is known by its key, from which its number follows, so that one sent again is the same event.
"""

import zlib
from collections.abc import Iterator
from typing import Any

from replay.bridges.instants import service_ms
from replay.bridges.yamcs_gateway import EventNote
from service.schemas import Activation, Alarm, Anomaly, Job

SEVERITY = {
    ("measured", "red"): "critical",
    ("measured", "yellow"): "warning",
    ("forecast", "red"): "distress",
    ("forecast", "yellow"): "watch",
}
"""Of limits, by what reaches them and by their colour."""


def number_of(key: str) -> int:
    """Return the sequence number of an event: 31 bits that follow from its key."""
    return zlib.crc32(key.encode()) & 0x7FFFFFFF


def _note(key: str, time: str, severity: str, kind: str, message: str, link: str | None = None) -> EventNote:
    return EventNote(key, service_ms(time), severity, kind, message, number_of(key), link)


def of_anomalies(anomalies: list[Anomaly]) -> Iterator[EventNote]:
    """Yield that each anomaly began, and that it ended."""
    for found in anomalies:
        key = f"anomaly:{found.id}"
        said = found.message or f"{found.sensor} does not behave as its model"
        yield _note(f"{key}:begun", found.start, "warning", "ANOMALY", f"{said} (score {found.score:.1f})")
        if found.stop is not None:
            yield _note(f"{key}:ended", found.stop, "info", "ANOMALY_ENDED", f"ended: {said}")


def of_alarms(alarms: list[Alarm]) -> Iterator[EventNote]:
    """Yield that each stay beyond a limit began, measured or forecast, and that it ended."""
    for alarm in alarms:
        key = f"alarm:{alarm.id}"
        kind = "LIMIT" if alarm.on == "measured" else "LIMIT_FORECAST"
        yield _note(f"{key}:begun", alarm.start, SEVERITY[alarm.on, alarm.colour], kind, alarm.message)
        if alarm.stop is not None:
            yield _note(f"{key}:ended", alarm.stop, "info", f"{kind}_ENDED", f"ended: {alarm.message}")


def of_activations(activations: list[Activation]) -> Iterator[EventNote]:
    """Yield that a model version became the active one."""
    for found in activations:
        key = f"model:{found.version}:{found.time}"
        yield _note(key, found.time, "info", "MODEL", f"model version {found.version} is active: {found.reason}")


def of_diagnoses(jobs: list[Job], report_url: str) -> Iterator[EventNote]:
    """Yield what each diagnosis found, with a link to its report; ``report_url`` is that of the twin's diagnoses."""
    for job in jobs:
        if job.state != "succeeded" or job.finished is None or job.result is None:
            continue
        link = f"{report_url}/{job.id}/report.html"
        findings = job.result.get("findings", [])
        for position, finding in enumerate(findings):
            message = f"{_words(finding)}; report: {link}"
            yield _note(f"finding:{job.id}:{position}", job.finished, "watch", "FINDING", message, link)
        if not findings:
            verdict = str(job.result.get("verdict", "")).replace("_", " ")
            yield _note(f"diagnosis:{job.id}", job.finished, "info", "DIAGNOSIS", f"{verdict}; report: {link}", link)


def _words(finding: dict[str, Any]) -> str:
    """Return a finding in one line: effect, place, parameters with their standard deviation."""
    place = ", ".join(f"{key} {' - '.join(v) if isinstance(v, list) else v}" for key, v in finding["where"].items())
    numbers = [f"{name} = {_span(value)}" for name, value in finding["parameters"].items()]
    return f"{finding['effect']} at {place}" + (f": {', '.join(numbers)}" if numbers else "")


def _span(value: Any) -> str:
    if not isinstance(value, dict) or not isinstance(value.get("mean"), int | float):
        return str(value)
    std = value.get("std")
    return f"{value['mean']:.4g}" + (f" ± {std:.2g}" if isinstance(std, int | float) else "")
