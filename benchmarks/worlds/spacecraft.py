"""A spacecraft of solid bodies drawn by seed: geometry, orbit, loads, boundaries, sensors, sampling."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from benchmarks.worlds.body import WHOLE
from benchmarks.worlds.field import Field, Plan, assemble
from benchmarks.worlds.orbits import Orbit, draw_orbit
from benchmarks.worlds.parts import Builder
from benchmarks.worlds.stepping import GAMMA, NOTHING, SIGMA_W_PER_M2_K4, Acting, Drive, Stepper, steady

LONGEST_STEP_S = {True: 100.0, False: 50.0}
"""Of days that are long, or short. Halving it moves readings by some thousandths of a kelvin where power switches."""
HOTTEST_K = 15.0
"""What a unit's mean power warms it by above the panel that it stands on, at most."""
LONG_DAY_S = 20_000.0
STRUCTURES = ("decks", "tube", "frame", "stack")


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
    target_K
        About how warm it is.
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
    kind = str(shape.choice(STRUCTURES))
    builder = Builder(shape, stiffness)
    {"decks": _decks, "tube": _tube, "frame": _frame, "stack": _stack}[kind](builder)
    plan = builder.plan
    _couple(builder)
    _sense(builder)
    orbit = draw_orbit(flight)
    sample_s, n_lead, n_samples = _sampling(orbit, flight)
    clock = sample_s * (np.arange(n_lead + n_samples) - n_lead)
    boundaries = {b: _boundary(clock, flight) for b in dict.fromkeys(b for _, b, _ in plan.mounts)}
    sun = _sunlight(plan, orbit, clock, flight)
    power = sun | _payloads(plan, orbit, clock, sum(q.mean() for q in sun.values()), flight)
    for channel in power:
        node = channel[2:]
        plan.inputs[channel] = plan.radiators[node][0] if channel in sun else _load_spot(plan, node)
    mode = _telegraph(clock, (0.0, 1.0, 2.0), float(flight.uniform(0.4, 1.2)) * _scale_s(orbit), flight)
    auxiliary = {"mode": mode} | ({"roll": _roll(orbit, clock, flight)} if flight.random() < 0.6 else {})
    return Spacecraft(kind, plan, orbit, sample_s, n_lead, n_samples, power, auxiliary, boundaries, tuple(sun))


def _decks(b: Builder) -> None:
    """Draw two decks on posts, with units and a battery."""
    b.panel("deck1", radiates=True)
    b.panel("deck2", radiates=True)
    b.post("deck1", "deck2", int(b.rng.integers(4, 7)))
    b.unit("unit1", "deck1")
    b.unit("unit2", "deck2")
    b.massive("battery", "deck1")
    if b.rng.random() < 0.5:
        b.unit("unit3", "deck2")


def _stack(b: Builder) -> None:
    """Draw three decks on posts; the middle one sees no space."""
    for deck, radiates in (("deck1", True), ("deck2", False), ("deck3", True)):
        b.panel(deck, radiates=radiates)
    b.post("deck1", "deck2", 6)
    b.post("deck2", "deck3", int(b.rng.integers(4, 7)))
    b.unit("unit1", "deck2")
    b.massive("tank", "deck1")
    b.unit("unit2", "deck3")


def _tube(b: Builder) -> None:
    """Draw a tube between two decks, a tank inside it, and units on the decks."""
    b.panel("base", radiates=True)
    b.tube("tube")
    b.panel("top", radiates=True)
    middle = ((0.35, 0.65), (0.3, 0.7))
    b.join(("tube", "-3", WHOLE), ("base", "+3", middle), 800.0, 3000.0)
    b.join(("tube", "+3", WHOLE), ("top", "-3", middle), 800.0, 3000.0)
    b.massive("tank", "tube", "-1", ((0.0, 0.3), (0.3, 0.6)))
    b.unit("unit1", "top")
    b.unit("unit2", "base")
    if b.rng.random() < 0.5:
        b.massive("battery", "base")


