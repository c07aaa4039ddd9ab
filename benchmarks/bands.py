"""Do the bands of a finding hold the truth? Each parameter's estimate beside what was hidden."""

from dataclasses import dataclass
from typing import Any

import numpy as np

Row = dict[str, Any]
"""One case of the loop's suite, as its results file holds it."""

Z90 = 1.6448536269514722


@dataclass(frozen=True)
class Band:
    """One parameter of a found effect: what was found, with its standard deviation, and what is true."""

    name: str
    mean: float
    std: float
    true: float

    @property
    def z(self) -> float:
        """The distance from the truth in standard deviations."""
        return (self.mean - self.true) / self.std

    @property
    def holds(self) -> bool:
        """Whether the 90 % band holds the truth."""
        return abs(self.z) <= Z90


def bands(truth: dict[str, Any], found: dict[str, Any] | None) -> list[Band]:
    """Return a band for every parameter of a found effect that the truth has too.

    Onsets and ends are scored apart, settings have no band, and a table is compared where both have the same knots.
    """
    held: list[Band] = []
    for name, true in truth.items():
        row = (found or {}).get(name)
        if row is None or row["std"] is None or name in ("time", "stop"):
            continue
        if not isinstance(row["std"], list):
            held.append(Band(name, row["mean"], row["std"], _about(true, truth, found or {})))
        elif np.array_equal(truth["knots"], (found or {})["knots"]["mean"]):
            parts = zip(row["mean"], row["std"], true, strict=True)
            held += [Band(f"{name}[{i}]", m, s, t) for i, (m, s, t) in enumerate(parts)]
    return held


def _about(true: float, truth: dict[str, Any], found: dict[str, Any]) -> float:
    """Return a temperature coefficient about the finding's reference: C (1 + a (T - T_ref)) is one line about any."""
    if "T_ref_K" not in truth:
        return true
    return float(true / (1.0 + true * (found["T_ref_K"]["mean"] - truth["T_ref_K"])))
