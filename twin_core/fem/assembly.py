"""Assembly: from a scenario to the matrices of its field, by scikit-fem."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import block_diag, csc_array, csr_array, diags_array, hstack, vstack
from skfem import Basis, ElementQuad1, FacetBasis

from twin_core._typing import FloatArray, IntArray
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4
from twin_core.fem.field import Field, Radiation
from twin_core.fem.forms import conduction, mass, trace, unit_source
from twin_core.fem.geometry import bodies
from twin_core.fem.hidden.base import Mass
from twin_core.fem.mesh import SplitMesh, build_mesh
from twin_core.fem.scenario import Scenario

_RADIATION_ORDER = 5
"""Quadrature order on radiating facets: T^4 v of a linear T is a polynomial of degree five."""


class Assembler:
    """Turns places into matrices on one mesh."""

    def __init__(self, scenario: Scenario) -> None:
        joints = [joint.between for joint in scenario.joints]
        self.scenario = scenario
        self.split: SplitMesh = build_mesh(scenario.grid, bodies(scenario.grid, joints), joints)
        self.basis = Basis(self.split.mesh, ElementQuad1())
        self.depth_m = scenario.depth_m

    def on(self, place: str) -> Basis | FacetBasis:
        """Return the basis restricted to a region or a surface."""
        if place in self.split.elements:
            return Basis(self.split.mesh, ElementQuad1(), elements=self.split.elements[place])
        return self.on_facets(self.split.facets[place])

    def on_facets(self, facets: IntArray, order: int | None = None) -> FacetBasis:
        """Return the basis on facets; ``order`` is the degree that quadrature integrates exactly."""
        return FacetBasis(self.split.mesh, ElementQuad1(), facets=facets, intorder=order)

    def mean(self, place: str) -> FloatArray:
        """Return the weights of a place's mean, (n_nodes,): also what spreads one watt over it."""
        vector = unit_source.assemble(self.on(place))
        return vector / vector.sum()

    def bulk(self) -> tuple[csc_array, csc_array]:
        """Return capacity and conduction matrices of all regions."""
        size = (self.basis.N, self.basis.N)
        capacity, conductance = csc_array(size), csc_array(size)
        for region in self.scenario.regions:
            material, basis = self.scenario.material(region), self.on(region.id)
            capacity = capacity + self.depth_m * material.heat_capacity_J_per_m3_K * mass.assemble(basis)
            conductance = conductance + self.depth_m * material.conductivity_W_per_m_K * conduction.assemble(basis)
        return csc_array(capacity), csc_array(conductance)

    def joint(self, pair: tuple[str, str], conductance_W_per_m2_K: float) -> csr_array:
        """Return the matrix of h (u_a - u_b)(v_a - v_b) along a joint."""
        (trace_a, weight), (trace_b, _) = (trace(self.on_facets(f)) for f in self.split.contacts[pair])
        jump = trace_a - trace_b
        return csr_array(jump.T @ diags_array(self.depth_m * conductance_W_per_m2_K * weight) @ jump)

    def strap(self, places: tuple[str, str], conductance_W_per_K: float) -> csr_array:
        """Return the matrix of G (mean_a u - mean_b u)(mean_a v - mean_b v)."""
        jump = csr_array((self.mean(places[0]) - self.mean(places[1]))[None, :])
        return csr_array(conductance_W_per_K * (jump.T @ jump))

    def spread_coupling(self, place: str, conductance_W_per_K: float) -> tuple[csr_array, FloatArray]:
        """Return matrix and boundary vector of a conductance spread evenly over a place."""
        basis = self.on(place)
        size = unit_source.assemble(basis).sum()
        return csr_array(conductance_W_per_K / size * mass.assemble(basis)), conductance_W_per_K * self.mean(place)

    def radiation(self, boundaries: tuple[str, ...]) -> Radiation:
        """Return the radiation of all radiators."""
        traces, weights, sinks, owners = [csr_array((0, self.basis.N))], [np.zeros(0)], [], []
        for i, radiator in enumerate(self.scenario.radiators):
            matrix, weight = trace(self.on_facets(self.split.facets[radiator.surface], _RADIATION_ORDER))
            traces.append(matrix)
            weights.append(STEFAN_BOLTZMANN_W_PER_M2_K4 * radiator.emissivity * self.depth_m * weight)
            sinks += [boundaries.index(radiator.sink)] * weight.size
            owners += [i] * weight.size
        return Radiation(
            csr_array(vstack(traces)),
            np.concatenate(weights),
            np.array(sinks, dtype=np.int64),
            np.array(owners, dtype=np.int64),
        )

    def readings(self) -> csr_array:
        """Return the matrix of sensor readings, (n_sensors, n_nodes)."""
        rows = []
        for sensor in self.scenario.sensors:
            if sensor.region is not None:
                rows.append(csr_array(self.mean(sensor.region)[None, :]))
            else:
                rows.append(csr_array(self.basis.probes(np.array(sensor.at_m)[:, None])))
        return csr_array(vstack(rows))


