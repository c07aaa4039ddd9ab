"""Rectangles on one tensor grid: which cell belongs to which region, which sides are free, which touch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.errors import SpecError

Rectangle = tuple[tuple[float, float], tuple[float, float]]
"""((x_low, x_high), (y_low, y_high)) in metres."""

SIDES: Mapping[str, tuple[int, int]] = {"left": (-1, 0), "right": (1, 0), "bottom": (0, -1), "top": (0, 1)}
"""Name of a side -> step in (x, y) to the neighbouring cell."""

VOID = -1


@dataclass(frozen=True, eq=False)
class Grid:
    """Cells of a structured grid.

    Attributes
    ----------
    x_m, y_m : (n_x + 1,), (n_y + 1,)
        Grid lines.
    region : (n_x, n_y)
        Index of the region of each cell; -1 is void.
    names
        Region ids, in the order of the indices.
    """

    x_m: FloatArray
    y_m: FloatArray
    region: IntArray
    names: tuple[str, ...]

    def neighbour(self, side: str) -> IntArray:
        """Return the region index of each cell's neighbour on one side, (n_x, n_y); void beyond the grid."""
        dx, dy = SIDES[side]
        padded = np.pad(self.region, 1, constant_values=VOID)
        n_x, n_y = self.region.shape
        return padded[1 + dx : 1 + dx + n_x, 1 + dy : 1 + dy + n_y]

    def touching(self) -> set[frozenset[str]]:
        """Return every pair of regions that have a cell side in common."""
        pairs: set[frozenset[str]] = set()
        for side in ("right", "top"):
            other = self.neighbour(side)
            both = (self.region != VOID) & (other != VOID) & (self.region != other)
            for a, b in np.unique(np.stack([self.region[both], other[both]]), axis=1).T:
                pairs.add(frozenset((self.names[a], self.names[b])))
        return pairs

    def has_free_side(self, region: str, side: str) -> bool:
        """Return whether the region has a cell side that faces the outside or a void in that direction."""
        mine = self.region == self.names.index(region)
        return bool((mine & (self.neighbour(side) == VOID)).any())


def lay_grid(rectangles: Mapping[str, Rectangle], size_m: float) -> Grid:
    """Return the grid whose lines hold every rectangle's edges, no cell larger than ``size_m``.

    Where rectangles overlap, the later one wins, so that a unit can sit inside a plate.

    Raises
    ------
    SpecError
        If a region ends up with no cell.
    """
    x_m = _lines([edge for x, _ in rectangles.values() for edge in x], size_m)
    y_m = _lines([edge for _, y in rectangles.values() for edge in y], size_m)
    x_mid, y_mid = (x_m[:-1] + x_m[1:]) / 2.0, (y_m[:-1] + y_m[1:]) / 2.0
    region = np.full((x_mid.size, y_mid.size), VOID, dtype=np.int64)
    for index, ((x_low, x_high), (y_low, y_high)) in enumerate(rectangles.values()):
        inside_x, inside_y = (x_low < x_mid) & (x_mid < x_high), (y_low < y_mid) & (y_mid < y_high)
        region[np.ix_(inside_x, inside_y)] = index
    for index, name in enumerate(rectangles):
        if not (region == index).any():
            raise SpecError(f"regions: '{name}' is covered completely by later regions; move or remove it")
    return Grid(x_m, y_m, region, tuple(rectangles))


def _lines(edges: Sequence[float], size_m: float) -> FloatArray:
    """Return the grid lines in one direction: all edges (merged within a nanometre), evenly divided in between."""
    distinct = np.unique(np.round(np.array(edges, dtype=float), 9))
    counts = np.ceil(np.diff(distinct) / size_m - 1e-9).astype(int)
    pieces = [
        np.linspace(a, b, n, endpoint=False)
        for a, b, n in zip(distinct[:-1], distinct[1:], np.maximum(counts, 1), strict=True)
    ]
    return np.concatenate([*pieces, distinct[-1:]])


def bodies(grid: Grid, joints: Sequence[tuple[str, str]]) -> dict[str, int]:
    """Return the body of each region: regions that touch without a joint grow together.

    Raises
    ------
    SpecError
        If a joint joins regions that do not touch, or that grow together through a third one.
    """
    parent = {name: name for name in grid.names}

    def root(name: str) -> str:
        while parent[name] != name:
            name = parent[name]
        return name

    touching, declared = grid.touching(), [frozenset(pair) for pair in joints]
    for a, b in sorted(tuple(sorted(pair)) for pair in touching if pair not in declared):
        parent[root(a)] = root(b)
    for i, (a, b) in enumerate(joints):
        if frozenset((a, b)) not in touching:
            raise SpecError(f"joints[{i}].between: '{a}' and '{b}' have no side in common; use a strap")
        if root(a) == root(b):
            raise SpecError(f"joints[{i}].between: '{a}' and '{b}' are in perfect contact through other regions")
    roots = sorted({root(name) for name in grid.names}, key=grid.names.index)
    return {name: roots.index(root(name)) for name in grid.names}
