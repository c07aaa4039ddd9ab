"""What the seeded spacecraft hide: one small function per effect, written from the contract's equations alone."""

from collections.abc import Callable

import numpy as np

from benchmarks.network_world import SIGMA, SPACE_K, Heat, Hidden, Switch, World


def _into(world: World, node: int, q: Callable[[float, int, float], float]) -> Heat:
    """Return a heat into one node that depends on its own temperature."""

    def heat(t: float, k: int, x: np.ndarray) -> np.ndarray:
        more = np.zeros(world.n)
        more[node] = q(t, k, x[node])
        return more

    return heat


def _between(world: World, a: int, b: int, q: Callable[[float, int, np.ndarray], float]) -> Heat:
    """Return a heat into node a that leaves node b."""

    def heat(t: float, k: int, x: np.ndarray) -> np.ndarray:
        more = np.zeros(world.n)
        more[a] = q(t, k, x)
        more[b] = -more[a]
        return more

    return heat


def _free_pair(world: World) -> tuple[int, int]:
    """Return a pair of nodes that no conductor joins."""
    pairs = [(a, b) for a in range(world.n) for b in range(a + 1, world.n) if (a, b) not in world.edges]
    return pairs[int(world.rng.integers(0, len(pairs)))]


def radiation_to_sink(world: World, node: int) -> Hidden:
    """Return radiation to space."""
    area = float(world.rng.uniform(0.05, 0.15))
    heat = _into(world, node, lambda t, k, x: SIGMA * area * (SPACE_K**4 - x**4))
    return Hidden({"node": f"n{node}", "sink": "space"}, heat, parameters={"R_m2": area})


def leak_to_boundary(world: World, node: int) -> Hidden:
    """Return a leak to the room."""
    g = float(world.rng.uniform(0.3, 1.5))
    heat = _into(world, node, lambda t, k, x: g * (world.room_K[k] - x))
    return Hidden({"node": f"n{node}", "boundary": "room"}, heat, parameters={"G_W_per_K": g})


def constant_heat_load(world: World, node: int) -> Hidden:
    """Return a constant heat of either sign."""
    q0 = float(world.mean_load_W * world.rng.uniform(0.2, 0.5) * world.rng.choice([-1.0, 1.0]))
    return Hidden({"node": f"n{node}"}, _into(world, node, lambda t, k, x: q0), parameters={"Q_W": q0})


def channel_heat_load(world: World, node: int) -> Hidden:
    """Return a heat per mode."""
    table = world.mean_load_W * world.rng.uniform(0.2, 0.8, 3) * np.array([0.0, 1.0, -0.6])
    heat = _into(world, node, lambda t, k, x: table[int(world.mode[k])])
    levels = {"knots": [0.0, 1.0, 2.0], "values_W": table.tolist()}
    return Hidden({"node": f"n{node}", "channel": "mode"}, heat, parameters=levels)


def proportional_heater(world: World, node: int) -> Hidden:
    """Return a heater that works below the 60 % quantile of the healthy temperatures."""
    gain, limit = float(world.rng.uniform(2.0, 6.0)), world.mean_load_W * float(world.rng.uniform(0.4, 0.9))
    set_point = float(np.quantile(world.simulate()[:, node], 0.6))
    heat = _into(world, node, lambda t, k, x: min(limit, gain * max(set_point - x, 0.0)))
    sizes = {"k_W_per_K": gain, "T_set_K": set_point, "Q_W": limit}
    return Hidden({"node": f"n{node}"}, heat, parameters=sizes)


def input_gain(world: World, node: int) -> Hidden:
    """Return a payload heat that is delivered at another scale."""
    channel = int(world.rng.choice(list(world.power)))
    g = float(world.rng.choice([world.rng.uniform(0.5, 0.8), world.rng.uniform(1.2, 1.5)]))
    heat = _into(world, channel, lambda t, k, x: (g - 1.0) * world.power[channel][k])
    return Hidden({"channel": f"P{channel}"}, heat, parameters={"g": g})


