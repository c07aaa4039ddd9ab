"""How spacecraft are put together: decks on posts, a tube, a frame; what they are coupled to, and where their sensors are."""

from collections.abc import Callable

from benchmarks.worlds.body import WHOLE
from benchmarks.worlds.field import Spot
from benchmarks.worlds.parts import Builder


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


def couple(b: Builder) -> None:
    """Couple one or two nodes to the bus, and now and then another to a wall."""
    nodes = [n for n in b.plan.groups if n not in b.plan.radiators]
    b.rng.shuffle(nodes)
    b.plan.mounts.append((_edge(nodes[0]), "bus", float(b.rng.uniform(0.3, 1.2))))
    if b.rng.random() < 0.4:
        b.plan.mounts.append((_edge(nodes[1]), "wall", float(b.rng.uniform(0.3, 1.0))))


def _edge(node: str) -> Spot:
    return node, "+3" if node == "tube" else "+1", WHOLE


def sense(b: Builder) -> None:
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


STRUCTURES: dict[str, Callable[[Builder], None]] = {"decks": _decks, "tube": _tube, "frame": _frame, "stack": _stack}
"""Kind -> puts the parts together."""
