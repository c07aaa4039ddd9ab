"""A spacecraft of solid bodies drawn by seed: geometry, orbit, loads, boundaries, sensors, sampling."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from benchmarks.worlds.field import Field, Plan, assemble
from benchmarks.worlds.loads import (
    LONG_DAY_S,
    boundary,
    load_spot,
    payloads,
    roll,
    sampling,
    scale_s,
    sunlight,
    telegraph,
)
from benchmarks.worlds.orbits import Orbit, draw_orbit
from benchmarks.worlds.parts import Builder
from benchmarks.worlds.stepping import GAMMA, NOTHING, Acting, Drive, Stepper, steady
from benchmarks.worlds.structures import STRUCTURES, couple, sense

LONGEST_STEP_S = {True: 100.0, False: 50.0}
"""Of days that are long, or short. Halving it moves readings by some thousandths of a kelvin where power switches."""


@dataclass(frozen=True)
class Spacecraft:
    """A spacecraft and its record to be.

    Attributes
    ----------
    kind
        One of ``STRUCTURES``.
    plan, orbit
        What it is made of, and where it flies.
    sample_s, n_lead, n_samples
        Sampling interval; samples before the record in which it settles; samples of the record.
    power_W, auxiliary, boundaries_K : channel -> (n_lead + n_samples,)
        What drives it. Sunlight is linear between samples, other power holds; temperatures are linear.
    sunlit
        Channels of sunlight.
    refined
        Steps for every usual one.
    """

    kind: str
    plan: Plan
    orbit: Orbit
    sample_s: float
    n_lead: int
    n_samples: int
    power_W: Mapping[str, np.ndarray]
    auxiliary: Mapping[str, np.ndarray]
    boundaries_K: Mapping[str, np.ndarray]
    sunlit: tuple[str, ...]
    refined: int = 1

    @property
    def nodes(self) -> tuple[str, ...]:
        """The declared nodes."""
        return tuple(self.plan.groups)

    @property
    def time_s(self) -> np.ndarray:
        """Instants of the record's samples, (n_samples,)."""
        return self.sample_s * np.arange(self.n_samples)

    @property
    def duration_s(self) -> float:
        """From the first to the last sample."""
        return self.sample_s * (self.n_samples - 1)

    @property
    def per_sample(self) -> int:
        """Steps from one sample to the next."""
        return int(np.ceil(self.sample_s / LONGEST_STEP_S[self.orbit.period_s > LONG_DAY_S])) * self.refined

    @cached_property
    def field(self) -> Field:
        """Its heat balance."""
        return assemble(self.plan)

    @cached_property
    def drive(self) -> Drive:
        """Its inputs at the stages of all steps."""
        step = self.sample_s / self.per_sample
        n_steps = (self.n_lead + self.n_samples - 1) * self.per_sample
        at = (np.arange(n_steps)[:, None] + np.array([GAMMA, 1.0])) / self.per_sample
        held = np.repeat(np.arange(n_steps)[:, None] // self.per_sample, 2, axis=1)
        grid = np.arange(self.n_lead + self.n_samples)
        inputs = {c: np.interp(at, grid, q) if c in self.sunlit else q[held] for c, q in self.power_W.items()}
        sinks = {b: np.interp(at, grid, t) for b, t in self.boundaries_K.items()}
        levels = {c: np.interp(at, grid, x) if c == "roll" else x[held] for c, x in self.auxiliary.items()}
        return Drive(-self.n_lead * self.sample_s, step, inputs, sinks, levels)

    @cached_property
    def start_K(self) -> np.ndarray:
        """The balance at mean inputs, from which it settles before the record."""
        means = {c: float(q.mean()) for c, q in self.power_W.items()}
        return steady(self.field, means, {b: float(t.mean()) for b, t in self.boundaries_K.items()})

    def refine(self) -> "Spacecraft":
        """Return the same with half the step."""
        return replace(self, refined=2 * self.refined)

    def read(self, acting: Acting = NOTHING, drive: Drive | None = None) -> np.ndarray:
        """Return the temperature at every sensor after every step of the record, (n_steps + 1, n_nodes)."""
        watch = np.stack([self.field.sensors[f"T_{node}"] for node in self.nodes])
        seen = Stepper(self.field, drive or self.drive, acting).run(self.start_K, watch)
        return seen[self.n_lead * self.per_sample :]


def draw_spacecraft(seed: int, stiffness: float = 1.0) -> Spacecraft:
    """Return the spacecraft of a seed; ``stiffness`` scales what conducts inside its nodes."""
    shape, flight = np.random.default_rng([seed, 71]), np.random.default_rng([seed, 72])
    kind = str(shape.choice(list(STRUCTURES)))
    builder = Builder(shape, stiffness)
    STRUCTURES[kind](builder)
    plan = builder.plan
    couple(builder)
    sense(builder)
    orbit = draw_orbit(flight)
    sample_s, n_lead, n_samples = sampling(orbit, flight)
    clock = sample_s * (np.arange(n_lead + n_samples) - n_lead)
    boundaries = {b: boundary(clock, flight) for b in dict.fromkeys(b for _, b, _ in plan.mounts)}
    sun = sunlight(plan, orbit, clock, flight)
    power = sun | payloads(plan, orbit, clock, sum(q.mean() for q in sun.values()), flight)
    for channel in power:
        node = channel[2:]
        plan.inputs[channel] = plan.radiators[node][0] if channel in sun else load_spot(plan, node)
    mode = telegraph(clock, (0.0, 1.0, 2.0), float(flight.uniform(0.4, 1.2)) * scale_s(orbit), flight)
    auxiliary = {"mode": mode} | ({"roll": roll(orbit, clock, flight)} if flight.random() < 0.6 else {})
    return Spacecraft(kind, plan, orbit, sample_s, n_lead, n_samples, power, auxiliary, boundaries, tuple(sun))