def missing_conductor(world: World, node: int) -> Hidden:
    """Return a strap."""
    a, b = _free_pair(world)
    g = float(world.rng.uniform(0.5, 2.0))
    heat = _between(world, a, b, lambda t, k, x: g * (x[b] - x[a]))
    return Hidden({"nodes": [f"n{a}", f"n{b}"]}, heat, parameters={"G_W_per_K": g})


def hidden_mass(world: World, node: int) -> Hidden:
    """Return a mass behind a conductance."""
    mass = float(world.capacity[node] * world.rng.uniform(0.5, 2.0))
    g = mass / float(world.rng.uniform(0.2, 1.0) * world.period_s)

    def heat(t: float, k: int, x: np.ndarray) -> np.ndarray:
        more = np.zeros(world.n)
        more[node] = g * (x[world.n] - x[node])
        return more

    return Hidden(
        {"node": f"n{node}"},
        heat,
        rates=lambda x: np.array([g * (x[node] - x[world.n]) / mass]),
        n_extra=1,
        parameters={"C_J_per_K": mass, "G_W_per_K": g},
    )


def radiative_exchange(world: World, node: int) -> Hidden:
    """Return two faces that see each other."""
    a, b = _free_pair(world)
    area = float(world.rng.uniform(0.08, 0.35))
    heat = _between(world, a, b, lambda t, k, x: SIGMA * area * (x[b] ** 4 - x[a] ** 4))
    return Hidden({"nodes": [f"n{a}", f"n{b}"]}, heat, parameters={"R_m2": area})


def nonlinear_convection(world: World, node: int) -> Hidden:
    """Return convection to the room."""
    k0, p = float(world.rng.uniform(0.1, 0.5)), float(world.rng.uniform(1.2, 2.0))

    def q(t: float, k: int, x: float) -> float:
        d = world.room_K[k] - x
        return k0 * float(np.sign(d) * abs(d) ** p)

    return Hidden({"node": f"n{node}", "boundary": "room"}, _into(world, node, q), parameters={"k": k0, "p": p})


def periodic_heat_load(world: World, node: int) -> Hidden:
    """Return a heat with a period of its own, between a fifth of an orbit and three orbits."""
    size = float(world.mean_load_W * world.rng.uniform(0.2, 0.6))
    q0, phase = size * float(world.rng.uniform(-0.5, 0.5)), float(world.rng.uniform(0.0, 2.0 * np.pi))
    period_s = world.period_s * float(np.exp(world.rng.uniform(np.log(0.2), np.log(3.0))))
    heat = _into(world, node, lambda t, k, x: q0 + size * float(np.sin(2.0 * np.pi * t / period_s + phase)))
    wave = {"A_W": size * float(np.cos(phase)), "B_W": size * float(np.sin(phase))}
    return Hidden({"node": f"n{node}"}, heat, parameters={"Q_W": q0, **wave, "P_s": period_s})


def thermostat_heater(world: World, node: int) -> Hidden:
    """Return a heater with hysteresis about the colder half of the healthy temperatures."""
    healthy = world.simulate()[:, node]
    low, high = np.quantile(healthy, (0.02, 0.98))
    on_K = float(np.quantile(healthy, world.rng.uniform(0.15, 0.5)))
    off_K = on_K + max(0.5, float(world.rng.uniform(0.1, 0.3)) * (high - low))
    power = world.mean_load_W * float(world.rng.uniform(0.4, 0.9))
    relay = {"on": False}

    def flip() -> None:
        relay["on"] = not relay["on"]

    def crossing(x: np.ndarray) -> float:
        return float(off_K - x[node] if relay["on"] else x[node] - on_K)

    heat = _into(world, node, lambda t, k, x: power * relay["on"])
    sizes = {"Q_W": power, "T_on_K": on_K, "T_off_K": off_K}
    return Hidden({"node": f"n{node}"}, heat, switch=Switch(crossing, flip), parameters=sizes)


