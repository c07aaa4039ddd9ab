"""Several hidden effects of a network as one, how far apart they are, and paths that wander."""

from collections.abc import Sequence

import numpy as np

from benchmarks.network_world import Hidden, World


def together(world: World, hidden: Sequence[Hidden]) -> Hidden:
    """Return several effects as one. At most one of them may have a relay."""
    firsts = world.n + np.concatenate([[0], np.cumsum([one.n_extra for one in hidden])]).astype(int)

    def view(i: int, x: np.ndarray) -> np.ndarray:
        """Return the states as one of the effects knows them."""
        return np.concatenate([x[: world.n], x[firsts[i] : firsts[i + 1]]])

    def heat(t: float, k: int, x: np.ndarray) -> np.ndarray:
        flows = [one.heat(t, k, view(i, x)) for i, one in enumerate(hidden) if one.heat is not None]
        return np.sum(flows, axis=0) if flows else np.zeros(world.n)

    def capacity(x: np.ndarray) -> np.ndarray:
        more = [one.capacity(view(i, x)) for i, one in enumerate(hidden) if one.capacity is not None]
        return np.sum(more, axis=0) if more else np.zeros(world.n)

    def rates(x: np.ndarray) -> np.ndarray:
        return np.concatenate([one.rates(view(i, x)) for i, one in enumerate(hidden) if one.rates is not None])

    offsets = [one.offset_K for one in hidden if one.offset_K is not None]
    return Hidden(
        {},
        heat,
        capacity if any(one.capacity is not None for one in hidden) else None,
        rates if any(one.rates is not None for one in hidden) else None,
        int(firsts[-1]) - world.n,
        next((one.switch for one in hidden if one.switch is not None), None),
        np.sum(offsets, axis=0) if offsets else None,
        {at: state - world.n + int(firsts[i]) for i, one in enumerate(hidden) for at, state in one.reads.items()},
    )


def distance(world: World, here: Sequence[int], there: Sequence[int]) -> int:
    """Return how many conductors lie between the closest of two sets of nodes."""
    reached, steps = set(here), 0
    while not reached & set(there):
        reached |= {b if a in reached else a for a, b in world.edges if (a in reached) != (b in reached)}
        steps += 1
    return steps


def wandering(world: World, rng: np.random.Generator, length_s: float) -> np.ndarray:
    """Return a smooth path that wanders over some orbits, (n_times,): an integrated Ornstein-Uhlenbeck process, unit rms."""
    keep = np.exp(-(world.time_s[1] - world.time_s[0]) / length_s)
    path = np.zeros((2, world.time_s.size))
    for k, kick in enumerate(rng.normal(size=world.time_s.size - 1), start=1):
        path[0, k] = keep * path[0, k - 1] + kick
        path[1, k] = keep * path[1, k - 1] + (1.0 - keep) * path[0, k]
    return path[1] / np.sqrt(np.mean(path[1] ** 2))
