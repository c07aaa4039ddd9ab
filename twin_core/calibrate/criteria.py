"""The acceptance criteria of a correlation: what a specification asks of the errors of each sensor."""

from twin_core._typing import Json
from twin_core.network.spec import TwinSpec


def acceptance(spec: TwinSpec, per_sensor: Json) -> Json:
    """Return the correlation acceptance: worst errors over the sensors, the limits of all, and whether each meets its own.

    Parameters
    ----------
    spec
        Declares the criteria.
    per_sensor
        ``bias_K``, ``std_K`` and ``q99_abs_K`` of each sensor.

    Returns
    -------
    dict
        Worst ``bias_K``, ``std_K`` and ``q99_abs_K``; ``limit_…`` of each; ``met`` by all sensors; and under ``per_sensor``
        the limits of each and whether it has ``met`` them.
    """
    rows = {}
    for sensor, row in per_sensor.items():
        limits = spec.criteria.of(sensor)
        rows[sensor] = {
            **{f"limit_{name}": limit for name, limit in limits.items()},
            "met": all(abs(row[name]) <= limit for name, limit in limits.items()),
        }
    names = ("bias_K", "std_K", "q99_abs_K")
    return {
        **{name: max((abs(row[name]) for row in per_sensor.values()), default=0.0) for name in names},
        **{f"limit_{name}": getattr(spec.criteria, name) for name in names},
        "met": all(row["met"] for row in rows.values()),
        "per_sensor": rows,
    }


def with_met(spec: TwinSpec, scores: Json) -> Json:
    """Return the scores of a fit or a prediction with whether each sensor has ``met`` its criteria."""
    rows = acceptance(spec, scores["per_sensor"])["per_sensor"]
    return {**scores, "per_sensor": {s: {**row, "met": rows[s]["met"]} for s, row in scores["per_sensor"].items()}}
