"""What operators are to hear: anomalies, limits, findings and models of a twin as events.

An event is known by its key, from which its number follows, so that one sent again is the same event.
"""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

from replay.bridges.instants import service_ms
from service.schemas import Activation, Alarm, Anomaly, Job

Severity = Literal["info", "watch", "warning", "distress", "critical"]
"""Those of Yamcs, which follow ECSS."""

SEVERITY: dict[tuple[str, str], Severity] = {
    ("measured", "red"): "critical",
    ("measured", "yellow"): "warning",
    ("forecast", "red"): "distress",
    ("forecast", "yellow"): "watch",
}
"""Of limits, by what reaches them and by their colour."""


@dataclass(frozen=True)
class Note:
    """One event of a twin.

    Attributes
    ----------
    key
        Makes it the same event when it is told again.
    time_ms, since_ms
        When it happened and, where it is the end of something, when that began; milliseconds since 1970.
    about
        Sensor, channel or twin that it is about.
    """

    key: str
    time_ms: int
    severity: Severity
    kind: str
    message: str
    about: str
    since_ms: int | None = None
    link: str | None = None

    @property
    def number(self) -> int:
        """Sequence number: 31 bits that follow from the key."""
        return zlib.crc32(self.key.encode()) & 0x7FFFFFFF


def of_anomalies(anomalies: list[Anomaly]) -> Iterator[Note]:
    """Yield that each anomaly began, and that it ended, with its cause if one is known by then."""
    for found in anomalies:
        key, start_ms = f"anomaly:{found.id}", service_ms(found.start)
        said = found.message or f"{found.sensor} does not behave as its model"
        told = f"{said} (score {found.score:.1f})"
        yield Note(f"{key}:begun", start_ms, "warning", "ANOMALY", told, found.sensor)
        if found.stop is not None:
            cause = f"; cause: {found.cause['effect']}" if found.cause else ""
            stop_ms = service_ms(found.stop)
            yield Note(
                f"{key}:ended", stop_ms, "info", "ANOMALY_ENDED", f"ended: {said}{cause}", found.sensor, start_ms
            )


def of_alarms(alarms: list[Alarm]) -> Iterator[Note]:
    """Yield that each stay beyond a limit began, measured or forecast, and that it ended."""
    for alarm in alarms:
        key, start_ms = f"alarm:{alarm.id}", service_ms(alarm.start)
        kind = "LIMIT" if alarm.on == "measured" else "LIMIT_FORECAST"
        severity = SEVERITY[alarm.on, alarm.colour]
        yield Note(f"{key}:begun", start_ms, severity, kind, alarm.message, alarm.channel)
        if alarm.stop is not None:
            told, stop_ms = f"ended: {alarm.message}", service_ms(alarm.stop)
            yield Note(f"{key}:ended", stop_ms, "info", f"{kind}_ENDED", told, alarm.channel, start_ms)


def of_activations(activations: list[Activation]) -> Iterator[Note]:
    """Yield that a model version became the active one."""
    for found in activations:
        told = f"model version {found.version} is active: {found.reason}"
        yield Note(f"model:{found.version}:{found.time}", service_ms(found.time), "info", "MODEL", told, "model")


def of_diagnoses(jobs: list[Job], report_url: str) -> Iterator[Note]:
    """Yield what each diagnosis found, with a link to its report; ``report_url`` is that of the twin's diagnoses."""
    for job in jobs:
        if job.state != "succeeded" or job.finished is None or job.result is None:
            continue
        link, time_ms = f"{report_url}/{job.id}/report.html", service_ms(job.finished)
        findings = job.result.get("findings", [])
        for position, finding in enumerate(findings):
            told = f"{_words(finding)}; report: {link}"
            yield Note(f"finding:{job.id}:{position}", time_ms, "watch", "FINDING", told, finding["effect"], link=link)
        if not findings:
            told = f"{str(job.result.get('verdict', '')).replace('_', ' ')}; report: {link}"
            yield Note(f"diagnosis:{job.id}", time_ms, "info", "DIAGNOSIS", told, "diagnosis", link=link)


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