def capacity_temperature(world: World, node: int) -> Hidden:
    """Return a capacity that changes by a third to all of itself over the visited range."""
    healthy = world.simulate()[:, node]
    low, high = np.quantile(healthy, (0.02, 0.98))
    kappa = float(world.rng.uniform(0.3, 0.9) * world.rng.choice([-1.0, 1.0]) / (high - low))
    centre = 0.5 * (low + high)

    def capacity(x: np.ndarray) -> np.ndarray:
        more = np.zeros(world.n)
        more[node] = world.capacity[node] * max(kappa * (x[node] - centre), -0.8)
        return more

    sizes = {"kappa_per_K": kappa, "T_ref_K": float(centre)}
    return Hidden({"node": f"n{node}"}, capacity=capacity, parameters=sizes)


def latent_heat(world: World, node: int) -> Hidden:
    """Return a phase change within the visited range."""
    low, high = np.quantile(world.simulate()[:, node], (0.1, 0.9))
    centre, width = float(world.rng.uniform(low, high)), float(world.rng.uniform(0.3, 1.0))
    area = float(world.capacity[node] * world.rng.uniform(0.4, 1.2) * (high - low))

    def capacity(x: np.ndarray) -> np.ndarray:
        more = np.zeros(world.n)
        more[node] = area * np.exp(-0.5 * ((x[node] - centre) / width) ** 2) / (width * np.sqrt(2.0 * np.pi))
        return more

    sizes = {"L_J": area, "T_m_K": centre, "w_K": width}
    return Hidden({"node": f"n{node}"}, capacity=capacity, parameters=sizes)


def _onset_s(world: World) -> float:
    """Return an instant in the first part of the record, seldom a sample's."""
    return float(world.rng.uniform(0.15, 0.6) * world.time_s[-1])


def _fraction(world: World) -> float:
    """Return what is left after a step: nothing, less, or more."""
    return float(world.rng.choice([0.0, world.rng.uniform(0.3, 0.7), world.rng.uniform(1.4, 2.0)]))


def input_step(world: World, node: int) -> Hidden:
    """Return a payload heat that changes at an instant."""
    channel, onset, f = int(world.rng.choice(list(world.power))), _onset_s(world), _fraction(world)
    heat = _into(world, channel, lambda t, k, x: (f - 1.0) * world.power[channel][k] if t >= onset else 0.0)
    return Hidden({"channel": f"P{channel}"}, heat, onset_s=onset, parameters={"f": f, "time": onset})


def input_drift(world: World, node: int) -> Hidden:
    """Return a payload heat that gains or loses up to four fifths over the record."""
    channel = int(world.rng.choice(list(world.power)))
    rate = float(world.rng.uniform(0.4, 0.8) * world.rng.choice([-1.0, 1.0]) / world.time_s[-1])
    heat = _into(world, channel, lambda t, k, x: rate * t * world.power[channel][k])
    return Hidden({"channel": f"P{channel}"}, heat, parameters={"r_per_s": rate})


def _edge(world: World) -> tuple[int, int, float]:
    """Return a declared conductor and its conductance."""
    edge = int(world.rng.integers(0, len(world.edges)))
    return *world.edges[edge], float(world.conductance[edge])


def conductance_step(world: World, node: int) -> Hidden:
    """Return a strap that changes at an instant."""
    (a, b, g), onset, f = _edge(world), _onset_s(world), _fraction(world)
    heat = _between(world, a, b, lambda t, k, x: (f - 1.0) * g * (x[b] - x[a]) if t >= onset else 0.0)
    return Hidden({"nodes": [f"n{a}", f"n{b}"]}, heat, onset_s=onset, parameters={"f": f, "time": onset})


def conductance_temperature(world: World, node: int) -> Hidden:
    """Return a strap that conducts better or worse by one to three per cent per kelvin."""
    a, b, g = _edge(world)
    beta = float(world.rng.uniform(0.01, 0.03) * world.rng.choice([-1.0, 1.0]))
    reference = float(world.simulate()[:, [a, b]].mean())

    def exchange(t: float, k: int, x: np.ndarray) -> float:
        return g * max(beta * (0.5 * (x[a] + x[b]) - reference), -1.0) * (x[b] - x[a])

    sizes = {"beta_per_K": beta, "T_ref_K": reference}
    return Hidden({"nodes": [f"n{a}", f"n{b}"]}, _between(world, a, b, exchange), parameters=sizes)