def _frame(b: Builder) -> None:
    """Draw two panels joined by a bracket, and a third one on edge."""
    b.panel("px", radiates=True)
    b.panel("pz", radiates=True)
    b.panel("shear", radiates=False)
    b.bracket("bracket")
    b.join(("bracket", "-3", WHOLE), ("px", "+3", ((0.45, 0.55), (0.1, 0.9))), 150.0, 600.0)
    b.join(("bracket", "-1", WHOLE), ("pz", "+3", ((0.45, 0.55), (0.1, 0.9))), 150.0, 600.0)
    b.join(("shear", "-1", WHOLE), ("px", "+3", ((0.96, 1.0), (0.0, 1.0))), 1000.0, 4000.0)
    b.unit("unit1", "px")
    b.unit("unit2", "pz")
    b.massive("battery", "shear")


def _couple(b: Builder) -> None:
    """Couple one or two nodes to the bus, and now and then another to a wall."""
    nodes = [n for n in b.plan.groups if n not in b.plan.radiators]
    b.rng.shuffle(nodes)
    b.plan.mounts.append((_edge(nodes[0]), "bus", float(b.rng.uniform(0.3, 1.2))))
    if b.rng.random() < 0.4:
        b.plan.mounts.append((_edge(nodes[1]), "wall", float(b.rng.uniform(0.3, 1.0))))


def _edge(node: str) -> tuple[str, str, tuple[tuple[float, float], tuple[float, float]]]:
    return node, "+3" if node == "tube" else "+1", WHOLE


def _sense(b: Builder) -> None:
    """Put a sensor on every node: near a corner, near the heater, or anywhere."""
    for node, (body, face, window) in b.plan.heater_spots.items():
        where = b.rng.random()
        if where < 0.35:
            at = tuple(float(b.rng.choice([0.08, 0.92])) for _ in range(2))
            face = "+1" if node == "tube" else face
        elif where < 0.6:
            at = tuple(float(b.rng.uniform(low, high)) for low, high in window)
        else:
            at = tuple(float(x) for x in b.rng.uniform(0.15, 0.85, 2))
        b.plan.sensors[f"T_{node}"] = (body, face, (at[0], at[1]))


def _load_spot(plan: Plan, node: str) -> tuple[str, str, tuple[tuple[float, float], tuple[float, float]]]:
    """Return where a payload's heat is made: in the unit's payload, or where its heater is."""
    inner = f"{node}.payload"
    return (inner, "+1", WHOLE) if inner in plan.bodies else plan.heater_spots[node]


def _scale_s(orbit: Orbit) -> float:
    """Return the time in which its days change what it does: an orbit, but a quarter of a day at most."""
    return min(orbit.period_s, 21_600.0)


def _sampling(orbit: Orbit, rng: np.random.Generator) -> tuple[float, int, int]:
    """Return sampling interval, samples before the record and of the record."""
    fastest = orbit.spin_s if orbit.attitude == "spin" else orbit.period_s
    least, most = {True: (20.0, 90.0), False: (20.0, 120.0)}[fastest < 3000.0]
    if orbit.period_s > LONG_DAY_S:
        least, most = 180.0, 300.0
    sample = float(np.exp(rng.uniform(np.log(least), np.log(min(most, fastest / 8.0 if fastest < 3000 else most)))))
    sample = float(np.round(sample / 5.0) * 5.0)
    orbits = {True: rng.uniform(3.5, 6.0), False: rng.uniform(8.0, 13.0)}[orbit.period_s > LONG_DAY_S]
    n = int(np.clip(orbits * orbit.period_s / sample, 800, 1600 if orbit.period_s > LONG_DAY_S else 2400))
    return sample, int(np.ceil(min(1.5 * orbit.period_s, 60_000.0) / sample)), n


