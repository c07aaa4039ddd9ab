"""The field as pictures: temperatures on a regular grid, at regular times of a run."""

import numpy as np
from scipy.sparse import csr_array

from twin_core._typing import BoolArray, FloatArray
from twin_core.errors import SpecError
from twin_core.fem.assembly import Assembler
from twin_core.fem.geometry import VOID
from twin_core.fem.scenario import Scenario

MOST_CELLS = 120
"""Along the longer side."""


class Film:
    """Pictures of one case of a run: hand ``take`` to :func:`twin_core.fem.simulate.simulate` as ``watch``.

    Attributes
    ----------
    origin_m, cell_m
        Lower left corner, and side of the square cells.
    time_s : list of n_pictures
        Instants, from the start of the record.
    temperature_K : list of n_pictures, each (n_rows, n_columns)
        At the centre of each cell, the first row at the bottom; NaN where no region is.
    """

    def __init__(self, scenario: Scenario, every_s: float) -> None:
        """Prepare pictures at multiples of ``every_s``, which no step is to miss: SpecError if it is no multiple of one."""
        step_s = scenario.time.step_s
        self._stride = round(every_s / step_s)
        if self._stride < 1 or abs(self._stride * step_s - every_s) > 1e-9 * every_s:
            raise SpecError(f"a picture every {every_s:g} s: must be a multiple of the simulator's step, {step_s:g} s")
        self._step_s, self._stop_s = step_s, scenario.time.duration_s
        grid = scenario.grid
        lines = (grid.x_m, grid.y_m)
        extent_m = [float(line[-1] - line[0]) for line in lines]
        finest_m = min(float(np.diff(line).min()) for line in lines)
        self.cell_m = max(finest_m, max(extent_m) / MOST_CELLS)
        self.origin_m = (float(grid.x_m[0]), float(grid.y_m[0]))
        self._inside, self._reading = _reading(scenario, self.origin_m, self.cell_m, extent_m)
        self.time_s: list[float] = []
        self.temperature_K: list[FloatArray] = []

    def take(self, time_s: float, temperature_K: FloatArray) -> None:
        """Take a picture of (n_unknowns, n_cases) if it is time for one."""
        step = round(time_s / self._step_s)
        if step < 0 or step % self._stride or time_s > self._stop_s + 1e-9:
            return
        picture = np.full(self._inside.shape, np.nan)
        picture[self._inside] = self._reading @ temperature_K[: self._reading.shape[1], 0]
        self.time_s.append(time_s)
        self.temperature_K.append(picture)


def _reading(
    scenario: Scenario, origin_m: tuple[float, float], cell_m: float, extent_m: list[float]
) -> tuple[BoolArray, csr_array]:
    """Return which cells lie in a region, (n_rows, n_columns), and their temperature from the nodes', (n_inside, n_nodes).

    Bilinear shape functions on the cells of the mesh, which are rectangles and stand in the order of the grid's.
    """
    grid, mesh = scenario.grid, Assembler(scenario).split.mesh
    x_m, y_m = (
        o + cell_m * (0.5 + np.arange(int(np.ceil(e / cell_m - 1e-9)))) for o, e in zip(origin_m, extent_m, strict=True)
    )
    columns, rows = (np.searchsorted(line, at, side="right") - 1 for line, at in ((grid.x_m, x_m), (grid.y_m, y_m)))
    within = (columns < grid.x_m.size - 1)[None, :] & (rows < grid.y_m.size - 1)[:, None]
    cells = np.minimum(columns, grid.x_m.size - 2)[None, :], np.minimum(rows, grid.y_m.size - 2)[:, None]
    inside = within & (grid.region[cells] != VOID)
    element = np.full(grid.region.shape, -1)
    element[grid.region != VOID] = np.arange(mesh.nelements)
    chosen = np.broadcast_to(element[cells], inside.shape)[inside]
    nodes = mesh.t[:, chosen]
    at = np.stack([np.broadcast_to(x_m, inside.shape)[inside], np.broadcast_to(y_m[:, None], inside.shape)[inside]])
    corners = mesh.p[:, nodes]
    size = np.ptp(corners, axis=1)
    weight = np.prod(1.0 - np.abs(corners - at[:, None]) / size[:, None], axis=0)
    index = np.broadcast_to(np.arange(chosen.size), nodes.shape)
    return inside, csr_array((weight.ravel(), (index.ravel(), nodes.ravel())), shape=(chosen.size, mesh.nvertices))
