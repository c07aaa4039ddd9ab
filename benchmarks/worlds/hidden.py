"""What a spacecraft of solid bodies can hide: every effect of the vocabulary, acting in the field rather than on lumped nodes.

Heat enters over a spot on a face, radiation and convection act point by point, contacts change as contacts.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix
from scipy.special import ndtr

from benchmarks.worlds.spacecraft import Spacecraft
from benchmarks.worlds.stepping import NOTHING, SIGMA_W_PER_M2_K4, SPACE_K, Acting, Drive, Moment

Change = Callable[[Drive], Drive]
Reading = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(instants, temperatures at the sensors) -> what they read, both (n_steps + 1, n_nodes)."""


@dataclass(frozen=True)
class Effect:
    """One effect at one place with one size."""

    where: dict[str, Any]
    parameters: dict[str, Any]
    acting: Acting = NOTHING
    drive: Change | None = None
    reading: Reading | None = None
    onset_s: float | None = None


@dataclass(frozen=True)
class Draft:
    """An effect at a place, its size still open: ``make(size)`` for sizes between ``least`` and ``most``."""

    make: Callable[[float], Effect]
    first: float
    least: float = 0.0
    most: float = np.inf


@dataclass(frozen=True)
class Scene:
    """What an effect is drawn for: the spacecraft, and its healthy readings, (n_steps + 1, n_nodes)."""

    rng: np.random.Generator
    craft: Spacecraft
    healthy_K: np.ndarray
    usual_W: float = field(init=False)

    def __post_init__(self) -> None:
        """Find a usual heat."""
        object.__setattr__(self, "usual_W", float(np.mean([q.mean() for q in self.craft.power_W.values()])))

    def node(self) -> str:
        """Return any node."""
        return str(self.rng.choice(self.craft.nodes))

    def pair(self, *, joined: bool) -> tuple[str, str]:
        """Return two nodes that are joined, or not."""
        nodes, known = self.craft.nodes, self.craft.field.between
        pairs = [(a, b) for i, a in enumerate(nodes) for b in nodes[i + 1 :] if ((a, b) in known) == joined]
        return pairs[int(self.rng.integers(0, len(pairs)))]

    def quantiles(self, node: str, *levels: float) -> list[float]:
        """Return quantiles of a node's healthy temperature."""
        return [float(q) for q in np.quantile(self.healthy_K[:, self.craft.nodes.index(node)], levels)]

    def sign(self) -> float:
        """Return 1 or -1."""
        return float(self.rng.choice([-1.0, 1.0]))

    def onset(self) -> float:
        """Return an instant in the first part of the record."""
        return float(self.rng.uniform(0.15, 0.5) * self.craft.duration_s)

    def spot(self, node: str) -> np.ndarray:
        """Return where heat comes into a node, (n,); the shares add to one."""
        return self.craft.field.spots[node]


def _heat(where: dict[str, Any], parameters: dict[str, Any], heat: Any, **more: Any) -> Effect:
    return Effect(where, parameters, Acting(heat, **more))


def radiation_to_sink(s: Scene) -> Draft:
    """Draw a face that sees space."""
    node = s.node()
    spot = s.spot(node)

    def make(area: float) -> Effect:
        row = SIGMA_W_PER_M2_K4 * area * spot
        return _heat({"node": node, "sink": "space"}, {"R_m2": area}, lambda m, x: row * (SPACE_K**4 - x**4))

    return Draft(make, 0.02, 0.0, 0.5)


def radiative_exchange(s: Scene) -> Draft:
    """Draw two faces that see each other."""
    a, b = s.pair(joined=False)
    here, there = s.spot(a), s.spot(b)

    def make(area: float) -> Effect:
        def heat(m: Moment, x: np.ndarray) -> np.ndarray:
            fourth = x**4
            flow = here * (there @ fourth - fourth) + there * (here @ fourth - fourth)
            return SIGMA_W_PER_M2_K4 * area * flow

        return _heat({"nodes": [a, b]}, {"R_m2": area}, heat)

    return Draft(make, 0.1, 0.0, 0.6)


