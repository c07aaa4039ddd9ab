"""One case of the suites: what an operator declares and sees, and what is really there."""

import pickle
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import dump_spec, load_spec
from twin_core.telemetry import Record

TRAINING_SHARE = 0.7
"""The part of a record that an effect has to show itself in; the suites hold the rest back."""


@dataclass(frozen=True)
class Truth:
    """One hidden effect.

    Attributes
    ----------
    effect
        Its name in the vocabulary, or of a kind outside it.
    where, parameters
        Place and size by the report's keys.
    onset_s
        When it sets in; None where it is there from the start.
    trace
        How far it alone moves the readings of the training part, rms over all sensors in units of their noise: a heater
        that starts to work in the hold-out leaves none, and nobody can find it.
    trace_beyond
        The same of what no change of the declared parameters or initial temperatures imitates (to first order).
    """

    effect: str
    where: dict[str, Any]
    parameters: dict[str, Any] = field(default_factory=dict)
    onset_s: float | None = None
    trace: float = float("inf")
    trace_beyond: float = float("inf")


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes
    ----------
    spec, record
        What the operator declares and sees.
    truths
        What is hidden, the largest trace first; empty on a healthy spacecraft.
    truth_K : (n_times, n_nodes)
        Temperatures without noise, in the order of the nodes.
    noise_K
        Standard deviation of the sensors' noise.
    facts
        What else is known of the case: kind, structural misfit over noise, what drifts beside the effects.
    """

    spec: TwinSpec
    record: Record
    truths: tuple[Truth, ...]
    truth_K: np.ndarray
    noise_K: float
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def largest(self) -> Truth:
        """The effect with the largest trace; one without name or place on a healthy spacecraft."""
        return self.truths[0] if self.truths else _NOTHING

    @property
    def effect(self) -> str | None:
        """Name of the largest effect; None on a healthy spacecraft."""
        return self.truths[0].effect if self.truths else None

    @property
    def where(self) -> dict[str, Any]:
        """Place of the largest effect."""
        return self.largest.where

    @property
    def parameters(self) -> dict[str, Any]:
        """Size of the largest effect."""
        return self.largest.parameters

    @property
    def onset_s(self) -> float | None:
        """Onset of the largest effect, if it has one."""
        return self.largest.onset_s

    @property
    def trace(self) -> float:
        """Trace of the largest effect."""
        return self.largest.trace


_NOTHING = Truth("", {})


def trace_of(moved_K: np.ndarray, noise_K: float) -> float:
    """Return the rms over noise of a change of the readings, (n_times, n_sensors), over the training part."""
    moved_K = moved_K[: int(TRAINING_SHARE * len(moved_K))]
    return float(np.sqrt(np.nanmean(moved_K**2))) / noise_K


def save_case(case: Case, path: Path, **labels: Any) -> None:
    """Write a case and labels (group, seed, ...) as plain Python objects and arrays, so that any later code reads them."""
    largest = case.largest
    plain = {
        **labels,
        "effect": case.effect,
        "effects": [truth.effect for truth in case.truths],
        "where": largest.where,
        "parameters": largest.parameters,
        "onset_s": largest.onset_s,
        "trace": largest.trace if case.truths else None,
        "truths": [asdict(truth) for truth in case.truths],
        "spec": dump_spec(case.spec),
        "time_s": case.record.time_s,
        "values": dict(case.record.values),
        "epoch_ns": case.record.epoch_ns,
        "truth_K": case.truth_K,
        "noise_K": case.noise_K,
        "facts": case.facts,
    }
    part = path.with_suffix(".part")
    part.write_bytes(pickle.dumps(plain))
    part.replace(path)


def read_case(path: Path) -> tuple[Case, dict[str, Any]]:
    """Return a case that ``save_case`` wrote, and all that the file holds. Unpickle only files that you wrote."""
    plain = pickle.loads(path.read_bytes())
    record = Record(plain["time_s"], plain["values"], plain["epoch_ns"], path.stem)
    truths = tuple(Truth(**truth) for truth in plain["truths"])
    return (
        Case(load_spec(plain["spec"]), record, truths, plain["truth_K"], plain["noise_K"], plain["facts"]),
        plain,
    )
