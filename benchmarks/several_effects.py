"""Seeded networks with two and three undeclared effects, near each other and far apart, and with drifts that nobody can name."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from benchmarks.case import Case, Truth, trace_of
from benchmarks.combined_effects import distance, together, wandering
from benchmarks.declared_fit import DeclaredFit, calibrated, correlation
from benchmarks.hidden_effects import HIDDEN
from benchmarks.network_cases import declared, inputs
from benchmarks.network_world import Hidden, World
from twin_core.telemetry import Record

KINDS = ("neighbours", "distant", "sensor_and_heat", "beside_drift", "thirty_nodes")
"""Of a case by its seed: places next to each other, places two conductors apart or more, a sensor's fault and a heat, effects
beside a drift that has no name (which takes the place of one), and any in a network of thirty nodes of which twenty are read."""

LEAST_TRACE = 2.0
MOST_TRACE = 100.0
MOST_UNEQUAL = 5.0
"""Trace of the largest effect over that of the smallest."""
MOST_ALIKE = 0.98
"""Correlation of two effects' responses, beyond what declared parameters imitate, above which sensors cannot tell them."""
MOST_DRAWS = 60


@dataclass(frozen=True)
class Drawn:
    """One effect that could be hidden: what it is, and what it alone does to the sensors."""

    effect: str
    hidden: Hidden
    moved_K: np.ndarray
    beyond_K: np.ndarray
    truth: Truth

    @property
    def nodes(self) -> tuple[int, ...]:
        """Where it is."""
        places = {k: v for k, v in self.hidden.where.items() if k not in ("sink", "boundary")}
        places = {k: v for k, v in places.items() if k != "channel" or "node" not in places}
        return tuple(int(name[1:]) for value in places.values() for name in np.ravel(value))


@dataclass(frozen=True)
class Scene:
    """A network and its sensors, before anything is hidden.

    Attributes
    ----------
    world
        The network.
    start
        State of its generator from which every simulation starts, so that they differ in what is hidden alone.
    healthy_K : (n_times, n_nodes)
        Temperatures without effects.
    read
        Nodes that have sensors.
    noise_K
        Their noise.
    fit
        The declared network calibrated to the healthy record.
    """

    world: World
    start: Any
    healthy_K: np.ndarray
    read: tuple[int, ...]
    noise_K: float
    fit: DeclaredFit

    def states(self, hidden: Hidden) -> np.ndarray:
        """Return what happens with an effect, (n_times, n_nodes + extra)."""
        self.world.rng.bit_generator.state = self.start
        return self.world.simulate(hidden)

    def readings(self, hidden: Hidden) -> tuple[np.ndarray, np.ndarray]:
        """Return the temperatures and what sensors would read, without noise, (n_times, n_nodes) each."""
        states = self.states(hidden)
        truth = states[:, : self.world.n]
        seen = truth.copy() if hidden.offset_K is None else truth + hidden.offset_K
        for at, state in hidden.reads.items():
            seen[:, at] = states[:, state]
        return truth, seen

    def drawn(self, effect: str, hidden: Hidden) -> Drawn:
        """Return an effect with what it alone does."""
        moved = (self.readings(hidden)[1] - self.healthy_K)[:, list(self.read)]
        beyond = self.fit.beyond(moved)
        left = float(np.sqrt(np.mean(beyond**2))) / self.noise_K
        trace = trace_of(moved, self.noise_K)
        truth = Truth(effect, hidden.where, hidden.parameters, hidden.onset_s, trace, left)
        return Drawn(effect, hidden, moved, beyond, truth)


def kind_of(seed: int) -> str:
    """Return which of ``KINDS`` the cases of a seed are."""
    return KINDS[seed % len(KINDS)]


def several_case(n_effects: int, seed: int) -> Case:
    """Return a seeded case with two or three effects; its kind follows from the seed, as ``KINDS`` tells.

    Raises
    ------
    ArithmeticError
        If no network of the seed has room for such a case.
    """
    kind = kind_of(seed)
    for attempt in range(6):
        rng = np.random.default_rng([seed, 79 + n_effects, attempt])
        scene = _scene(kind, rng)
        found = _find(scene, kind, n_effects - (kind == "beside_drift"), rng)
        if found is not None:
            return _telemetry(scene, kind, found, rng, seed)
    raise ArithmeticError(f"seed {seed}: no {n_effects} effects of kind {kind} can be told apart")


def _scene(kind: str, rng: np.random.Generator) -> Scene:
    """Return a network with some of its nodes read."""
    n = 30 if kind == "thirty_nodes" else int(rng.integers(6, 10))
    world = World(rng, int(rng.integers(8, 13)), float(rng.choice([45.0, 60.0, 90.0])), n)
    begun = rng.bit_generator.state
    healthy = world.simulate()[:, : world.n]
    n_unread = 10 if n == 30 else int(rng.random() < 0.3)
    unread = rng.choice(world.n, n_unread, replace=False).tolist()
    noise = float(rng.uniform(0.05, 0.15))
    spec = declared(world, world.capacity.tolist(), world.conductance.tolist(), unread, "several")
    values = _driving(world) | {f"T{i}": healthy[:, i] + rng.normal(0, noise, len(healthy)) for i in range(world.n)}
    read = tuple(i for i in range(world.n) if i not in unread)
    return Scene(world, begun, healthy, read, noise, calibrated(spec, Record(world.time_s, values)))