def missing_conductor(s: Scene) -> Draft:
    """Draw a strap between two spots."""
    a, b = s.pair(joined=False)
    jump = csr_matrix(s.spot(a) - s.spot(b))

    def make(g: float) -> Effect:
        acting = Acting(stiffness_W_per_K=csr_matrix(g * (jump.T @ jump)))
        return Effect({"nodes": [a, b]}, {"G_W_per_K": g}, acting)

    return Draft(make, 0.5, 0.0, 20.0)


def _free_boundary(s: Scene) -> tuple[str, str]:
    """Return a node and a boundary that no declared coupling joins."""
    known = s.craft.field.conductance_W_per_K
    places = [(n, b) for n in s.craft.nodes for b in s.craft.boundaries_K if (n, b) not in known]
    return places[int(s.rng.integers(0, len(places)))]


def leak_to_boundary(s: Scene) -> Draft:
    """Draw a leak to a boundary."""
    node, boundary = _free_boundary(s)
    spot = s.spot(node)

    def make(g: float) -> Effect:
        acting = Acting(stiffness_W_per_K=csr_matrix(np.diag(g * spot)), to_boundary_W_per_K={boundary: g * spot})
        return Effect({"node": node, "boundary": boundary}, {"G_W_per_K": g}, acting)

    return Draft(make, 0.3, 0.0, 10.0)


def nonlinear_convection(s: Scene) -> Draft:
    """Draw convection to a boundary, point by point."""
    node, boundary = _free_boundary(s)
    spot, p = s.spot(node), float(s.rng.uniform(1.25, 2.0))

    def make(k: float) -> Effect:
        def heat(m: Moment, x: np.ndarray) -> np.ndarray:
            gap = m.drive.boundaries_K[boundary][m.step, m.stage] - x
            return k * spot * np.sign(gap) * np.abs(gap) ** p

        return _heat({"node": node, "boundary": boundary}, {"k": k, "p": p}, heat)

    return Draft(make, 0.1, 0.0, 2.0)


def constant_heat_load(s: Scene) -> Draft:
    """Draw a constant heat of either sign."""
    node, sign = s.node(), s.sign()
    spot = s.spot(node)
    return Draft(
        lambda q: _heat({"node": node}, {"Q_W": sign * q}, lambda m, x: sign * q * spot),
        0.2 * s.usual_W,
        0.0,
        4.0 * s.usual_W,
    )


def periodic_heat_load(s: Scene) -> Draft:
    """Draw a heat with a period of its own, between a fifth of an orbit and three orbits."""
    node = s.node()
    spot, phase, mean = s.spot(node), float(s.rng.uniform(0, 2 * np.pi)), float(s.rng.uniform(-0.5, 0.5))
    shortest = max(0.2 * s.craft.orbit.period_s, 12.0 * s.craft.sample_s)
    period = float(np.exp(s.rng.uniform(np.log(shortest), np.log(min(3 * s.craft.orbit.period_s, 90_000.0)))))

    def make(q: float) -> Effect:
        size = {"Q_W": mean * q, "A_W": q * float(np.cos(phase)), "B_W": q * float(np.sin(phase)), "P_s": period}

        def heat(m: Moment, x: np.ndarray) -> np.ndarray:
            return (mean + float(np.sin(2 * np.pi * m.time_s / period + phase))) * q * spot

        return _heat({"node": node}, size, heat)

    return Draft(make, 0.3 * s.usual_W, 0.0, 4.0 * s.usual_W)


def channel_heat_load(s: Scene) -> Draft:
    """Draw a heat by mode, or as a curve over an angle."""
    node, channel = s.node(), str(s.rng.choice(list(s.craft.auxiliary)))
    spot = s.spot(node)
    if channel == "mode":
        knots, shape = [0.0, 1.0, 2.0], np.array([0.0, 1.0, float(s.rng.uniform(-0.6, 0.6))])
    else:
        knots = [0.0, 60.0, 120.0, 180.0]
        shape = np.array([0.0, float(s.rng.uniform(0.5, 1.0)), 1.0, float(s.rng.uniform(0.0, 0.4))])

    def make(q: float) -> Effect:
        def heat(m: Moment, x: np.ndarray) -> np.ndarray:
            return float(np.interp(m.drive.auxiliary[channel][m.step, m.stage], knots, q * shape)) * spot

        sizes = {"knots": knots, "values_W": (q * shape).tolist()}
        return _heat({"node": node, "channel": channel}, sizes, heat)

    return Draft(make, 0.3 * s.usual_W, 0.0, 4.0 * s.usual_W)


