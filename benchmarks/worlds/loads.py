"""What drives a spacecraft: sunlight, payloads, boundaries, modes and angles, and how often all that is sampled."""

import numpy as np

from benchmarks.worlds.body import WHOLE
from benchmarks.worlds.field import Plan, Spot
from benchmarks.worlds.orbits import Orbit
from benchmarks.worlds.stepping import SIGMA_W_PER_M2_K4

HOTTEST_K = 15.0
"""What a unit's mean power warms it by above the panel that it stands on, at most."""
LONG_DAY_S = 20_000.0
"""Orbits longer than this are sampled seldom and for fewer of them."""


def scale_s(orbit: Orbit) -> float:
    """Return the time in which its days change what it does: an orbit, but a quarter of a day at most."""
    return min(orbit.period_s, 21_600.0)


def sampling(orbit: Orbit, rng: np.random.Generator) -> tuple[float, int, int]:
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


def sunlight(plan: Plan, orbit: Orbit, clock: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return the heat that the sky brings to every radiating face, (n,) in W each."""
    faces = [np.array(n, dtype=float) for n in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1))]
    chosen = rng.permutation(len(faces))
    found = {}
    for i, (node, (spot, emissivity)) in enumerate(plan.radiators.items()):
        area = float(plan.bodies[spot[0]].patch(spot[1], spot[2]).area_m2.sum())
        sun, infrared = orbit.flux_W_per_m2(faces[chosen[i]], clock)
        found[f"S_{node}"] = area * (float(rng.uniform(0.1, 0.3)) * sun + emissivity * infrared)
    return found


def payloads(
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
        dwell = float(rng.uniform(0.15, 0.8)) * scale_s(orbit)
        series = telegraph(clock, tuple(levels), dwell, rng)
        if i == 0 and rng.random() < 0.5:  # an instrument that works in sunlight only
            series = np.where(orbit.lit(clock) > 0.5, series, 0.15)
        mean = min(total * part, HOTTEST_K * _way_out_W_per_K(plan, node))
        found[f"P_{node}"] = mean * series / series.mean()
    return {channel: np.round(q, 2) for channel, q in found.items()}


def load_spot(plan: Plan, node: str) -> Spot:
    """Return where a payload's heat is made: in the unit's payload, or where its heater is."""
    inner = f"{node}.payload"
    return (inner, "+1", WHOLE) if inner in plan.bodies else plan.heater_spots[node]


def _way_out_W_per_K(plan: Plan, node: str) -> float:
    """Return the conductance of a node's contacts to others."""
    bodies, total = plan.groups[node], 0.0
    for contact in plan.contacts:
        own = [spot[0] in bodies for spot in contact.spots]
        if own[0] != own[1]:
            body, face, window = contact.spots[0]
            total += contact.conductance_W_per_m2_K * float(plan.bodies[body].patch(face, window).area_m2.sum())
    return total


def telegraph(clock: np.ndarray, levels: tuple[float, ...], dwell_s: float, rng: np.random.Generator) -> np.ndarray:
    """Return a series that jumps between levels after random times, (n,); every level differs from the last."""
    found, step = np.zeros(clock.size), clock[1] - clock[0]
    place, now = 0, int(rng.integers(0, len(levels)))
    while place < clock.size:
        stay = max(2, int(rng.gamma(3.0, dwell_s / 3.0) / step))
        found[place : place + stay] = levels[now]
        now, place = (now + int(rng.integers(1, len(levels)))) % len(levels), place + stay
    return found


def boundary(clock: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the temperature of a boundary: a mean, a daily wave, and smooth wandering, (n,) in K."""
    span = clock[-1] - clock[0]
    waves = sum(
        rng.normal() * np.sin(2.0 * np.pi * k * (clock - clock[0]) / span + rng.uniform(0, 2 * np.pi)) / np.sqrt(k)
        for k in range(1, 25)
    )
    return float(rng.uniform(285.0, 298.0)) + float(rng.uniform(0.8, 2.0)) * waves


def roll(orbit: Orbit, clock: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return an angle in degrees, 0 to 180, that dwells and slews: of an appendage, or of the spacecraft itself."""
    if orbit.slews:
        turn = orbit.turn_rad(clock)
        return np.degrees(np.arccos(np.cos(turn)))
    aims = telegraph(clock, (0.0, 45.0, 90.0, 135.0, 180.0), float(rng.uniform(0.3, 0.9)) * scale_s(orbit), rng)
    found, most = aims.copy(), 0.06 * (clock[1] - clock[0])
    for i in range(1, found.size):
        found[i] = found[i - 1] + np.clip(aims[i] - found[i - 1], -most, most)
    return found
