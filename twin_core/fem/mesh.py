"""The mesh: bilinear quadrilaterals on the grid's cells, split at joints, with named regions and surfaces."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from skfem import MeshQuad

from twin_core._typing import FloatArray, IntArray
from twin_core.fem.geometry import SIDES, VOID, Grid

# Corners of a cell in counter-clockwise order, and the two corners of each of its sides.
_CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))
_SIDE_CORNERS = {"left": (0, 3), "right": (1, 2), "bottom": (0, 1), "top": (3, 2)}


@dataclass(frozen=True)
class SplitMesh:
    """A mesh whose bodies share no nodes.

    Attributes
    ----------
    mesh
        scikit-fem mesh, metres.
    elements : region -> (n,)
        Elements of each region.
    facets : surface -> (n,)
        Free facets: ``region.side``, ``region.all``, and the outer edges ``left`` and so on.
    contacts : (region, region) -> two (n,)
        Facets of both sides of each joint, in the same order along the joint.
    """

    mesh: MeshQuad
    elements: Mapping[str, IntArray]
    facets: Mapping[str, IntArray]
    contacts: Mapping[tuple[str, str], tuple[IntArray, IntArray]]


def build_mesh(grid: Grid, body: Mapping[str, int], joints: list[tuple[str, str]]) -> SplitMesh:
    """Return the mesh of all cells that belong to a region, bodies split from one another."""
    cell_x, cell_y = np.nonzero(grid.region != VOID)
    region = grid.region[cell_x, cell_y]
    points, corners = _number_nodes(grid, np.array([body[name] for name in grid.names])[region], cell_x, cell_y)
    mesh = MeshQuad(points, corners)
    facet_of = _facet_finder(mesh)
    sides = {side: facet_of(corners[list(pair)]) for side, pair in _SIDE_CORNERS.items()}
    neighbour = {side: grid.neighbour(side)[cell_x, cell_y] for side in SIDES}
    elements = {name: np.flatnonzero(region == i) for i, name in enumerate(grid.names)}
    return SplitMesh(
        mesh,
        elements,
        _free_facets(grid, region, neighbour, sides, cell_x, cell_y),
        {pair: _contact(pair, grid, region, neighbour, sides, mesh) for pair in joints},
    )


def _number_nodes(grid: Grid, body: IntArray, cell_x: IntArray, cell_y: IntArray) -> tuple[FloatArray, IntArray]:
    """Return node positions (2, n_nodes) and the corners of each cell (4, n_cells), nodes distinct per body."""
    width, per_body = grid.x_m.size, grid.x_m.size * grid.y_m.size
    keys = np.stack([body * per_body + (cell_y + dy) * width + cell_x + dx for dx, dy in _CORNERS])
    used, corners = np.unique(keys, return_inverse=True)
    place = used % per_body
    return np.stack([grid.x_m[place % width], grid.y_m[place // width]]), corners.reshape(keys.shape)


def _facet_finder(mesh: MeshQuad):  # type: ignore[no-untyped-def]
    """Return a function from node pairs (2, n) to facet indices (n,)."""
    low, high = np.sort(mesh.facets, axis=0).astype(np.int64)
    keys = low * mesh.nvertices + high
    order = np.argsort(keys)

    def find(pairs: IntArray) -> IntArray:
        a, b = np.sort(pairs, axis=0)
        return order[np.searchsorted(keys[order], a * mesh.nvertices + b)]

    return find


def _free_facets(
    grid: Grid,
    region: IntArray,
    neighbour: Mapping[str, IntArray],
    sides: Mapping[str, IntArray],
    cell_x: IntArray,
    cell_y: IntArray,
) -> dict[str, IntArray]:
    """Return the facets that face the outside or a void, by surface name."""
    last_x, last_y = grid.region.shape[0] - 1, grid.region.shape[1] - 1
    on_edge = {"left": cell_x == 0, "right": cell_x == last_x, "bottom": cell_y == 0, "top": cell_y == last_y}
    free = {side: neighbour[side] == VOID for side in SIDES}
    named = {side: sides[side][free[side] & on_edge[side]] for side in SIDES}
    for i, name in enumerate(grid.names):
        for side in SIDES:
            named[f"{name}.{side}"] = sides[side][free[side] & (region == i)]
        named[f"{name}.all"] = np.concatenate([named[f"{name}.{side}"] for side in SIDES])
    return named


def _contact(
    pair: tuple[str, str],
    grid: Grid,
    region: IntArray,
    neighbour: Mapping[str, IntArray],
    sides: Mapping[str, IntArray],
    mesh: MeshQuad,
) -> tuple[IntArray, IntArray]:
    """Return the facets of both regions along their joint, ordered alike by position."""
    a, b = (grid.names.index(name) for name in pair)
    found = []
    for mine, other in ((a, b), (b, a)):
        facets = np.concatenate([sides[side][(region == mine) & (neighbour[side] == other)] for side in SIDES])
        middle = np.round(mesh.p[:, mesh.facets[:, facets]].mean(axis=1), 9)
        found.append(facets[np.lexsort(middle)])
    return found[0], found[1]