def thermostat_heater(s: Scene) -> Draft:
    """Draw a heater with hysteresis whose controller looks at the mean over its spot now and again."""
    node = s.node()
    spot = s.spot(node)
    look_s = s.craft.sample_s * s.craft.refined / s.craft.per_sample
    on_K = s.quantiles(node, float(s.rng.uniform(0.25, 0.6)))[0]
    low, high = s.quantiles(node, 0.02, 0.98)
    off_K = on_K + max(0.5, float(s.rng.uniform(0.1, 0.3)) * (high - low))

    def make(q: float) -> Effect:
        relay = [False]

        def after(time_s: float, x: np.ndarray) -> None:
            if abs(time_s / look_s - round(time_s / look_s)) > 1e-6:
                return
            here = float(spot @ x)
            relay[0] = here < on_K or (relay[0] and here < off_K)

        sizes = {"Q_W": q, "T_on_K": on_K, "T_off_K": off_K}
        return _heat({"node": node}, sizes, lambda m, x: q * relay[0] * spot, after=after)

    return Draft(make, 0.5 * s.usual_W, 0.0, 4.0 * s.usual_W)


def proportional_heater(s: Scene) -> Draft:
    """Draw a heater that works below a set point, up to its limit."""
    node = s.node()
    spot, set_K = s.spot(node), s.quantiles(node, float(s.rng.uniform(0.4, 0.7)))[0]
    low, high = s.quantiles(node, 0.02, 0.98)
    band = float(s.rng.uniform(0.2, 0.7)) * (high - low)

    def make(q: float) -> Effect:
        gain = q / band

        def heat(m: Moment, x: np.ndarray) -> np.ndarray:
            return float(np.clip(gain * (set_K - spot @ x), 0.0, q)) * spot

        return _heat({"node": node}, {"k_W_per_K": gain, "T_set_K": set_K, "Q_W": q}, heat)

    return Draft(make, 0.5 * s.usual_W, 0.0, 4.0 * s.usual_W)


def _fed(channel: str, factor: Callable[[Drive], np.ndarray]) -> Change:
    """Return a change of what one channel delivers, by a factor per step and stage."""

    def change(drive: Drive) -> Drive:
        return replace(drive, inputs_W={**drive.inputs_W, channel: factor(drive) * drive.inputs_W[channel]})

    return change


def _channel(s: Scene) -> str:
    return str(s.rng.choice(list(s.craft.power_W)))


def input_gain(s: Scene) -> Draft:
    """Draw an input that delivers more or less than is declared."""
    channel, sign = _channel(s), s.sign()

    def make(d: float) -> Effect:
        return Effect({"channel": channel}, {"g": 1 + sign * d}, drive=_fed(channel, lambda x: np.array(1 + sign * d)))

    return Draft(make, 0.3, 0.02, 0.9)


def input_power_law(s: Scene) -> Draft:
    """Draw an input that delivers a power of what is declared."""
    channel, sign = str(s.rng.choice([c for c in s.craft.power_W if c not in s.craft.sunlit])), s.sign()
    reference = float(s.craft.power_W[channel].max() * np.exp(s.rng.uniform(np.log(0.3), 0.0)))

    def make(d: float) -> Effect:
        n = float(np.exp(sign * d))

        def factor(drive: Drive) -> np.ndarray:
            return np.asarray(np.maximum(drive.inputs_W[channel], 1e-9) / reference) ** (n - 1.0)

        return Effect({"channel": channel}, {"n": n, "reference": reference}, drive=_fed(channel, factor))

    return Draft(make, 0.3, 0.05, 0.8)


