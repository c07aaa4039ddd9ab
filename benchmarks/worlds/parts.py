"""What spacecraft are built of: decks, tubes, brackets, and units of several regions that an operator calls one node."""

from dataclasses import dataclass, field

import numpy as np

from benchmarks.worlds.body import WHOLE, Window, angle_bracket, block, tube
from benchmarks.worlds.field import Contact, Plan, Spot

SLOTS: tuple[Window, ...] = (
    ((0.06, 0.44), (0.08, 0.44)),
    ((0.56, 0.94), (0.56, 0.92)),
    ((0.56, 0.94), (0.08, 0.44)),
    ((0.06, 0.44), (0.56, 0.92)),
)
"""Where units stand on a deck."""


@dataclass
class Builder:
    """Draws parts and puts them together.

    Attributes
    ----------
    rng
        Draws sizes, materials and places.
    stiffness
        Factor on all conductivities and inner contacts: the larger, the closer the truth is to lumped nodes.
    """

    rng: np.random.Generator
    stiffness: float
    plan: Plan = field(default_factory=lambda: Plan({}, {}, [], {}, [], {}, {}, {}))
    free: dict[str, list[Window]] = field(default_factory=dict)

    def _sheet(self) -> tuple[float, tuple[float, float, float], float]:
        """Return thickness, conductivity and volumetric capacity of a panel: plate, laminate or honeycomb."""
        ratio = float(self.rng.uniform(1.0, 4.0))
        kind = int(self.rng.integers(0, 3))
        thickness, k, across, capacity = (
            (float(self.rng.uniform(0.003, 0.008)), 140.0, 140.0, 2.45e6),  # aluminium 6061
            (float(self.rng.uniform(0.004, 0.008)), 90.0, 3.0, 1.65e6),  # high-conductivity carbon fibre
            (float(self.rng.uniform(0.015, 0.025)), 30.0, 2.0, 4.0e5),  # honeycomb with doubler, smeared
        )[kind]
        k *= self.stiffness
        turned = (k, k / ratio) if self.rng.random() < 0.5 else (k / ratio, k)
        return thickness, (*turned, across * self.stiffness), capacity

    def panel(self, node: str, *, radiates: bool) -> None:
        """Add a deck or panel: units stand on ``+3``, the outer face is ``-3``."""
        thickness, k, capacity = self._sheet()
        size = (float(self.rng.uniform(0.4, 0.8)), float(self.rng.uniform(0.3, 0.6)), thickness)
        self.plan.bodies[node] = block(size, (8, 6, 1), k, capacity)
        self.plan.groups[node] = (node,)
        self.free[node] = list(SLOTS)
        if radiates:
            self._radiator(node, (node, "-3", self._window(0.65, 1.0)))
        self._heater(node, node, "+3" if self.rng.random() < 0.5 else "-3")

    def bracket(self, node: str) -> None:
        """Add an L of aluminium or titanium, a node of its own: foot ``-3``, back ``-1``."""
        k = float(self.rng.choice([140.0, 60.0])) * self.stiffness
        legs = (float(self.rng.uniform(0.12, 0.3)), float(self.rng.uniform(0.12, 0.3)))
        width, thickness = float(self.rng.uniform(0.12, 0.3)), float(self.rng.uniform(0.005, 0.012))
        self.plan.bodies[node] = angle_bracket(legs, width, thickness, (4, 4, 4), (k, k, k), 2.45e6)
        self.plan.groups[node] = (node,)
        self._heater(node, node, "-1")

    def tube(self, node: str) -> None:
        """Add a central tube of carbon fibre or aluminium."""
        k = float(self.rng.choice([140.0, 60.0])) * self.stiffness
        radius, wall = float(self.rng.uniform(0.1, 0.18)), float(self.rng.uniform(0.003, 0.006))
        length = float(self.rng.uniform(0.3, 0.6))
        self.plan.bodies[node] = tube(radius, wall, length, (1, 12, 6), (k, k, k), 2.0e6)
        self.plan.groups[node] = (node,)
        self._heater(node, node, "+1")

    def unit(self, node: str, on: str, face: str = "+3") -> None:
        """Add an electronics unit on a panel: base plate, payload and filler, in contact, declared as one node."""
        side = (float(self.rng.uniform(0.14, 0.24)), float(self.rng.uniform(0.12, 0.2)))
        base, load, filler = node, f"{node}.payload", f"{node}.filler"
        k = float(self.rng.uniform(80.0, 150.0)) * self.stiffness
        height, thick = float(self.rng.uniform(0.05, 0.12)), float(self.rng.uniform(0.006, 0.012))
        self.plan.bodies[base] = block((*side, thick), (4, 3, 1), (k, k, k), 2.45e6)
        inner = (20.0 * self.stiffness, 12.0 * self.stiffness, 15.0 * self.stiffness)
        self.plan.bodies[load] = block((0.8 * side[0], 0.8 * side[1], height), (3, 3, 2), inner, 1.1e6)
        soft = 5.0 * self.stiffness
        self.plan.bodies[filler] = block((0.6 * side[0], 0.6 * side[1], 0.03), (2, 2, 1), (soft, soft, soft), 9e5)
        self.plan.groups[node] = (base, load, filler)
        self._inside(((base, "+3", ((0.1, 0.9), (0.1, 0.9))), (load, "-3", WHOLE)), 200.0, 700.0)
        self._inside(((load, "+3", ((0.12, 0.88), (0.12, 0.88))), (filler, "-3", WHOLE)), 80.0, 300.0)
        self.join((base, "-3", WHOLE), (on, face, self.slot(on)), 150.0, 700.0)
        self.plan.heater_spots[node] = (load, "+2", WHOLE) if self.rng.random() < 0.5 else (base, "+3", WHOLE)

    def massive(self, node: str, on: str, face: str = "+3", window: Window | None = None) -> None:
        """Add a battery or a tank on a panel: a block that conducts badly across."""
        size = tuple(float(x) for x in self.rng.uniform(0.1, 0.2, 3))
        along = float(self.rng.uniform(15.0, 40.0)) * self.stiffness
        k = (along, along, along * float(self.rng.uniform(0.15, 0.6)))
        capacity = float(self.rng.uniform(1.2e6, 2.2e6))
        self.plan.bodies[node] = block((size[0], size[1], size[2]), (4, 4, 4), k, capacity)
        self.plan.groups[node] = (node,)
        self.join((node, "-3", WHOLE), (on, face, window or self.slot(on)), 60.0, 250.0)
        self._heater(node, node, str(self.rng.choice(["+1", "-2", "+3"])))

    def post(self, below: str, above: str, n: int) -> None:
        """Join two decks by bars that belong to the upper one."""
        for i in range(n):
            name = f"{above}.post{i}"
            length = float(self.rng.uniform(0.12, 0.3))
            k = 140.0 * self.stiffness
            self.plan.bodies[name] = block((0.03, 0.03, length), (1, 1, 3), (k, k, k), 2.45e6)
            u, v = ((0.02, 0.07) if i % 2 else (0.93, 0.98)), ((0.46, 0.53), (0.03, 0.07), (0.93, 0.97))[i // 2]
            self._inside(((name, "+3", WHOLE), (above, "-3", (u, v))), 2000.0, 6000.0)
            self.join((name, "-3", WHOLE), (below, "+3", (u, v)), 1000.0, 4000.0)
            self.plan.groups[above] = (*self.plan.groups[above], name)

    def join(self, a: Spot, b: Spot, low: float, high: float) -> None:
        """Press two nodes together with a contact conductance between two limits, in W/m2/K."""
        self.plan.contacts.append(Contact((a, b), float(self.rng.uniform(low, high))))

    def _inside(self, spots: tuple[Spot, Spot], low: float, high: float) -> None:
        self.plan.contacts.append(Contact(spots, float(self.rng.uniform(low, high)) * self.stiffness))

    def slot(self, panel: str) -> Window:
        """Return a place on a panel that is still free, and take it."""
        return self.free[panel].pop(int(self.rng.integers(0, len(self.free[panel]))))

    def _window(self, least: float, most: float) -> Window:
        """Return a window that covers such a share of each direction."""
        found = []
        for share in self.rng.uniform(least, most, 2):
            low = float(self.rng.uniform(0.0, 1.0 - share))
            found.append((low, low + float(share)))
        return found[0], found[1]

    def _radiator(self, node: str, spot: Spot) -> None:
        self.plan.radiators[node] = (spot, float(self.rng.uniform(0.6, 0.9)))

    def _heater(self, node: str, body: str, face: str) -> None:
        self.plan.heater_spots[node] = (body, face, self._window(0.25, 1.0))
