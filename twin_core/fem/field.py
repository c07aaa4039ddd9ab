"""The semi-discrete field: M dT/dt = -K T + B u + S T_boundary + radiation(T) + hidden heat."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array

from twin_core._typing import FloatArray, IntArray


@dataclass(frozen=True)
class Radiation:
    """Radiation by T^4 at quadrature points of all radiating facets.

    Attributes
    ----------
    trace : (n_points, n_unknowns)
        Temperature at the points.
    weight : (n_points,)
        sigma * emissivity * area of each point, W/K4.
    sink : (n_points,)
        Index of the boundary that each point sees.
    owner : (n_points,)
        Index of the radiator in the scenario.
    """

    trace: csr_array
    weight: FloatArray
    sink: IntArray
    owner: IntArray

    def heat_W(self, temperature_K: FloatArray, boundary_K: FloatArray) -> FloatArray:
        """Return the heat into every unknown, (n_unknowns, n_cases); boundary_K is (n_boundaries, n_cases)."""
        at_points = self.trace @ temperature_K
        return self.spread @ (self.weight[:, None] * (boundary_K[self.sink] ** 4 - at_points**4))

    @cached_property
    def spread(self) -> csr_array:
        """The transposed trace, (n_unknowns, n_points), kept because turning it round costs more than using it."""
        return csr_array(self.trace.T)

    def slope_W_per_K(self, temperature_K: FloatArray) -> csc_array:
        """Return minus the derivative of the heat at one temperature field (n_unknowns,), symmetric."""
        at_points = self.trace @ temperature_K
        return csc_array(self.spread @ diags_array(4.0 * self.weight * at_points**3) @ self.trace)


@dataclass(frozen=True)
class Field:
    """The semi-discrete field. Unknowns are nodal temperatures, then hidden lumped masses.

    Attributes
    ----------
    capacity_matrix, conductance_matrix : (n_unknowns, n_unknowns)
        M (J/K) and K (W/K), symmetric.
    inputs : (n_unknowns, n_inputs)
        B: how one watt of each forcing is spread.
    boundary_inputs : (n_unknowns, n_boundaries)
        S (W/K): conductances to the boundaries.
    radiation
        Radiating surfaces.
    readings : (n_sensors, n_unknowns)
        Temperature at the sensors.
    share : region -> (n_unknowns,)
        Spreads one watt over a region, and takes its mean.
    ownership : (n_regions, n_unknowns)
        The part of each unknown that belongs to each region.
    joint_matrices : pair of regions -> (n_unknowns, n_unknowns)
        Their joints and straps, parts of K.
    radiators
        (region, sink) of each radiator, in the order of the scenario.
    start_K : (n_unknowns,)
        Initial temperature.
    """

    capacity_matrix: csc_array
    conductance_matrix: csc_array
    inputs: FloatArray
    boundary_inputs: FloatArray
    radiation: Radiation
    readings: csr_array
    share: Mapping[str, FloatArray]
    ownership: FloatArray
    capacity_J_per_K: Mapping[str, float]
    joint_matrices: Mapping[frozenset[str], csr_array]
    boundaries: tuple[str, ...]
    radiators: tuple[tuple[str, str], ...]
    start_K: FloatArray
    epoch_ns: int | None = None

    @property
    def n_unknowns(self) -> int:
        """Number of unknown temperatures."""
        return int(self.capacity_matrix.shape[0])

    def joint_heat_W(self, nodes: tuple[str, str], temperature_K: FloatArray) -> FloatArray:
        """Return the heat of the declared joints and straps between two regions, (n_unknowns,)."""
        return -(self.joint_matrices[frozenset(nodes)] @ temperature_K)

    def radiator_heat_W(self, node: str, sink: str, temperature_K: FloatArray, sink_K: float) -> FloatArray:
        """Return the heat of a region's declared radiators to one sink, (n_unknowns,)."""
        mine = [i for i, pair in enumerate(self.radiators) if pair == (node, sink)]
        points = np.isin(self.radiation.owner, mine)
        at_points = self.radiation.trace @ temperature_K
        return self.radiation.spread @ (points * self.radiation.weight * (sink_K**4 - at_points**4))