def _share_after(drive: Drive, onset_s: float) -> np.ndarray:
    """Return the share of every step that lies after an instant, (n_steps, 1)."""
    return np.clip((drive.ends_s[1:] - onset_s) / drive.step_s, 0.0, 1.0)[:, None]


def input_step(s: Scene) -> Draft:
    """Draw an input that changes at an instant: it dies, falls or rises."""
    channel, sign, onset = _channel(s), s.sign(), s.onset()

    def make(d: float) -> Effect:
        f = 1.0 + sign * d
        change = _fed(channel, lambda drive: 1.0 + (f - 1.0) * _share_after(drive, onset))
        return Effect({"channel": channel}, {"f": f, "time": onset}, drive=change, onset_s=onset)

    return Draft(make, 0.4, 0.02, 1.0)


def input_drift(s: Scene) -> Draft:
    """Draw an input that drifts over the record."""
    channel, sign, duration = _channel(s), s.sign(), s.craft.duration_s

    def make(d: float) -> Effect:
        rate = sign * d / duration
        change = _fed(channel, lambda drive: 1.0 + rate * np.maximum(drive.stages_s, 0.0))
        return Effect({"channel": channel}, {"r_per_s": rate}, drive=change)

    return Draft(make, 0.5, 0.05, 0.95)


def conductance_step(s: Scene) -> Draft:
    """Draw a contact that changes at an instant."""
    (a, b), sign, onset = s.pair(joined=True), s.sign(), s.onset()
    own = s.craft.field.between[a, b]

    def make(d: float) -> Effect:
        f = float(np.exp(sign * d))
        acting = Acting(stiffness_W_per_K=csr_matrix((f - 1.0) * own), onset_s=onset)
        return Effect({"nodes": [a, b]}, {"f": f, "time": onset}, acting, onset_s=onset)

    return Draft(make, 0.7, 0.1, 2.5)


def conductance_temperature(s: Scene) -> Draft:
    """Draw a contact that conducts better or worse when it is warm."""
    (a, b), sign = s.pair(joined=True), s.sign()
    own, shares = s.craft.field.between[a, b], s.craft.field.shares
    mean = 0.5 * (shares[a] + shares[b])
    reference = float(np.mean([s.quantiles(n, 0.5)[0] for n in (a, b)]))

    def make(beta: float) -> Effect:
        def heat(m: Moment, x: np.ndarray) -> np.ndarray:
            return -max(sign * beta * float(mean @ x - reference), -0.9) * (own @ x)

        return _heat({"nodes": [a, b]}, {"beta_per_K": sign * beta, "T_ref_K": reference}, heat)

    return Draft(make, 0.02, 0.004, 0.06)


def capacity_temperature(s: Scene) -> Draft:
    """Draw a capacity that changes with temperature."""
    node, sign = s.node(), s.sign()
    own = s.craft.field.shares[node] * s.craft.field.node_capacity_J_per_K[node]
    low, high = s.quantiles(node, 0.0, 1.0)
    reference, reach = 0.5 * (low + high), 0.5 * (high - low) + 3.0

    def make(kappa: float) -> Effect:
        k = sign * kappa
        acting = Acting(
            stored_J=lambda x: 0.5 * k * own * (x[: own.size] - reference) ** 2,
            slope_J_per_K=lambda x: k * own * (x[: own.size] - reference),
        )
        return Effect({"node": node}, {"kappa_per_K": k, "T_ref_K": reference}, acting)

    return Draft(make, 0.3 / reach, 0.03 / reach, 0.8 / reach)


def latent_heat(s: Scene) -> Draft:
    """Draw a phase change within the visited range, spread over the node."""
    node = s.node()
    share, capacity = s.craft.field.shares[node], s.craft.field.node_capacity_J_per_K[node]
    low, high = s.quantiles(node, 0.15, 0.85)
    centre, width = float(s.rng.uniform(low, high)), float(s.rng.uniform(0.4, 1.5))

    def make(per_capacity_K: float) -> Effect:
        size = per_capacity_K * capacity
        acting = Acting(
            stored_J=lambda x: size * share * ndtr((x - centre) / width),
            slope_J_per_K=lambda x: (
                size * share * np.exp(-0.5 * ((x - centre) / width) ** 2) / (width * np.sqrt(2 * np.pi))
            ),
        )
        return Effect({"node": node}, {"L_J": size, "T_m_K": centre, "w_K": width}, acting)

    return Draft(make, 0.4 * (high - low), 0.1, 60.0)