def _driving(world: World) -> dict[str, np.ndarray]:
    return {"T_room": world.room_K, "mode": world.mode} | inputs(world)


def _find(scene: Scene, kind: str, n_effects: int, rng: np.random.Generator) -> list[Drawn] | None:
    """Draw effects until some of them make a case of the kind."""
    pool: list[Drawn] = []
    for new in _draws(scene, rng):
        others = [list(group) for group in combinations(pool, n_effects - 1)]
        rng.shuffle(others)
        for group in ([new, *other] for other in others):
            if _fits(scene, kind, group):
                return group
        pool.append(new)
    return None


def _draws(scene: Scene, rng: np.random.Generator) -> Iterator[Drawn]:
    """Yield effects that the sensors notice."""
    world = scene.world
    for _ in range(MOST_DRAWS):
        effect, node = str(rng.choice(list(HIDDEN))), int(rng.choice(scene.read))
        world.rng = np.random.default_rng(rng.integers(0, 2**63))
        hidden = HIDDEN[effect](world, node)
        drawn = scene.drawn(effect, hidden)
        if drawn.truth.trace_beyond >= LEAST_TRACE and drawn.truth.trace <= MOST_TRACE:
            yield drawn


def _fits(scene: Scene, kind: str, group: Sequence[Drawn]) -> bool:
    """Return whether effects make a case of the kind, are of the same order, and can be told apart."""
    traces = [one.truth.trace for one in group]
    if max(traces) > MOST_UNEQUAL * min(traces) or sum(one.hidden.switch is not None for one in group) > 1:
        return False
    if kind == "sensor_and_heat" and len({one.effect.startswith("sensor") for one in group}) == 1:
        return False
    apart = [distance(scene.world, a.nodes, b.nodes) for a, b in combinations(group, 2)]
    if (kind == "neighbours" and max(apart) > 1) or (kind == "distant" and min(apart) < 2):
        return False
    if len({(one.effect, str(one.hidden.where)) for one in group}) < len(group):
        return False
    return all(correlation(a.beyond_K, b.beyond_K) <= MOST_ALIKE for a, b in combinations(group, 2))


def _drift(scene: Scene, target: float, rng: np.random.Generator) -> tuple[Hidden, dict[str, Any]]:
    """Return a drift with about such a trace beyond the declared parameters: a wandering heat, or a wandering conductance."""
    world = scene.world
    path = wandering(world, rng, float(rng.uniform(0.5, 2.0)) * world.period_s)
    edge, node = int(rng.integers(0, len(world.edges))), int(rng.integers(0, world.n))
    (a, b), is_heat = world.edges[edge], rng.random() < 0.6

    def hidden(size: float) -> Hidden:
        def heat(t: float, k: int, x: np.ndarray) -> np.ndarray:
            more = np.zeros(world.n)
            if is_heat:
                more[node] = size * path[k]
            else:
                more[a] = max(size * path[k], -0.9) * world.conductance[edge] * (x[b] - x[a])
                more[b] = -more[a]
            return more

        return Hidden({"node": f"n{node}"} if is_heat else {"nodes": [f"n{a}", f"n{b}"]}, heat)

    size = 0.1 * world.mean_load_W if is_heat else 0.1
    for _ in range(2):
        drawn = scene.drawn("drift", hidden(size))
        size *= float(np.clip(target / max(drawn.truth.trace_beyond, 1e-9), 0.02, 50.0))
        if not is_heat:
            size = min(size, 0.6)
    drawn = scene.drawn("wandering_heat" if is_heat else "wandering_conductance", hidden(size))
    named = {"kind": drawn.effect, "where": drawn.hidden.where, "rms": size}
    return drawn.hidden, named | {"trace": drawn.truth.trace, "trace_beyond": drawn.truth.trace_beyond}


def _telemetry(scene: Scene, kind: str, group: Sequence[Drawn], rng: np.random.Generator, seed: int) -> Case:
    """Return the case of effects that act together."""
    world, facts = scene.world, {"kind": kind, "n_nodes": scene.world.n}
    group = sorted(group, key=lambda one: -one.truth.trace)
    hidden = [one.hidden for one in group]
    if kind == "beside_drift":
        smallest = min(one.truth.trace_beyond for one in group)
        drift, facts["drift"] = _drift(scene, smallest * float(rng.uniform(0.3, 1.0)), rng)
        hidden.append(drift)
    truth, seen = scene.readings(together(world, hidden))
    values = _driving(world)
    values |= {f"T{i}": seen[:, i] + rng.normal(0, scene.noise_K, world.time_s.size) for i in scene.read}
    unread = [i for i in range(world.n) if i not in scene.read]
    capacity = world.capacity * np.exp(rng.normal(0, 0.3, world.n))
    conductance = world.conductance * np.exp(rng.normal(0, 0.4, len(world.edges)))
    spec = declared(world, capacity.tolist(), conductance.tolist(), unread, f"several-{seed}")
    pairs = list(combinations(group, 2))
    facts["most_alike"] = max((correlation(a.beyond_K, b.beyond_K) for a, b in pairs), default=0.0)
    truths = tuple(one.truth for one in group)
    return Case(spec, Record(world.time_s, values, None, f"several-{seed}"), truths, truth, scene.noise_K, facts)