def assemble(scenario: Scenario) -> Field:
    """Return the field of a scenario, hidden masses included, all other hidden effects left out."""
    assembler = Assembler(scenario)
    boundaries = tuple(scenario.boundaries)
    capacity, conductance = assembler.bulk()
    joints: dict[frozenset[str], csr_array] = {}
    for pair, matrix in _joint_matrices(scenario, assembler):
        joints[pair] = joints[pair] + matrix if pair in joints else matrix
        conductance = csc_array(conductance + matrix)
    boundary_inputs = np.zeros((assembler.basis.N, len(boundaries)))
    for coupling in scenario.couplings:
        matrix, vector = assembler.spread_coupling(coupling.place, coupling.conductance_W_per_K)
        conductance = csc_array(conductance + matrix)
        boundary_inputs[:, boundaries.index(coupling.boundary)] += vector
    inputs = np.zeros((assembler.basis.N, len(scenario.forcings)))
    for load in scenario.loads:
        inputs[:, list(scenario.forcings).index(load.forcing)] += load.weight * assembler.mean(load.place)
    share = {region.id: assembler.mean(region.id) for region in scenario.regions}
    field = Field(
        capacity_matrix=capacity,
        conductance_matrix=conductance,
        inputs=inputs,
        boundary_inputs=boundary_inputs,
        radiation=assembler.radiation(boundaries),
        readings=assembler.readings(),
        share=share,
        ownership=_ownership(scenario, assembler),
        capacity_J_per_K=_capacities(scenario, assembler),
        joint_matrices=joints,
        boundaries=boundaries,
        radiators=tuple((r.surface.partition(".")[0], r.sink) for r in scenario.radiators),
        start_K=_start(scenario, assembler),
        epoch_ns=scenario.epoch_ns,
    )
    masses = [item for effect in scenario.hidden for item in effect.masses()]
    return _with_masses(field, assembler, masses) if masses else field


def _joint_matrices(scenario: Scenario, assembler: Assembler) -> Iterator[tuple[frozenset[str], csr_array]]:
    """Yield the pair of regions and the matrix of every joint and strap."""
    for joint in scenario.joints:
        yield frozenset(joint.between), assembler.joint(joint.between, joint.conductance_W_per_m2_K)
    for strap in scenario.straps:
        ends = frozenset(place.partition(".")[0] for place in strap.between)
        yield ends, assembler.strap(strap.between, strap.conductance_W_per_K)


def _ownership(scenario: Scenario, assembler: Assembler) -> FloatArray:
    """Return the part of each unknown that belongs to each region, (n_regions, n_unknowns), columns sum to one."""
    volumes = np.stack([unit_source.assemble(assembler.on(region.id)) for region in scenario.regions])
    return volumes / volumes.sum(axis=0)


def _capacities(scenario: Scenario, assembler: Assembler) -> dict[str, float]:
    """Return the heat capacity of each region, J/K."""
    return {
        region.id: float(
            scenario.depth_m
            * scenario.material(region).heat_capacity_J_per_m3_K
            * unit_source.assemble(assembler.on(region.id)).sum()
        )
        for region in scenario.regions
    }


def _start(scenario: Scenario, assembler: Assembler) -> FloatArray:
    """Return the temperatures at the start, (n_unknowns,); regions in contact meet at the later one's value."""
    start_K = np.full(assembler.basis.N, scenario.initial_K)
    for region in scenario.regions:
        if region.initial_K is not None:
            start_K[np.unique(assembler.on(region.id).element_dofs)] = region.initial_K
    return start_K


def _with_masses(field: Field, assembler: Assembler, masses: Sequence[Mass]) -> Field:
    """Return the field with lumped masses as further unknowns behind it."""
    count, size = len(masses), field.n_unknowns
    coupled, columns = csc_array((size, size)), []
    for item in masses:
        matrix, vector = assembler.spread_coupling(item.region, item.conductance_W_per_K)
        coupled = csc_array(coupled + matrix)
        columns.append(vector)
    link = csc_array(-np.stack(columns, axis=1))
    own = csc_array(np.diag([item.conductance_W_per_K for item in masses]))
    conductance = vstack([hstack([field.conductance_matrix + coupled, link]), hstack([link.T, own])])
    extra_capacity = diags_array([item.capacity_J_per_K for item in masses])
    start_K = [field.share[item.region] @ field.start_K for item in masses]

    def wide(matrix: csr_array) -> csr_array:
        return csr_array(hstack([matrix, csr_array((matrix.shape[0], count))]))

    def tall(array: FloatArray) -> FloatArray:
        return np.concatenate([array, np.zeros((count, *array.shape[1:]))])

    return replace(
        field,
        capacity_matrix=csc_array(block_diag([field.capacity_matrix, extra_capacity])),
        conductance_matrix=csc_array(conductance),
        inputs=tall(field.inputs),
        boundary_inputs=tall(field.boundary_inputs),
        radiation=replace(field.radiation, trace=wide(field.radiation.trace)),
        readings=wide(field.readings),
        share={region: tall(vector) for region, vector in field.share.items()},
        ownership=tall(field.ownership.T).T,
        joint_matrices={
            pair: csr_array(block_diag([matrix, csr_array((count, count))]))
            for pair, matrix in field.joint_matrices.items()
        },
        start_K=np.concatenate([field.start_K, start_K]),
    )