def emissivity_step(s: Scene) -> Draft:
    """Draw a radiator that radiates less or more from an instant on."""
    node, sign, onset = str(s.rng.choice(list(s.craft.plan.radiators))), s.sign(), s.onset()
    area = SIGMA_W_PER_M2_K4 * s.craft.field.radiating_m2[node]

    def make(d: float) -> Effect:
        f = 1.0 + sign * d

        def heat(m: Moment, x: np.ndarray) -> np.ndarray:
            return (f - 1.0) * area * (SPACE_K**4 - x**4)

        where = {"node": node, "sink": "space"}
        return replace(_heat(where, {"f": f, "time": onset}, heat, onset_s=onset), onset_s=onset)

    return Draft(make, 0.15, 0.01, 0.6)


def hidden_mass(s: Scene) -> Draft:
    """Draw a mass behind a spot that nobody declared."""
    node = s.node()
    spot, capacity = s.spot(node), s.craft.field.node_capacity_J_per_K[node]
    lag_s = max(float(s.rng.uniform(0.15, 0.8)) * min(s.craft.orbit.period_s, 10_000.0), 6.0 * s.craft.sample_s)

    def make(ratio: float) -> Effect:
        mass, g = ratio * capacity, ratio * capacity / lag_s
        jump = csr_matrix(np.concatenate([spot, [-1.0]]))
        acting = Acting(stiffness_W_per_K=csr_matrix(g * (jump.T @ jump)), mass_J_per_K=mass)
        return Effect({"node": node}, {"C_J_per_K": mass, "G_W_per_K": g}, acting)

    return Draft(make, 0.8, 0.2, 2.5)


def heat_load_step(s: Scene) -> Draft:
    """Draw a heat that sets in at an instant, and now and then stops again."""
    node, sign, onset = s.node(), s.sign(), s.onset()
    spot = s.spot(node)
    stop = float(s.rng.uniform(onset + 0.1 * s.craft.duration_s, 0.7 * s.craft.duration_s))
    ends = {"stop": stop} if s.rng.random() < 0.3 else {}

    def make(q: float) -> Effect:
        until = ends.get("stop", np.inf)
        sizes = {"Q_W": sign * q, "time": onset, **ends}
        made = _heat({"node": node}, sizes, lambda m, x: sign * q * spot, onset_s=onset, stop_s=until)
        return replace(made, onset_s=onset)

    return Draft(make, 0.2 * s.usual_W, 0.0, 4.0 * s.usual_W)


def _sink(boundary: str, change: Callable[[Drive, np.ndarray], np.ndarray]) -> Change:
    def changed(drive: Drive) -> Drive:
        given = drive.boundaries_K[boundary]
        return replace(drive, boundaries_K={**drive.boundaries_K, boundary: change(drive, given)})

    return changed


def _boundary(s: Scene) -> str:
    return str(s.rng.choice(list(s.craft.boundaries_K)))


def boundary_offset(s: Scene) -> Draft:
    """Draw a boundary whose channel reads too high or too low."""
    boundary, sign = _boundary(s), s.sign()

    def make(b: float) -> Effect:
        drive = _sink(boundary, lambda _, given: given + sign * b)
        return Effect({"boundary": boundary}, {"b_K": sign * b}, drive=drive)

    return Draft(make, 3.0, 0.3, 25.0)


def boundary_lag(s: Scene) -> Draft:
    """Draw a boundary that follows its channel with a delay."""
    boundary = _boundary(s)

    def make(tau_s: float) -> Effect:
        return Effect(
            {"boundary": boundary}, {"tau_s": tau_s}, drive=_sink(boundary, lambda d, g: _lagged(d, g, tau_s))
        )

    scale = s.craft.duration_s
    return Draft(make, 0.02 * scale, 3.0 * s.craft.sample_s, 0.1 * scale)


