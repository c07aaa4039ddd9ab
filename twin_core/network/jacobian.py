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


class JacobianSum:
    """The sum of the terms' Jacobians, entry by entry where it moves."""

    def __init__(self, n_nodes: int) -> None:
        self.constant = np.zeros((n_nodes, n_nodes))
        self.moving: list[tuple[int, int, FloatArray]] = []

    def add(self, part: Heat) -> None:
        """Add d heat / d temperature of one term."""
        nodes = np.asarray(part.nodes)
        if part.d_temperature.shape[0] == 1:
            self.constant[nodes[:, None], nodes] += part.d_temperature[0]
            return
        for a, row in enumerate(part.nodes):
            for b, column in enumerate(part.nodes):
                if part.d_temperature[:, a, b].any():
                    self.moving.append((row, column, part.d_temperature[:, a, b]))

    def over(self, capacity: FloatArray, movable: Sequence[int], correction: FloatArray) -> Jacobian:
        """Return the Jacobian of the rates.

        Parameters
        ----------
        capacity : (n_points, n_nodes)
        movable
            Nodes whose capacity is not the same everywhere: all their entries move.
        correction : (n_points, n_nodes)
            What the capacity's slope adds to their diagonal.
        """
        constant = self.constant / (capacity[0] if len(capacity) else np.ones(capacity.shape[1]))[:, None]
        constant[list(movable)] = 0.0
        entries = [(row, column, series / capacity[:, row]) for row, column, series in self.moving]
        for node in movable:
            entries += [
                (node, int(j), self.constant[node, j] / capacity[:, node]) for j in np.flatnonzero(self.constant[node])
            ]
            entries.append((node, node, correction[:, node]))
        moving = np.empty((capacity.shape[0], len(entries)))
        for k, (_, _, series) in enumerate(entries):
            moving[:, k] = series
        where = np.array([(row, column) for row, column, _ in entries], dtype=np.int64).reshape(len(entries), 2)
        return Jacobian(constant, where[:, 0].copy(), where[:, 1].copy(), moving)
