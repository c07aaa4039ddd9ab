"""What an importer hands back, and what all importers share."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from twin_core._typing import FloatArray, Json


@dataclass(frozen=True)
class Course:
    """How an input goes over time: linear between its points, held beyond them, or repeated.

    Attributes
    ----------
    time_s, values : (n_points,)
        Seconds, increasing, and values in the channel's unit.
    period_s
        After which it repeats, counted from 0; None where it does not.
    """

    time_s: FloatArray
    values: FloatArray
    period_s: float | None = None

    def at(self, time_s: FloatArray) -> FloatArray:
        """Return the values at times, (n_times,)."""
        return np.interp(time_s, self.time_s, self.values, period=self.period_s)


def over_time(
    courses: Mapping[str, Course], duration_s: float | None = None
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return all courses on one axis that has every point of each, (n_times,) in s, and channel -> values.

    Without ``duration_s`` it is as long as the longest of them.
    """
    longest = max(max(float(c.time_s[-1]), c.period_s or 0.0) for c in courses.values())
    stop = longest if duration_s is None else duration_s
    points = [np.array([0.0, stop])]
    for course in courses.values():
        turns = 1 if course.period_s is None else int(stop // course.period_s) + 1
        points += [course.time_s + k * (course.period_s or 0.0) for k in range(turns)]
    axis = np.unique(np.concatenate(points))
    axis = axis[(axis >= 0.0) & (axis <= stop)]
    return axis, {name: course.at(axis) for name, course in courses.items()}


@dataclass(frozen=True)
class Imported:
    """A model of another tool as the data of a specification.

    Attributes
    ----------
    data
        What ``load_spec`` reads.
    notes
        What was translated in another form, or told and left out because it changes no temperature: one line each.
    refused
        What has no counterpart here, one line each that names file and line: the model is not whole without it.
    start_K
        Node -> the initial temperature that the model names.
    courses
        Channel -> how the model says that it goes over time: telemetry, or what stands for it, has to carry it.
    """

    data: Json
    notes: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    start_K: dict[str, float] = field(default_factory=dict)
    courses: dict[str, Course] = field(default_factory=dict)


def name_of(text: str, prefix: str = "n") -> str:
    """Return a text as a name of the specification: what a name cannot hold becomes '_', a leading digit gets a prefix."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", text.strip())
    return name if name[:1].isalpha() or name[:1] == "_" else f"{prefix}{name}"


def twin_id(text: str) -> str:
    """Return a text as the id of a twin."""
    return re.sub(r"-+", "-", re.sub(r"[^a-z0-9-]", "-", text.lower())).strip("-")[:63] or "imported"


def number(value: float) -> float:
    """Return a number as it should stand in a file: short of what its last digits do not mean."""
    return float(f"{value:.15g}")


Data = dict[str, Any]
