"""What drives a scenario over time: forcings realised on the steps and on the samples, hidden losses applied."""

import zlib
from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray
from twin_core.fem.scenario import Scenario
from twin_core.fem.signals import Path, Span

_PARTS = 16


@dataclass(frozen=True)
class Clock:
    """The steps of a run: from ``-settle`` to the end of the record.

    Attributes
    ----------
    start_s : (n_steps,)
        Start of each step.
    step_s
        Length of a step.
    """

    start_s: FloatArray
    step_s: float

    @property
    def ends_s(self) -> FloatArray:
        """All instants between steps, the start included, (n_steps + 1,)."""
        return np.append(self.start_s, self.start_s[-1] + self.step_s)


def clock_of(scenario: Scenario) -> Clock:
    """Return the steps of a scenario."""
    time = scenario.time
    before = int(np.ceil(time.settle_s / time.step_s - 1e-9))
    # One more sample interval, so that the last sample has steps on both sides even when it jitters.
    after = int(np.ceil((time.duration_s + time.sample_s) / time.step_s - 1e-9))
    return Clock(np.arange(-before, after, dtype=np.float64) * float(time.step_s), time.step_s)


def generator(scenario: Scenario, purpose: str) -> np.random.Generator:
    """Return the random generator of one purpose; adding a channel leaves the draws of the others alone."""
    return np.random.default_rng([scenario.seed, zlib.crc32(purpose.encode())])


def realise(scenario: Scenario, clock: Clock) -> dict[str, Path]:
    """Return every forcing as a function of time; held ones are those samples, each until the next."""
    start_s = float(clock.start_s[0]) - scenario.time.sample_s
    stop_s = float(clock.ends_s[-1]) + scenario.time.sample_s
    paths = {}
    for name, forcing in scenario.forcings.items():
        rng = generator(scenario, f"forcing {name}")
        path = forcing.signal.realise(Span(start_s, stop_s, rng, scenario.epoch_ns))
        paths[name] = _held(path, scenario.time.sample_s) if forcing.is_held else path
    return paths


def _held(path: Path, sample_s: float) -> Path:
    # The margin keeps an instant that rounding put just below a sample on that sample.
    return lambda time_s: path(np.floor(np.asarray(time_s) / sample_s + 1e-6) * sample_s)


@dataclass(frozen=True)
class Driving:
    """Forcings at the stages of every step.

    Attributes
    ----------
    inputs_W : (n_steps, n_stages, n_forcings)
        Delivered heat; columns of other kinds are zero.
    channels : (n_steps, n_stages, n_forcings)
        Values as they are, for hidden effects that follow a channel.
    boundary_K : (n_steps, n_stages, n_boundaries)
    """

    inputs_W: FloatArray
    channels: FloatArray
    boundary_K: FloatArray


def drive_scenario(
    scenario: Scenario,
    clock: Clock,
    paths: dict[str, Path],
    fractions: tuple[float, ...],
    weights: tuple[float, ...] | None = None,
) -> Driving:
    """Return the forcings at every stage. A held forcing keeps, in a step, the value of the step's start.

    Where the stages have weights, others are shifted so that their weighted sum is the mean over the step: smooth
    forcings keep the order of the scheme, and a jump inside a step (the edge of a shadow) delivers its due.
    """
    stages_s = clock.start_s[:, None] + np.array(fractions) * clock.step_s
    starts_s = np.repeat(clock.start_s[:, None], len(fractions), axis=1)
    shape = (*stages_s.shape, len(scenario.forcings))
    channels, inputs_W = np.zeros(shape), np.zeros(shape)
    for i, (name, forcing) in enumerate(scenario.forcings.items()):
        times_s = starts_s if forcing.is_held else stages_s
        channels[..., i] = paths[name](times_s)
        if weights is not None and not forcing.is_held:
            channels[..., i] += (_step_means(paths[name], clock) - channels[..., i] @ np.array(weights))[:, None]
        if forcing.kind == "power":
            inputs_W[..., i] = _deliver(scenario, name, channels[..., i], times_s)
    return Driving(inputs_W, channels, _boundaries(scenario, channels))


def _step_means(path: Path, clock: Clock) -> FloatArray:
    """Return the mean of a forcing over each step, (n_steps,), by the midpoint rule on sixteen parts."""
    offsets = (np.arange(_PARTS) + 0.5) / _PARTS * clock.step_s
    return path(clock.start_s[:, None] + offsets).mean(axis=1)


def _deliver(scenario: Scenario, name: str, declared: FloatArray, time_s: FloatArray) -> FloatArray:
    """Apply the hidden effects on one channel."""
    for effect in scenario.hidden:
        if effect.where.get("channel") == name:
            declared = effect.deliver(declared, time_s, scenario.epoch_ns)
    return declared


def _boundaries(scenario: Scenario, channels: FloatArray) -> FloatArray:
    """Return boundary temperatures at every stage, (n_steps, n_stages, n_boundaries)."""
    names = list(scenario.forcings)
    columns = [
        np.full(channels.shape[:2], boundary.value_K)
        if boundary.forcing is None
        else channels[..., names.index(boundary.forcing)]
        for boundary in scenario.boundaries.values()
    ]
    return np.stack(columns, axis=-1) if columns else np.zeros((*channels.shape[:2], 0))
