"""The Jacobian of the heat balance along a trajectory: what stays, and the few entries that move with temperature."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.network.terms import Heat


@dataclass(frozen=True)
class Jacobian:
    """A matrix at each of n_points, (n_nodes, n_nodes): conductances are the same at all of them, radiation is not.

    Attributes
    ----------
    constant : (n_nodes, n_nodes)
    row, column : (n_entries,)
    moving : (n_points, n_entries)
        Added to the constant at (row, column); an entry may occur more than once.
    """

    constant: FloatArray
    row: IntArray
    column: IntArray
    moving: FloatArray

    def dense(self) -> FloatArray:
        """Return the matrices, (n_points, n_nodes, n_nodes)."""
        out = np.repeat(self.constant[None], self.moving.shape[0], axis=0)
        for entry, (i, j) in enumerate(zip(self.row, self.column, strict=True)):
            out[:, i, j] += self.moving[:, entry]
        return out

    def mean(self) -> FloatArray:
        """Return the mean matrix over the points, (n_nodes, n_nodes)."""
        out = self.constant.copy()
        if self.moving.shape[0]:
            np.add.at(out, (self.row, self.column), self.moving.mean(axis=0))
        return out

    def with_columns_scaled(self, columns: Sequence[int], factor: FloatArray) -> "Jacobian":
        """Return the matrices with some columns scaled at each point: all their entries move then.

        Parameters
        ----------
        columns
            Nodes.
        factor : (n_points, n_nodes)
        """
        constant = self.constant.copy()
        constant[:, list(columns)] = 0.0
        scaled = np.isin(self.column, columns)
        moving = np.where(scaled, self.moving * factor[:, self.column], self.moving)
        more = [(i, j) for j in columns for i in np.flatnonzero(self.constant[:, j])]
        row, column = np.array(more, dtype=np.int64).reshape(len(more), 2).T
        return Jacobian(
            constant,
            np.concatenate([self.row, row]),
            np.concatenate([self.column, column]),
            np.hstack([moving, self.constant[row, column] * factor[:, column]]),
        )


class JacobianSum:
    """The sum of the terms' Jacobians, entry by entry where it moves."""

    def __init__(self, n_nodes: int) -> None:
        self.constant = np.zeros((n_nodes, n_nodes))
        self.moving: list[tuple[int, int, FloatArray]] = []

    def add(self, part: Heat, temperatures_K: FloatArray) -> None:
        """Add d heat / d temperature of one term at temperatures (n_points, n_nodes)."""
        nodes = np.asarray(part.nodes)
        if part.fourth_W_per_K4 is not None and part.d_temperature.size == 0:
            slopes = 4.0 * temperatures_K[:, nodes] ** 3
            for a, b in np.argwhere(part.fourth_W_per_K4):
                self.moving.append((int(nodes[a]), int(nodes[b]), part.fourth_W_per_K4[a, b] * slopes[:, b]))
            return
        if part.d_temperature.shape[0] == 1:
            self.constant[nodes[:, None], nodes] += part.d_temperature[0]
            return
        for a, row in enumerate(part.nodes):
            for b, column in enumerate(part.nodes):
                if part.d_temperature[:, a, b].any():
                    self.moving.append((row, column, part.d_temperature[:, a, b]))

    def add_entry(self, row: int, column: int, series: FloatArray) -> None:
        """Add one entry along the points, (n_points,)."""
        if series.size and np.ptp(series) == 0.0:
            self.constant[row, column] += series[0]
        else:
            self.moving.append((row, column, series))

    def over(self, capacity_J_per_K: FloatArray, n_points: int) -> Jacobian:
        """Return the Jacobian of the heats over each node's own capacity (n_nodes,), at n_points."""
        moving = np.empty((n_points, len(self.moving)))
        for k, (row, _, series) in enumerate(self.moving):
            moving[:, k] = series / capacity_J_per_K[row]
        where = np.array([(row, column) for row, column, _ in self.moving], dtype=np.int64).reshape(-1, 2)
        return Jacobian(self.constant / capacity_J_per_K[:, None], where[:, 0].copy(), where[:, 1].copy(), moving)
