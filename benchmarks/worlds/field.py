"""Bodies in contact as one system of heat balances: capacities, conduction, contacts, radiating faces, inputs, sensors."""

from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import block_diag, coo_matrix, csc_matrix, csr_matrix

from benchmarks.worlds.body import Body, Window

Spot = tuple[str, str, Window]
"""A place: body, face, and the part of the face."""


@dataclass(frozen=True)
class Contact:
    """Two faces pressed together: heat flows from point to point by ``conductance_W_per_m2_K``."""

    spots: tuple[Spot, Spot]
    conductance_W_per_m2_K: float


@dataclass(frozen=True)
class Plan:
    """What a spacecraft is made of.

    Attributes
    ----------
    bodies
        By name.
    groups
        Declared node -> its bodies, the main one first.
    contacts
        Between bodies, of one node or of two.
    radiators
        Declared node -> spot and emissivity of its radiating face.
    mounts
        Spot, boundary and conductance in W/K of linear couplings to boundaries.
    inputs
        Channel -> spot that its heat is spread over.
    sensors
        Channel -> body, face and the point on it.
    heater_spots
        Declared node -> where undeclared heat comes in.
    """

    bodies: dict[str, Body]
    groups: dict[str, tuple[str, ...]]
    contacts: list[Contact]
    radiators: dict[str, tuple[Spot, float]]
    mounts: list[tuple[Spot, str, float]]
    inputs: dict[str, Spot]
    sensors: dict[str, tuple[str, str, tuple[float, float]]]
    heater_spots: dict[str, Spot]

    def group_of(self, body: str) -> str:
        """Return the declared node that a body belongs to."""
        return next(group for group, bodies in self.groups.items() if body in bodies)


@dataclass(frozen=True)
class Field:
    """The semi-discrete heat balance: ``C dT/dt = -K T + boundaries + inputs + radiation``, all per vertex.

    Attributes
    ----------
    capacity_J_per_K : (n,)
    stiffness_W_per_K : (n, n)
        Conduction, contacts and the couplings to boundaries.
    to_boundary_W_per_K
        Boundary -> (n,).
    radiating_m2
        Node -> emissivity times area of every vertex, (n,).
    inputs
        Channel -> share of its heat, (n,).
    sensors
        Channel -> weights of the vertices, (n,).
    between
        Pair of nodes -> what their contacts add to the stiffness.
    shares
        Node -> share of its capacity that every vertex has, (n,).
    spots
        Node -> share of undeclared heat that every vertex gets, (n,).
    """

    capacity_J_per_K: np.ndarray
    stiffness_W_per_K: csr_matrix
    to_boundary_W_per_K: dict[str, np.ndarray]
    radiating_m2: dict[str, np.ndarray]
    inputs: dict[str, np.ndarray]
    sensors: dict[str, np.ndarray]
    between: dict[tuple[str, str], csr_matrix]
    shares: dict[str, np.ndarray]
    spots: dict[str, np.ndarray]
    node_capacity_J_per_K: dict[str, float]
    conductance_W_per_K: dict[tuple[str, str], float] = field(default_factory=dict)

    @property
    def n(self) -> int:
        """How many vertices there are."""
        return self.capacity_J_per_K.size


class _Assembly:
    """Bodies side by side, each with its range of vertices."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        counts = [body.n_vertices for body in plan.bodies.values()]
        self.start = dict(zip(plan.bodies, np.concatenate([[0], np.cumsum(counts)[:-1]]).tolist(), strict=True))
        self.n = int(sum(counts))

    def placed(self, body: str, local: np.ndarray) -> np.ndarray:
        """Return a vector over one body as one over all."""
        full = np.zeros(self.n)
        full[self.start[body] : self.start[body] + local.size] = local
        return full

    def spread(self, spot: Spot) -> np.ndarray:
        """Return the share of a heat spread over a spot that every vertex gets."""
        body, face, window = spot
        return self.placed(body, self.plan.bodies[body].patch(face, window).spread)

    def area_m2(self, spot: Spot) -> float:
        """Return the area of a spot."""
        return float(self.plan.bodies[spot[0]].patch(*spot[1:]).area_m2.sum())

    def contact(self, contact: Contact) -> tuple[csr_matrix, float]:
        """Return what a contact adds to the stiffness, and its conductance in W/K."""
        bodies = [self.plan.bodies[spot[0]] for spot in contact.spots]
        own = [b.cuts(spot[1], spot[2]) for b, spot in zip(bodies, contact.spots, strict=True)]
        cuts = (np.union1d(own[0][0], own[1][0]), np.union1d(own[0][1], own[1][1]))
        patches = [b.patch(spot[1], spot[2], cuts) for b, spot in zip(bodies, contact.spots, strict=True)]
        rows = [self._wide(spot[0], p.weights) for spot, p in zip(contact.spots, patches, strict=True)]
        jump = (rows[0] - rows[1]).tocsr()
        conductance = contact.conductance_W_per_m2_K * patches[0].area_m2
        return (jump.T @ jump.multiply(conductance[:, None])).tocsr(), float(conductance.sum())

    def _wide(self, body: str, weights: csr_matrix) -> csr_matrix:
        entries = weights.tocoo()
        place = (entries.row, entries.col + self.start[body])
        return coo_matrix((entries.data, place), shape=(weights.shape[0], self.n)).tocsr()


def assemble(plan: Plan) -> Field:
    """Return the heat balance of a plan."""
    over = _Assembly(plan)
    parts = {name: body.matrices() for name, body in plan.bodies.items()}
    capacity = np.concatenate([part[0] for part in parts.values()])
    stiffness = csr_matrix(block_diag([part[1] for part in parts.values()]))
    between: dict[tuple[str, str], csr_matrix] = {}
    conductance: dict[tuple[str, str], float] = {}
    for contact in plan.contacts:
        matrix, total = over.contact(contact)
        stiffness = stiffness + matrix
        a, b = sorted((plan.group_of(spot[0]) for spot in contact.spots), key=list(plan.groups).index)
        if a != b:
            between[a, b] = between.get((a, b), csr_matrix(matrix.shape)) + matrix
            conductance[a, b] = conductance.get((a, b), 0.0) + total
    to_boundary: dict[str, np.ndarray] = {}
    for spot, boundary, total in plan.mounts:
        to_boundary[boundary] = to_boundary.get(boundary, np.zeros(over.n)) + total * over.spread(spot)
        key = plan.group_of(spot[0]), boundary
        conductance[key] = conductance.get(key, 0.0) + total
    for row in to_boundary.values():
        stiffness = stiffness + csr_matrix(csc_matrix(np.diag(row)))
    own = {g: np.sum([over.placed(b, parts[b][0]) for b in bodies], axis=0) for g, bodies in plan.groups.items()}
    return Field(
        capacity,
        stiffness.tocsr(),
        to_boundary,
        {node: e * over.area_m2(spot) * over.spread(spot) for node, (spot, e) in plan.radiators.items()},
        {channel: over.spread(spot) for channel, spot in plan.inputs.items()},
        {c: over.placed(b, plan.bodies[b].point(face, *at)) for c, (b, face, at) in plan.sensors.items()},
        between,
        {group: np.asarray(row / row.sum()) for group, row in own.items()},
        {node: over.spread(spot) for node, spot in plan.heater_spots.items()},
        {group: float(row.sum()) for group, row in own.items()},
        conductance,
    )
