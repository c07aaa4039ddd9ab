"""Gradients within nodes: a lumped node has one temperature, the body that it stands for has not.

A sensor is attached somewhere on that body. To leading order in the Biot number the temperature there differs from the mean by
what every heat flow into the node sets up within it, quasi-statically: T_sensor - T_mean = sum_l b_l q_l / G, with G the
conductance from the node to everything around it and b_l of the order of the Biot number, of either sign. Lumping is taken to be
sound up to a Biot number of 0.1 (Incropera et al., Fundamentals of Heat and Mass Transfer, section 5.2).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from twin_core._typing import FloatArray, IntArray
from twin_core.calibrate.likeliest import greatest_log_posterior, of_sensor, solved
from twin_core.calibrate.optimise import Optimum
from twin_core.calibrate.problem import Fit, Problem, Segment
from twin_core.calibrate.residual_noise import Whitener, fit_whitener, sensor_jacobians
from twin_core.effects.hidden_mass import first_order_lag
from twin_core.network.dynamics import fill_boundaries
from twin_core.network.model import Network
from twin_core.network.surroundings import surround
from twin_core.network.terms import Along, Conductors
from twin_core.simulate.rollout import Rollout

BIOT = 0.1
"""Standard deviation of every b_l before anything is measured, a Biot number; ``python -m benchmarks.gradients`` prints what they
explain at half, at double and without."""

LEAST_STEPS = 2
"""Steps before which the linearised model is not asked how much will stay: at the plain fit of a body with gradients it foretold
six times what stayed in the end."""

MOST_STEPS, MOST_STEPS_NEAR = 30, 10
SETTLED_SHARE = 1e-3
"""The fit ends where a step lowers the cost by no more, or after so many, fewer where it starts near another one: a limit of
time. Steps of Gauss and Newton that gain a thousandth leave less than a nat of ten thousand readings."""

LEAST_DAMPING, MOST_DAMPING = 1e-6, 1e4
"""Of the diagonal of the Hessian (Levenberg and Marquardt)."""


@dataclass(frozen=True)
class WithGradients:
    """A network fitted to open-loop trajectories where sensors may read off the mean of their node.

    Attributes
    ----------
    problem
        Of the same network, with what the gradients explain taken from the measured temperatures.
    optimum
        Of that problem.
    whitener
        The noise of what is left.
    biot : one (n_flows,) per sensor
        b_l of every heat flow into its node.
    log_posterior
        As ``Calibration.log_posterior``, averaged over the gradients.
    flows_K : one (n_rows, n_flows) per sensor
        The heat flows that set gradients up, see :func:`heat_flows_K`.
    """

    problem: Problem
    optimum: Optimum
    whitener: Whitener
    biot: tuple[FloatArray, ...]
    log_posterior: float
    flows_K: list[FloatArray]

    def covariance(self) -> FloatArray:
        """Return the covariance of the unknowns, whatever all b_l are, under the noise of what is left, (n_unknowns, n_unknowns).

        The upper left of the inverse Hessian over unknowns and b_l (Laplace's method), each residual whitened as its own noise.

        Raises
        ------
        ArithmeticError
            Where sensitivities are not finite, or tell some unknowns from nothing.
        """
        n, edges = self.problem.n_unknowns, np.cumsum([0, *(flows.shape[1] for flows in self.flows_K)])
        _, std = self.problem.prior()
        hessian = block_diag(np.diag(1.0 / std**2), np.eye(int(edges[-1])) / BIOT**2)
        for sensor, jacobian in sensor_jacobians(self.problem, self.optimum):
            own = np.r_[0:n, n + edges[sensor] : n + edges[sensor + 1]]
            rows = self.whitener.whiten(sensor, np.hstack([jacobian, self.flows_K[sensor]]))
            hessian[np.ix_(own, own)] += rows.T @ rows
        if not np.isfinite(hessian).all():
            raise ArithmeticError("the sensitivities are not finite")
        return solved(hessian, np.eye(len(hessian), n))[:n]

    @property
    def residuals(self) -> list[FloatArray]:
        """What is left per segment in K, (n_samples, n_sensors), NaN where missing."""
        return self.problem.residuals(self.optimum.fit)


@dataclass(frozen=True)
class _Point:
    """A point of the fit: unknowns, the model and its heat flows there, what stays beside its gradients, these, and the cost."""

    unknowns: FloatArray
    fit: Fit
    flows_K: list[FloatArray]
    left_K: FloatArray
    biot: FloatArray
    cost: float


def with_gradients(
    problem: Problem, optimum: Optimum, near: FloatArray | None = None, most_left: float = np.inf
) -> WithGradients | None:
    """Fit gradients within the nodes beside all unknowns, from an open-loop optimum.

    A step takes the heat flows as they are; at each point they are its own, for where parameters make up for gradients the
    flows of the plain fit are wrong. G is that of the plain fit: otherwise gradients would grow with falling conductances.

    Parameters
    ----------
    problem, optimum
        A network fitted to open-loop trajectories.
    near : (n_unknowns,)
        Where such a fit of a simpler network has ended: the better start counts.
    most_left
        Variance beyond the sensors' noise, in units of that noise, that may stay.

    Returns
    -------
    WithGradients, or None
        None where more would stay, as the linearised model foretells after some steps: gradients are not what is missing then.

    Raises
    ------
    ArithmeticError
        Where sensitivities or heat flows are not finite.
    """
    conductance = conductances_W_per_K(problem, optimum.unknowns, optimum.fit)
    mean, std = problem.prior()

    def at(unknowns: FloatArray, fit: Fit) -> _Point:
        flows_K = heat_flows_K(problem, unknowns, fit, conductance)
        if not all(np.isfinite(flows).all() for flows in flows_K):
            return _Point(unknowns, fit, flows_K, np.zeros((0, 0)), np.zeros(0), np.inf)
        left_K, biot = _beside_gradients(problem, fit, flows_K)
        against = float((((unknowns - mean) / std) ** 2).sum() + ((biot / BIOT) ** 2).sum())
        cost = 0.5 * (float(np.nansum((left_K / problem.noise_K) ** 2)) + against)
        return _Point(unknowns, fit, flows_K, left_K, biot, cost)

    here, damping = at(optimum.unknowns, optimum.fit), LEAST_DAMPING
    if not np.isfinite(here.cost):
        raise ArithmeticError("the heat flows are not finite")
    if near is not None and np.isfinite((fit := problem.solve(near, near=optimum.fit)).cost):
        here = min(here, at(near, fit), key=lambda point: point.cost)
    enough = 0.5 * (1.0 + most_left) * float(np.isfinite(here.left_K).sum())
    for steps in range(MOST_STEPS if near is None else MOST_STEPS_NEAR):
        before = here.cost
        hessian, gradient = _equations(problem, optimum, here)
        if steps >= LEAST_STEPS and here.cost - 0.5 * float(gradient @ solved(hessian, gradient)) > enough:
            return None
        while damping < MOST_DAMPING:
            step = solved(hessian + damping * np.diag(np.diag(hessian)), -gradient)[: problem.n_unknowns]
            fit = problem.solve(here.unknowns + step, near=here.fit)
            there = at(here.unknowns + step, fit) if np.isfinite(fit.cost) else here
            if there.cost < here.cost:
                here, damping = there, max(damping / 10.0, LEAST_DAMPING)
                break
            damping *= 10.0
        if before - here.cost <= SETTLED_SHARE * before:
            break
    ends = np.cumsum([segment.record.time_s.size for segment in problem.segments])[:-1]
    left_K = np.split(here.left_K, ends)
    of_mean = replace(
        problem,
        segments=tuple(
            replace(segment, measured_K=predicted + left)
            for segment, predicted, left in zip(problem.segments, here.fit.predicted_K, left_K, strict=True)
        ),
    )
    fit = replace(here.fit, cost=here.cost - 0.5 * float(((here.biot / BIOT) ** 2).sum()))
    # The Hessian is that of the last step: another evaluation would tell no more to anybody.
    found = Optimum(here.unknowns, fit, hessian[: problem.n_unknowns, : problem.n_unknowns], "converged", 0)
    whitener = fit_whitener(of_mean, left_K)
    plain = replace(optimum, unknowns=here.unknowns, fit=here.fit)
    log_posterior = greatest_log_posterior(
        problem, plain, whitener, lambda u, f: heat_flows_K(problem, u, f, conductance), here.biot, BIOT
    )
    biot = tuple(here.biot[own] for own in of_sensor(here.flows_K))
    return WithGradients(of_mean, found, whitener, biot, log_posterior, here.flows_K)


def _equations(problem: Problem, optimum: Optimum, here: _Point) -> tuple[FloatArray, FloatArray]:
    """Return Hessian (Gauss and Newton) and gradient of the cost over unknowns and all b_l."""
    where = of_sensor(here.flows_K)
    mean, std = problem.prior()
    hessian = block_diag(np.diag(1.0 / std**2), np.eye(here.biot.size) / BIOT**2)
    gradient = np.concatenate([(here.unknowns - mean) / std**2, here.biot / BIOT**2])
    for sensor, jacobian in sensor_jacobians(problem, replace(optimum, unknowns=here.unknowns, fit=here.fit)):
        seen = np.isfinite(here.left_K[:, sensor])
        own = np.r_[0 : problem.n_unknowns, problem.n_unknowns + np.arange(here.biot.size)[where[sensor]]]
        rows = np.hstack([jacobian, here.flows_K[sensor]])[seen] / problem.noise_K[sensor]
        hessian[np.ix_(own, own)] += rows.T @ rows
        gradient[own] -= rows.T @ (here.left_K[seen, sensor] / problem.noise_K[sensor])
    if not (np.isfinite(hessian).all() and np.isfinite(gradient).all()):
        raise ArithmeticError("the sensitivities are not finite")
    return hessian, gradient


def _beside_gradients(problem: Problem, fit: Fit, flows_K: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return what a fit leaves beside the gradients that explain most of it, (n_rows, n_sensors), and their b_l."""
    left_K = np.concatenate(problem.residuals(fit))
    biot = np.zeros(sum(flows.shape[1] for flows in flows_K))
    for sensor, (flows, own) in enumerate(zip(flows_K, of_sensor(flows_K), strict=True)):
        seen = np.isfinite(left_K[:, sensor])
        rows = flows[seen] / problem.noise_K[sensor]
        hessian = rows.T @ rows + np.eye(flows.shape[1]) / BIOT**2
        biot[own] = solved(hessian, rows.T @ (left_K[seen, sensor] / problem.noise_K[sensor]))
        left_K[:, sensor] -= flows @ biot[own]
    return left_K, biot


def conductances_W_per_K(problem: Problem, unknowns: FloatArray, fit: Fit) -> FloatArray:
    """Return by how much the heat into each node falls with its temperature, mean over all segments, (n_nodes,)."""
    return _conductances_W_per_K(problem.network, _all_links(problem, unknowns, fit))


def _conductances_W_per_K(network: Network, links: list[list["_Link"]]) -> FloatArray:
    """The same of the heat flows per segment."""
    found = np.zeros(len(network.nodes))
    for link in (link for of_segment in links for link in of_segment):
        found[link.node] += link.conductance_W_per_K / len(links)
    return found


def _all_links(problem: Problem, unknowns: FloatArray, fit: Fit) -> list[list["_Link"]]:
    """Return every heat flow into a node along the trajectories, per segment."""
    network, values = problem.network, problem.values(unknowns)
    paths = zip(problem.segments, fit.trajectories, strict=True)
    return [_links(network, values, _points(network, values, segment, path)) for segment, path in paths]


def heat_flows_K(problem: Problem, unknowns: FloatArray, fit: Fit, conductance: FloatArray) -> list[FloatArray]:
    """Return per sensor q_l / G of every heat flow into its node at the samples of all segments, (n_rows, n_flows) in K.

    Parameters
    ----------
    problem
        With the network.
    unknowns : (n_unknowns,)
    fit
        The model there: heat flows are those along its trajectories.
    conductance : (n_nodes,)
        G in W/K.
    """
    network, values = problem.network, problem.values(unknowns)
    links = _all_links(problem, unknowns, fit)
    own_W_per_K, found = _conductances_W_per_K(network, links), []
    for sensor, state in zip(network.spec.sensors, network.sensor_node.tolist(), strict=True):
        node = network.layout.node(network.layout.sensor_node(sensor))
        own = [k for k, link in enumerate(links[0]) if link.node == node and conductance[node] > 0.0]
        parts = []
        for of_segment, s in zip(links, problem.segments, strict=True):
            columns = [of_segment[k].heat_W[_at_samples(s)] / conductance[node] for k in own]
            if state != node and own_W_per_K[state] > 0.0:  # a sensor that lags behind what it is attached to
                tau_s = float(values[network.capacity_index[state]] / own_W_per_K[state])
                columns = [first_order_lag(s.record.time_s, column, tau_s) for column in columns]
            parts.append(np.stack(columns, axis=1) if columns else np.zeros((s.record.time_s.size, 0)))
        found.append(np.concatenate(parts))
    return found


@dataclass(frozen=True)
class _Link:
    """One heat flow into a node, (n_points,), and by how much it falls with its temperature."""

    node: int
    heat_W: FloatArray
    conductance_W_per_K: float


def _links(network: Network, values: FloatArray, along: Along) -> list[_Link]:
    """Return every heat flow into a node. What a thermostat remembers is no heat."""
    links = []
    for term, index in zip(network.terms, network.term_indices, strict=True):
        part = term.evaluate(along, values[index])
        if isinstance(term, Conductors):
            links += [_Link(e.node, values[index][e.item] * e.series, values[index][e.item]) for e in part.d_values]
            continue
        for k, node in enumerate(part.nodes):
            if part.relay is not None:
                falls = 0.0
            elif part.fourth_W_per_K4 is not None:
                falls = -4.0 * float(part.fourth_W_per_K4[k, k] * np.mean(along.temperatures_K[:, node] ** 3))
            else:
                falls = -float(np.mean(part.d_temperature[:, k, k]))
            if part.relay is None or node != part.relay.memory:
                links.append(_Link(node, np.broadcast_to(part.heat_W[:, k], along.time_s.shape), max(falls, 0.0)))
    return links


def _points(network: Network, values: FloatArray, segment: Segment, path: Rollout) -> Along:
    """Return both ends of every step along a trajectory."""
    forcing = segment.forcing
    boundaries = fill_boundaries(network, values, forcing.boundaries_flat_K(0, forcing.n_steps))
    points = forcing.along(path.stages_K.reshape(-1, path.stages_K.shape[2]), boundaries, 0, forcing.n_steps)
    return surround(network, values, points).along


def _at_samples(segment: Segment) -> IntArray:
    """Return which of the points along a trajectory is at each sample: the end of the step before it."""
    return np.maximum(2 * segment.forcing.sample_step - 1, 0)