def emissivity_step(world: World, node: int) -> Hidden:
    """Return a radiator that radiates less or more from an instant on."""
    at = int(world.rng.choice(list(world.radiators)))
    onset, area = _onset_s(world), world.radiators[at]
    f = float(world.rng.choice([world.rng.uniform(0.6, 0.85), world.rng.uniform(1.15, 1.4)]))
    heat = _into(world, at, lambda t, k, x: (f - 1.0) * area * SIGMA * (SPACE_K**4 - x**4) if t >= onset else 0.0)
    sizes = {"f": f, "time": onset}
    return Hidden({"node": f"n{at}", "sink": "space"}, heat, onset_s=onset, parameters=sizes)


def _misread(world: World, node: int, offset_K: np.ndarray, sizes: dict[str, float]) -> Hidden:
    """Return a fault of the sensor of one node."""
    columns = np.zeros((world.time_s.size, world.n))
    columns[:, node] = offset_K
    return Hidden({"sensor": f"T{node}"}, offset_K=columns, onset_s=sizes.get("time"), parameters=sizes)


def sensor_bias(world: World, node: int) -> Hidden:
    """Return a sensor that reads too much or too little from an instant on."""
    onset, b = _onset_s(world), float(world.rng.uniform(0.5, 3.0) * world.rng.choice([-1.0, 1.0]))
    return _misread(world, node, np.where(world.time_s >= onset, b, 0.0), {"b_K": b, "time": onset})


def sensor_drift(world: World, node: int) -> Hidden:
    """Return a sensor that drifts by some kelvins over the record."""
    rate = float(world.rng.uniform(1.0, 4.0) * world.rng.choice([-1.0, 1.0]) / world.time_s[-1])
    return _misread(world, node, rate * world.time_s, {"d_K_per_s": rate})


def sensor_lag(world: World, node: int) -> Hidden:
    """Return a sensor that follows its node with a delay of some minutes."""
    tau_s = float(np.exp(world.rng.uniform(np.log(120.0), np.log(900.0))))

    def rates(x: np.ndarray) -> np.ndarray:
        return np.array([(x[node] - x[world.n]) / tau_s])

    return Hidden({"sensor": f"T{node}"}, rates=rates, n_extra=1, reads={node: world.n}, parameters={"tau_s": tau_s})


def input_power_law(world: World, node: int) -> Hidden:
    """Return a payload that delivers what it declares at one value, anywhere about its range, and another power elsewhere."""
    channel = int(world.rng.choice(list(world.power)))
    declared = world.power[channel]
    n = float(world.rng.choice([world.rng.uniform(0.5, 0.75), world.rng.uniform(1.4, 2.0)]))
    reference = float(declared.max() * np.exp(world.rng.uniform(np.log(0.2), np.log(1.2))))
    more = np.where(declared > 0.0, reference * (declared / reference) ** n - declared, 0.0)
    heat = _into(world, channel, lambda t, k, x: more[k])
    return Hidden({"channel": f"P{channel}"}, heat, parameters={"n": n, "reference": reference})


HIDDEN: dict[str, Callable[[World, int], Hidden]] = {
    make.__name__: make
    for make in (
        radiation_to_sink,
        leak_to_boundary,
        constant_heat_load,
        channel_heat_load,
        proportional_heater,
        input_gain,
        missing_conductor,
        hidden_mass,
        radiative_exchange,
        nonlinear_convection,
        periodic_heat_load,
        thermostat_heater,
        capacity_temperature,
        latent_heat,
        input_step,
        input_drift,
        conductance_step,
        conductance_temperature,
        emissivity_step,
        sensor_bias,
        sensor_drift,
        sensor_lag,
        input_power_law,
    )
}