def _sunlight(plan: Plan, orbit: Orbit, clock: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return the heat that the sky brings to every radiating face, (n,) in W each."""
    faces = [np.array(n, dtype=float) for n in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1))]
    chosen = rng.permutation(len(faces))
    found = {}
    for i, (node, (spot, emissivity)) in enumerate(plan.radiators.items()):
        area = float(plan.bodies[spot[0]].patch(spot[1], spot[2]).area_m2.sum())
        sun, infrared = orbit.flux_W_per_m2(faces[chosen[i]], clock)
        found[f"S_{node}"] = area * (float(rng.uniform(0.1, 0.3)) * sun + emissivity * infrared)
    return found


def _payloads(
    plan: Plan, orbit: Orbit, clock: np.ndarray, sun_W: float, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Return switching power that keeps the spacecraft about a usual temperature, (n,) in W each."""
    area = sum(e * plan.bodies[s[0]].patch(s[1], s[2]).area_m2.sum() for s, e in plan.radiators.values())
    lost = SIGMA_W_PER_M2_K4 * area * float(rng.uniform(265.0, 295.0)) ** 4
    total = max(lost - sun_W, 0.3 * lost)
    nodes = [n for n in plan.groups if n.startswith("unit")]
    others = [n for n in plan.groups if n not in nodes and n not in plan.radiators]
    nodes += others[: int(rng.integers(0, 2))]
    share = rng.dirichlet(np.full(len(nodes), 4.0))
    found = {}
    for i, (node, part) in enumerate(zip(nodes, share, strict=True)):
        levels = np.sort(rng.uniform(0.1, 2.0, 3))
        dwell = float(rng.uniform(0.15, 0.8)) * _scale_s(orbit)
        series = _telegraph(clock, tuple(levels), dwell, rng)
        if i == 0 and rng.random() < 0.5:  # an instrument that works in sunlight only
            series = np.where(orbit.lit(clock) > 0.5, series, 0.15)
        mean = min(total * part, HOTTEST_K * _way_out_W_per_K(plan, node))
        found[f"P_{node}"] = mean * series / series.mean()
    return {channel: np.round(q, 2) for channel, q in found.items()}


def _way_out_W_per_K(plan: Plan, node: str) -> float:
    """Return the conductance of a node's contacts to others."""
    bodies, total = plan.groups[node], 0.0
    for contact in plan.contacts:
        own = [spot[0] in bodies for spot in contact.spots]
        if own[0] != own[1]:
            body, face, window = contact.spots[0]
            total += contact.conductance_W_per_m2_K * float(plan.bodies[body].patch(face, window).area_m2.sum())
    return total


def _telegraph(clock: np.ndarray, levels: tuple[float, ...], dwell_s: float, rng: np.random.Generator) -> np.ndarray:
    """Return a series that jumps between levels after random times, (n,); every level differs from the last."""
    found, step = np.zeros(clock.size), clock[1] - clock[0]
    place, now = 0, int(rng.integers(0, len(levels)))
    while place < clock.size:
        stay = max(2, int(rng.gamma(3.0, dwell_s / 3.0) / step))
        found[place : place + stay] = levels[now]
        now, place = (now + int(rng.integers(1, len(levels)))) % len(levels), place + stay
    return found


def _boundary(clock: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the temperature of a boundary: a mean, a daily wave, and smooth wandering, (n,) in K."""
    span = clock[-1] - clock[0]
    waves = sum(
        rng.normal() * np.sin(2.0 * np.pi * k * (clock - clock[0]) / span + rng.uniform(0, 2 * np.pi)) / np.sqrt(k)
        for k in range(1, 25)
    )
    return float(rng.uniform(285.0, 298.0)) + float(rng.uniform(0.8, 2.0)) * waves


def _roll(orbit: Orbit, clock: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return an angle in degrees, 0 to 180, that dwells and slews: of an appendage, or of the spacecraft itself."""
    if orbit.slews:
        turn = orbit.turn_rad(clock)
        return np.degrees(np.arccos(np.cos(turn)))
    aims = _telegraph(clock, (0.0, 45.0, 90.0, 135.0, 180.0), float(rng.uniform(0.3, 0.9)) * _scale_s(orbit), rng)
    found, most = aims.copy(), 0.06 * (clock[1] - clock[0])
    for i in range(1, found.size):
        found[i] = found[i - 1] + np.clip(aims[i] - found[i - 1], -most, most)
    return found
