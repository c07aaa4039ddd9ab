"""An effect at a place and of a size, and the scene that it is drawn for."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.worlds.spacecraft import Spacecraft
from benchmarks.worlds.stepping import NOTHING, Acting, Drive

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


def heated(where: dict[str, Any], parameters: dict[str, Any], heat: Any, **more: Any) -> Effect:
    return Effect(where, parameters, Acting(heat, **more))


def free_boundary(s: Scene) -> tuple[str, str]:
    """Return a node and a boundary that no declared coupling joins."""
    known = s.craft.field.conductance_W_per_K
    places = [(n, b) for n in s.craft.nodes for b in s.craft.boundaries_K if (n, b) not in known]
    return places[int(s.rng.integers(0, len(places)))]
