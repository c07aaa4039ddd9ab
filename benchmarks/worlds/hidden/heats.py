"""Heat that comes into a spot on one node, or leaves it for a sink."""

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_matrix

from benchmarks.worlds.hidden.base import Draft, Effect, Scene, free_boundary, heated
from benchmarks.worlds.stepping import SIGMA_W_PER_M2_K4, SPACE_K, Acting, Moment


def radiation_to_sink(s: Scene) -> Draft:
    """Draw a face that sees space."""
    node = s.node()
    spot = s.spot(node)

    def make(area: float) -> Effect:
        row = SIGMA_W_PER_M2_K4 * area * spot
        return heated({"node": node, "sink": "space"}, {"R_m2": area}, lambda m, x: row * (SPACE_K**4 - x**4))

    return Draft(make, 0.02, 0.0, 0.5)


def leak_to_boundary(s: Scene) -> Draft:
    """Draw a leak to a boundary."""
    node, boundary = free_boundary(s)
    spot = s.spot(node)

    def make(g: float) -> Effect:
        acting = Acting(stiffness_W_per_K=csr_matrix(np.diag(g * spot)), to_boundary_W_per_K={boundary: g * spot})
        return Effect({"node": node, "boundary": boundary}, {"G_W_per_K": g}, acting)

    return Draft(make, 0.3, 0.0, 10.0)


def nonlinear_convection(s: Scene) -> Draft:
    """Draw convection to a boundary, point by point."""
    node, boundary = free_boundary(s)
    spot, p = s.spot(node), float(s.rng.uniform(1.25, 2.0))

    def make(k: float) -> Effect:
        def heat(m: Moment, x: np.ndarray) -> np.ndarray:
            gap = m.drive.boundaries_K[boundary][m.step, m.stage] - x
            return k * spot * np.sign(gap) * np.abs(gap) ** p

        return heated({"node": node, "boundary": boundary}, {"k": k, "p": p}, heat)

    return Draft(make, 0.1, 0.0, 2.0)


def constant_heat_load(s: Scene) -> Draft:
    """Draw a constant heat of either sign."""
    node, sign = s.node(), s.sign()
    spot = s.spot(node)
    return Draft(
        lambda q: heated({"node": node}, {"Q_W": sign * q}, lambda m, x: sign * q * spot),
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

        return heated({"node": node}, size, heat)

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
        return heated({"node": node, "channel": channel}, sizes, heat)

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
        return heated({"node": node}, sizes, lambda m, x: q * relay[0] * spot, after=after)

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

        return heated({"node": node}, {"k_W_per_K": gain, "T_set_K": set_K, "Q_W": q}, heat)

    return Draft(make, 0.5 * s.usual_W, 0.0, 4.0 * s.usual_W)


def heat_load_step(s: Scene) -> Draft:
    """Draw a heat that sets in at an instant, and now and then stops again."""
    node, sign, onset = s.node(), s.sign(), s.onset()
    spot = s.spot(node)
    stop = float(s.rng.uniform(onset + 0.1 * s.craft.duration_s, 0.7 * s.craft.duration_s))
    ends = {"stop": stop} if s.rng.random() < 0.3 else {}

    def make(q: float) -> Effect:
        until = ends.get("stop", np.inf)
        sizes = {"Q_W": sign * q, "time": onset, **ends}
        made = heated({"node": node}, sizes, lambda m, x: sign * q * spot, onset_s=onset, stop_s=until)
        return replace(made, onset_s=onset)

    return Draft(make, 0.2 * s.usual_W, 0.0, 4.0 * s.usual_W)


def emissivity_step(s: Scene) -> Draft:
    """Draw a radiator that radiates less or more from an instant on."""
    node, sign, onset = str(s.rng.choice(list(s.craft.plan.radiators))), s.sign(), s.onset()
    area = SIGMA_W_PER_M2_K4 * s.craft.field.radiating_m2[node]

    def make(d: float) -> Effect:
        f = 1.0 + sign * d

        def heat(m: Moment, x: np.ndarray) -> np.ndarray:
            return (f - 1.0) * area * (SPACE_K**4 - x**4)

        where = {"node": node, "sink": "space"}
        return replace(heated(where, {"f": f, "time": onset}, heat, onset_s=onset), onset_s=onset)

    return Draft(make, 0.15, 0.01, 0.6)
