"""Heat that no effect of the vocabulary describes: the loop must say so, or call it a learned heat flow."""

from collections.abc import Callable

import numpy as np

from benchmarks.network_world import Hidden, World


def _into(world: World, node: int, q: Callable[[float, int, np.ndarray], float]) -> Hidden:
    def heat(t: float, k: int, x: np.ndarray) -> np.ndarray:
        more = np.zeros(world.n)
        more[node] = q(t, k, x)
        return more

    return Hidden({"node": f"n{node}"}, heat)


def resonance_in_temperature(world: World, node: int) -> Hidden:
    """Return heat that rises and falls with its node's own temperature: repeatable, but of no named form."""
    usual = world.simulate()[:, node]
    centre, width = float(np.median(usual)), float(np.ptp(usual) / 6)
    size = 0.5 * world.mean_load_W
    return _into(world, node, lambda t, k, x: size * np.exp(-0.5 * ((x[node] - centre) / width) ** 2))


def random_telegraph(world: World, node: int) -> Hidden:
    """Return a load that switches at random and is on no channel: not repeatable."""
    n_dwells = world.time_s.size // 23 + 1
    states = np.repeat(world.rng.integers(0, 2, n_dwells), 23)[: world.time_s.size]
    size = 0.5 * world.mean_load_W
    return _into(world, node, lambda t, k, x: size * float(states[k]))


def wandering_heat(world: World, node: int) -> Hidden:
    """Return a heat that wanders as an Ornstein-Uhlenbeck process over about an orbit."""
    keep = np.exp(-60.0 / world.period_s)
    noise = world.rng.normal(0.0, np.sqrt(1 - keep**2), world.time_s.size)
    path = np.zeros(world.time_s.size)
    for k in range(1, path.size):
        path[k] = keep * path[k - 1] + noise[k]
    size = 0.3 * world.mean_load_W
    return _into(world, node, lambda t, k, x: size * float(path[k]))


def one_way_heat(world: World, node: int) -> Hidden:
    """Return heat that follows another node's temperature without cooling it: a controller, not a conductor."""
    other = (node + 1 + int(world.rng.integers(0, world.n - 1))) % world.n
    gain = float(world.rng.uniform(1.0, 3.0))
    usual = float(np.median(world.simulate()[:, other]))
    return _into(world, node, lambda t, k, x: gain * (x[other] - usual))


def product_of_input_and_temperature(world: World, node: int) -> Hidden:
    """Return a loss of a payload's heat that grows with temperature, as of a regulator's efficiency."""
    channel = int(world.rng.choice(list(world.power)))
    usual = float(np.median(world.simulate()[:, channel]))
    slope = float(world.rng.uniform(0.03, 0.06))
    return _into(world, channel, lambda t, k, x: slope * (x[channel] - usual) * world.power[channel][k])


OUTSIDE: dict[str, Callable[[World, int], Hidden]] = {
    make.__name__: make
    for make in (
        resonance_in_temperature,
        random_telegraph,
        wandering_heat,
        one_way_heat,
        product_of_input_and_temperature,
    )
}