def _lagged(drive: Drive, given: np.ndarray, tau_s: float) -> np.ndarray:
    """Return a first-order lag of a series at the stages, (n_steps, 2), exact for straight lines from end to end."""
    ends = np.concatenate([given[:1, 0], given[:, 1]])
    lagged = lag_exact(ends, drive.step_s, tau_s)
    times = drive.ends_s
    return np.interp(drive.stages_s, times, lagged)


def lag_exact(series: np.ndarray, step_s: float, tau_s: float) -> np.ndarray:
    """Return the first-order lag of a series that is straight between its samples, (n,)."""
    keep = np.exp(-step_s / tau_s)
    late = tau_s / step_s * (1.0 - keep)
    found = series.astype(float).copy()
    for i in range(1, series.size):
        found[i] = keep * found[i - 1] + (late - keep) * series[i - 1] + (1.0 - late) * series[i]
    return found


def boundary_mix(s: Scene) -> Draft:
    """Draw a boundary that its channel describes only in part, or not at all."""
    boundary = _boundary(s)
    usual = float(np.mean(s.craft.boundaries_K[boundary]))
    other = usual + float(s.rng.uniform(-8.0, 8.0))

    def make(share: float) -> Effect:
        alpha = 1.0 - share
        drive = _sink(boundary, lambda _, given: alpha * given + share * other)
        return Effect({"boundary": boundary}, {"alpha": alpha, "T_w_K": other}, drive=drive)

    return Draft(make, 0.6, 0.2, 1.0)


def _read(s: Scene, name: str, change: Callable[[np.ndarray, np.ndarray], np.ndarray], **more: Any) -> Effect:
    """Return a fault of one sensor: (instants, its column) -> what it reads."""
    column = s.craft.nodes.index(name)

    def reading(times: np.ndarray, seen: np.ndarray) -> np.ndarray:
        found = seen.copy()
        found[:, column] = change(times, seen[:, column])
        return found

    return Effect({"sensor": f"T_{name}"}, reading=reading, **more)


def sensor_bias(s: Scene) -> Draft:
    """Draw a sensor that reads too much or too little from an instant on."""
    node, sign, onset = s.node(), s.sign(), s.onset()

    def make(b: float) -> Effect:
        sizes = {"b_K": sign * b, "time": onset}
        return _read(s, node, lambda t, x: x + sign * b * (t >= onset), parameters=sizes, onset_s=onset)

    return Draft(make, 1.0)


def sensor_drift(s: Scene) -> Draft:
    """Draw a sensor that drifts over the record."""
    node, sign, duration = s.node(), s.sign(), s.craft.duration_s

    def make(d: float) -> Effect:
        rate = sign * d / duration
        return _read(s, node, lambda t, x: x + rate * t, parameters={"d_K_per_s": rate})

    return Draft(make, 2.0)


def sensor_lag(s: Scene) -> Draft:
    """Draw a sensor that follows its node with a delay."""
    node = s.node()

    def make(tau_s: float) -> Effect:
        return _read(s, node, lambda t, x: lag_exact(x, float(t[1] - t[0]), tau_s), parameters={"tau_s": tau_s})

    return Draft(make, 500.0, 2.0 * s.craft.sample_s, 3600.0)


EFFECTS: dict[str, Callable[[Scene], Draft]] = {
    draw.__name__: draw
    for draw in (
        radiation_to_sink,
        radiative_exchange,
        missing_conductor,
        leak_to_boundary,
        nonlinear_convection,
        constant_heat_load,
        periodic_heat_load,
        channel_heat_load,
        thermostat_heater,
        proportional_heater,
        input_gain,
        input_power_law,
        input_step,
        input_drift,
        conductance_step,
        conductance_temperature,
        capacity_temperature,
        latent_heat,
        emissivity_step,
        hidden_mass,
        heat_load_step,
        boundary_offset,
        boundary_lag,
        boundary_mix,
        sensor_bias,
        sensor_drift,
        sensor_lag,
    )
}
"""Effect -> draws its place from a scene."""
