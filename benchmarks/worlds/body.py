"""Solid bodies as hexahedral meshes, and patches on their faces through which heat comes and goes."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from skfem import Basis, BilinearForm, ElementHex1, MeshHex

FACES = {"-1": (0, 0), "+1": (0, -1), "-2": (1, 0), "+2": (1, -1), "-3": (2, 0), "+3": (2, -1)}
"""Face -> axis that it is perpendicular to, and which grid line."""


@dataclass(frozen=True)
class Body:
    """A body on a structured grid.

    Attributes
    ----------
    mesh
        Hexahedra in metres.
    ids : (n_1, n_2, n_3)
        Vertex at each crossing of the grid lines; -1 outside the body.
    conductivity_W_per_m_K : (3,)
        Along x, y and z: panels conduct better in one direction.
    capacity_J_per_m3_K
        Volumetric heat capacity.
    face_limits
        Ranges of grid lines that a face covers, where that is not all of them: face -> ((low, high), (low, high)).
    """

    mesh: MeshHex
    ids: np.ndarray
    conductivity_W_per_m_K: tuple[float, float, float]
    capacity_J_per_m3_K: float
    face_limits: dict[str, tuple[tuple[float, float], tuple[float, float]]]

    @property
    def n_vertices(self) -> int:
        """How many vertices the mesh has."""
        return int(self.mesh.p.shape[1])

    def matrices(self) -> tuple[np.ndarray, csr_matrix]:
        """Return the lumped heat capacity of every vertex, (n,) in J/K, and the conduction matrix, (n, n) in W/K."""
        basis = Basis(self.mesh, ElementHex1())
        k = self.conductivity_W_per_m_K

        @BilinearForm
        def mass(u, v, _):  # type: ignore[no-untyped-def]
            return u * v

        @BilinearForm
        def conduction(u, v, _):  # type: ignore[no-untyped-def]
            return sum(k[i] * u.grad[i] * v.grad[i] for i in range(3))

        lumped = np.asarray(mass.assemble(basis).sum(axis=1)).ravel()
        return self.capacity_J_per_m3_K * lumped, conduction.assemble(basis).tocsr()

    def point(self, face: str, u: float, v: float) -> np.ndarray:
        """Return the weights of the vertices at one point of a face, (n_vertices,)."""
        at = self._on_face(face, np.array([u]), np.array([v]))
        return self._weights(at).toarray()[0]

    def patch(self, face: str, window: "Window", cuts: "Cuts | None" = None) -> "Patch":
        """Return a part of a face, its share of the face given by a window of (0, 1) x (0, 1)."""
        cuts = self.cuts(face, window) if cuts is None else cuts
        edges = [low + (high - low) * c for (low, high), c in zip(window, cuts, strict=True)]
        corners = self._positions(face, *np.meshgrid(*edges, indexing="ij"))
        across = corners[:, 1:, 1:] - corners[:, :-1, :-1]
        other = corners[:, :-1, 1:] - corners[:, 1:, :-1]
        area = 0.5 * np.linalg.norm(np.cross(across, other, axis=0), axis=0)
        centres = np.meshgrid(*[0.5 * (e[1:] + e[:-1]) for e in edges], indexing="ij")
        return Patch(self._weights(self._on_face(face, centres[0].ravel(), centres[1].ravel())), area.ravel())

    def cuts(self, face: str, window: "Window", finest: int = 4) -> "Cuts":
        """Return where to cut a window into cells, as shares of it: at grid lines and evenly."""
        found = []
        for (low, high), (first, last) in zip(window, self._ranges(face), strict=True):
            lines = (np.arange(np.ceil(first), np.floor(last) + 1) - first) / (last - first)
            inside = (lines[(lines > low + 1e-9) & (lines < high - 1e-9)] - low) / (high - low)
            found.append(np.unique(np.round(np.concatenate([np.linspace(0.0, 1.0, finest + 1), inside]), 9)))
        return found[0], found[1]

    def _ranges(self, face: str) -> tuple[tuple[float, float], tuple[float, float]]:
        if face in self.face_limits:
            return self.face_limits[face]
        first, second = (float(n - 1) for i, n in enumerate(self.ids.shape) if i != FACES[face][0])
        return (0.0, first), (0.0, second)

    def _on_face(self, face: str, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return points of a face in units of grid lines, (3, n_points)."""
        axis, end = FACES[face]
        (u0, u1), (v0, v1) = self._ranges(face)
        along = [u0 + (u1 - u0) * u, v0 + (v1 - v0) * v]
        along.insert(axis, np.full(u.shape, float((self.ids.shape[axis] - 1) * (end == -1))))
        return np.stack(along)

    def _positions(self, face: str, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return points of a face in metres, (3, *u.shape)."""
        weights = self._weights(self._on_face(face, u.ravel(), v.ravel()))
        return (weights @ self.mesh.p.T).T.reshape(3, *u.shape)

    def _weights(self, at: np.ndarray) -> csr_matrix:
        """Return the trilinear weights of the vertices at points given in units of grid lines, (n_points, n_vertices)."""
        n = np.array(self.ids.shape)[:, None]
        cell = np.clip(np.floor(at).astype(int), 0, n - 2)
        share = at - cell
        columns, entries = [], []
        for corner in np.ndindex(2, 2, 2):
            offset = np.array(corner)[:, None]
            columns.append(self.ids[tuple(cell + offset)])
            entries.append(np.prod(np.where(offset == 1, share, 1.0 - share), axis=0))
        rows = np.tile(np.arange(at.shape[1]), 8)
        column, entry = np.concatenate(columns), np.concatenate(entries)
        used = entry > 1e-12
        return csr_matrix((entry[used], (rows[used], column[used])), shape=(at.shape[1], self.n_vertices))


Window = tuple[tuple[float, float], tuple[float, float]]
"""A rectangle on a face, in shares of its two directions."""
Cuts = tuple[np.ndarray, np.ndarray]

WHOLE: Window = ((0.0, 1.0), (0.0, 1.0))


@dataclass(frozen=True)
class Patch:
    """A part of a surface, cut into cells.

    Attributes
    ----------
    weights : (n_cells, n_vertices)
        Temperature at the middle of each cell from those of the vertices.
    area_m2 : (n_cells,)
    """

    weights: csr_matrix
    area_m2: np.ndarray

    @property
    def spread(self) -> np.ndarray:
        """Share of a heat spread evenly over the patch that each vertex gets, (n_vertices,); they add to one."""
        return self.weights.T @ (self.area_m2 / self.area_m2.sum())


def _body(
    shape: tuple[int, int, int],
    places: np.ndarray,
    inside: np.ndarray,
    conductivity: tuple[float, float, float],
    capacity: float,
    *,
    closed: bool = False,
    face_limits: dict[str, tuple[tuple[float, float], tuple[float, float]]] | None = None,
) -> Body:
    """Return the body of a grid of so many cells.

    ``places`` are the crossings of its lines in metres, (3, n_1, n_2, n_3), ``inside`` which cells belong to it; ``closed``
    joins the last line of the second direction to the first.
    """
    grid = MeshHex.init_tensor(*[np.arange(n + 1.0) for n in shape])
    cells = np.floor(grid.p[:, grid.t].mean(axis=1)).astype(int)
    grid = grid.restrict(np.flatnonzero(inside[tuple(cells)]))
    crossing = np.round(grid.p).astype(int)
    merged = crossing.copy()
    if closed:
        merged[1] %= shape[1]
    own, index = np.unique(merged, axis=1, return_inverse=True)
    ids = np.full([n + 1 for n in shape], -1)
    ids[tuple(crossing)] = index.ravel()
    mesh = MeshHex(np.ascontiguousarray(places[(slice(None), *own)]), index.ravel()[grid.t])
    return Body(mesh, ids, conductivity, capacity, face_limits or {})


def block(
    size_m: tuple[float, float, float],
    cells: tuple[int, int, int],
    conductivity: tuple[float, float, float],
    capacity: float,
) -> Body:
    """Return a box with edges along the axes."""
    lines = [np.linspace(0.0, length, n + 1) for length, n in zip(size_m, cells, strict=True)]
    places = np.stack(np.meshgrid(*lines, indexing="ij"))
    return _body(cells, places, np.ones(cells, dtype=bool), conductivity, capacity)


def angle_bracket(
    legs_m: tuple[float, float],
    width_m: float,
    thickness_m: float,
    cells: tuple[int, int, int],
    conductivity: tuple[float, float, float],
    capacity: float,
) -> Body:
    """Return an L: one leg along x with its face ``-3`` below, one along z with its face ``-1`` behind.

    ``cells`` are those along the first leg, across and along the second leg; one cell through the thickness.
    """
    x = np.concatenate([[0.0], np.linspace(thickness_m, legs_m[0], cells[0] + 1)])
    z = np.concatenate([[0.0], np.linspace(thickness_m, legs_m[1], cells[2] + 1)])
    places = np.stack(np.meshgrid(x, np.linspace(0.0, width_m, cells[1] + 1), z, indexing="ij"))
    shape = (cells[0] + 1, cells[1], cells[2] + 1)
    inside = np.zeros(shape, dtype=bool)
    inside[0], inside[:, :, 0] = True, True
    across, side = (0.0, float(cells[1])), ((0.0, float(cells[0] + 1)), (0.0, 1.0))
    ends = {"+1": (across, (0.0, 1.0)), "+3": ((0.0, 1.0), across), "-2": side, "+2": side}
    return _body(shape, places, inside, conductivity, capacity, face_limits=ends)


def tube(
    radius_m: float,
    wall_m: float,
    length_m: float,
    cells: tuple[int, int, int],
    conductivity: tuple[float, float, float],
    capacity: float,
) -> Body:
    """Return a tube along z: face ``+1`` outside, ``-1`` inside, ``-3`` and ``+3`` its rings.

    ``cells`` are those through the wall, around and along.
    """
    r, angle, z = np.meshgrid(
        np.linspace(radius_m - wall_m, radius_m, cells[0] + 1),
        np.linspace(0.0, 2.0 * np.pi, cells[1] + 1),
        np.linspace(0.0, length_m, cells[2] + 1),
        indexing="ij",
    )
    places = np.stack([r * np.cos(angle), r * np.sin(angle), z])
    return _body(cells, places, np.ones(cells, dtype=bool), conductivity, capacity, closed=True)
