"""The hold-out: an open-loop rollout from one initial state, never corrected, that no choice has seen."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin_core._typing import FloatArray
from twin_core.assimilate import assimilate
from twin_core.calibrate.problem import measured_temperatures
from twin_core.calibrate.result import CalibratedModel
from twin_core.errors import ModelError, TelemetryError
from twin_core.network.dynamics import reading_offsets_K
from twin_core.simulate.extrapolation import extrapolations, in_words
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import Rollout, rollout
from twin_core.telemetry import Record
from twin_core.wording import counted

DEFAULT_BURN_IN_SHARE = 0.05
MIN_BURN_IN_SAMPLES = 10
MIN_HELD_SAMPLES = 3


@dataclass(frozen=True)
class HeldOut:
    """A stretch of telemetry to be predicted, and the telemetry before it that tells the initial state.

    Attributes
    ----------
    lead
        Telemetry up to and including the sample from which the rollout starts.
    scored
        That sample and everything after it; the first sample is not scored.
    """

    lead: Record
    scored: Record


def split_fraction(records: Sequence[Record], fraction: float) -> tuple[list[Record], list[HeldOut]]:
    """Split the last ``fraction`` of the record's time span off.

    Parameters
    ----------
    records
        Segments in order; several segments are split by their summed spans. One of which a part would be too short stays whole.
    fraction
        Between 0 and 1, exclusive.

    Returns
    -------
    train, holdout
        Segments for every fit and choice; what is predicted.

    Raises
    ------
    TelemetryError
        If either part would be empty.
    """
    if not 0.0 < fraction < 1.0:
        raise TelemetryError(f"holdout: must be between 0 and 1, exclusive (got {fraction:g})")
    names, n_samples = ", ".join(r.name for r in records), sum(r.time_s.size for r in records)
    if n_samples < MIN_BURN_IN_SAMPLES + MIN_HELD_SAMPLES:
        raise TelemetryError(
            f"{names}: {counted(n_samples, 'sample')} in all, too few for a hold-out: {MIN_BURN_IN_SAMPLES} to train on and "
            f"{MIN_HELD_SAMPLES} to predict are needed; give a longer record"
        )
    spans = np.array([float(r.time_s[-1] - r.time_s[0]) for r in records])
    kept = (1.0 - fraction) * spans.sum()
    train: list[Record] = []
    held: list[HeldOut] = []
    for record, span in zip(records, spans, strict=True):
        cut = float(record.time_s[0]) + min(max(kept, 0.0), span)
        before = record.time_s <= cut + 1e-9
        too_short = before.sum() < MIN_BURN_IN_SAMPLES, (~before).sum() < MIN_HELD_SAMPLES
        if kept >= span or (too_short[1] and record is not records[-1]):
            train.append(record)
        elif kept <= 0.0 or (too_short[0] and train):
            held.append(split_burn_in(record, None))
        else:
            _check_parts(record.name, fraction, int(before.sum()), int((~before).sum()))
            lead = record.take(before)
            train.append(lead)
            held.append(HeldOut(lead, record.take(np.arange(record.time_s.size) >= before.sum() - 1)))
        kept -= span
    if not train or not held:
        raise TelemetryError(
            f"{names}: cannot be split by a hold-out of {fraction:g}; choose another one, or put single samples into one file"
        )
    return train, held


def _check_parts(name: str, fraction: float, n_train: int, n_held: int) -> None:
    """Refuse a cut that leaves either part too short."""
    for count, least, purpose in ((n_train, MIN_BURN_IN_SAMPLES, "train on"), (n_held, MIN_HELD_SAMPLES, "predict")):
        if count < least:
            raise TelemetryError(
                f"{name}: a hold-out of {fraction:g} leaves {counted(count, 'sample')} to {purpose}, {least} are needed; "
                "choose another hold-out, or give a longer record"
            )


def split_burn_in(record: Record, burn_in_s: float | None) -> HeldOut:
    """Return a separate hold-out record whose first seconds tell the initial state and are not scored.

    Without ``burn_in_s`` 5 % of the span are used, at least ten samples. Raises TelemetryError if nothing would be left.
    """
    span = float(record.time_s[-1] - record.time_s[0])
    seconds = DEFAULT_BURN_IN_SHARE * span if burn_in_s is None else burn_in_s
    last = int(np.searchsorted(record.time_s, record.time_s[0] + seconds, side="right"))
    if burn_in_s is None:
        last = max(last, MIN_BURN_IN_SAMPLES)
    last = max(last, 1)
    if record.time_s.size - last < 2:
        raise TelemetryError(
            f"{record.name}: a burn-in of {last} of its {record.time_s.size} samples leaves fewer than two to score; "
            "give a longer hold-out, or a shorter burn-in"
        )
    return HeldOut(
        record.take(np.arange(record.time_s.size) < last), record.take(np.arange(record.time_s.size) >= last - 1)
    )


@dataclass(frozen=True)
class Prediction:
    """Measured and predicted readings of one hold-out stretch, (n_samples, n_sensors) in K; the start is left out.

    ``notices`` tell where a learned effect is used outside what it was learned from.
    """

    time_s: FloatArray
    measured_K: FloatArray
    predicted_K: FloatArray
    notices: tuple[str, ...] = ()


def predict(model: CalibratedModel, held: HeldOut, *, holding: bool = False) -> Prediction:
    """Roll a model out over a hold-out stretch from the state filtered at the end of its lead.

    Parameters
    ----------
    model, held
    holding
        Where the balance has no solution, hold the last temperatures that are one to the end of the stretch, and say so.

    Raises
    ------
    ModelError
        Without ``holding``, if the balance has no solution there: an error over the rest alone would look better than the
        model is.
    """
    network = model.network()
    values = network.parameters.values
    state = assimilate(model, held.lead).mean_K
    forcing = build_forcing(network, held.scored, model.max_step_s)
    path = rollout(network, values, state, forcing)
    lost: tuple[str, ...] = ()
    if not path.converged:
        none = f"{held.scored.name}: the heat balance has no solution over the hold-out"
        if not holding:
            raise ModelError(f"{none}; check its inputs and boundaries")
        path, n_solved = _held_on(path)
        share = n_solved / forcing.n_steps
        lost = (f"{none} beyond {share:.0%} of it; from there on the last temperatures are held",)
    read = path.at_samples(forcing.sample_step)[:, network.sensor_node]
    read += reading_offsets_K(network, values, held.scored.clock_s)
    measured = measured_temperatures(model.spec, held.scored)
    notices = in_words(extrapolations(network, model.effects, forcing, path))
    return Prediction(held.scored.time_s[1:], measured[1:], read[1:], (*lost, *notices))


def _held_on(path: Rollout) -> tuple[Rollout, int]:
    """Return a trajectory whose last solved temperatures last to its end, and the number of steps that are solved."""
    n_solved = int(np.isfinite(path.stages_K).all(axis=(1, 2)).cumprod().sum())
    stages = path.stages_K.copy()
    stages[n_solved:] = stages[n_solved - 1, 1] if n_solved else path.start_K
    return replace(path, stages_K=stages), n_solved
