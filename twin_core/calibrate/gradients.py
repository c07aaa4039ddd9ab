"""Gradients within nodes: a lumped node has one temperature, the body that it stands for has not.

A sensor is attached somewhere on that body. To leading order in the Biot number the temperature there differs from the mean by
what every heat flow into the node sets up within it, quasi-statically: T_sensor - T_mean = sum_l b_l q_l / G, with G the
conductance from the node to everything around it and b_l a number of the order of the Biot number, of either sign. Lumping is
taken to be sound up to a Biot number of 0.1 (Incropera et al., Fundamentals of Heat and Mass Transfer, section 5.2).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from twin_core._typing import FloatArray
from twin_core.calibrate.optimise import Optimum
from twin_core.calibrate.problem import Fit, Problem, Segment
from twin_core.calibrate.residual_noise import Whitener, fit_whitener, sensor_jacobians
from twin_core.network.dynamics import fill_boundaries
from twin_core.network.model import Network
from twin_core.network.surroundings import surround
from twin_core.network.terms import Along, Conductors
from twin_core.simulate.rollout import Rollout

BIOT = 0.1
"""Standard deviation of the numbers b_l."""

MOST_STEPS = 20
SETTLED_NATS = 0.1
LEAST_DAMPING, MOST_DAMPING = 1e-6, 1e4


@dataclass(frozen=True)
class WithGradients:
    """Open-loop residuals once more, where sensors may read off the mean of their node.

    Attributes
    ----------
    residuals : one (n_samples, n_sensors) per segment
        Measured minus modelled in K, NaN where missing.
    whitener
        Their noise.
    log_posterior
        As ``Calibration.log_posterior``, averaged over the gradients.
    """

    residuals: tuple[FloatArray, ...]
    whitener: Whitener
    log_posterior: float


def with_gradients(problem: Problem, optimum: Optimum) -> WithGradients:
    """Fit gradients within the nodes beside all unknowns, from an open-loop optimum.

    Parameters
    ----------
    problem, optimum
        A network fitted to open-loop trajectories; heat flows are those along its trajectories.

    Raises
    ------
    ArithmeticError
        Where sensitivities are not finite.
    """
    flows = _flows(problem, optimum)
    edges = np.cumsum([0, *(column.shape[1] for column in flows)])
    of_sensor = [slice(a, b) for a, b in pairwise(edges)]
    mean, std = problem.prior()

    def at(unknowns: FloatArray, fit: Fit) -> _Point:
        left, told = _beside_flows(problem, fit, flows, of_sensor)
        against = (((unknowns - mean) / std) ** 2).sum() + ((told / BIOT) ** 2).sum()
        return _Point(unknowns, fit, left, told, 0.5 * float(np.nansum((left / problem.noise_K) ** 2) + against))

    here, damping = at(optimum.unknowns, optimum.fit), LEAST_DAMPING
    for _ in range(MOST_STEPS):
        hessian, gradient = _equations(problem, here, optimum, flows, of_sensor)
        before = here.cost
        while damping < MOST_DAMPING:
            step = _solved(hessian + damping * np.diag(np.diag(hessian)), -gradient)[: problem.n_unknowns]
            fit = problem.solve(here.unknowns + step, near=here.fit)
            there = at(here.unknowns + step, fit) if np.isfinite(fit.cost) else None
            if there is not None and there.cost < here.cost:
                here, damping = there, max(damping / 10.0, LEAST_DAMPING)
                break
            damping *= 10.0
        if before - here.cost < SETTLED_NATS:
            break
    rows_of = np.cumsum([segment.record.time_s.size for segment in problem.segments])[:-1]
    residuals = tuple(np.split(here.left_K, rows_of))
    whitener = fit_whitener(problem, residuals)
    priors = 0.5 * float((((here.unknowns - mean) / std) ** 2).sum())
    starts = 0.5 * (problem.n_unknowns - problem.n_free) * float(np.log(problem.n_samples))
    paid = _paid(whitener, flows, here.told)
    return WithGradients(residuals, whitener, whitener.log_likelihood - priors - starts - paid)


def _equations(
    problem: Problem, here: "_Point", optimum: Optimum, flows: list[FloatArray], of_sensor: list[slice]
) -> tuple[FloatArray, FloatArray]:
    """Return Hessian (Gauss and Newton) and gradient of the cost over unknowns and gradients."""
    mean, std = problem.prior()
    n = problem.n_unknowns
    hessian = np.diag(np.concatenate([1.0 / std**2, np.full(here.told.size, BIOT**-2)]))
    gradient = np.concatenate([(here.unknowns - mean) / std**2, here.told / BIOT**2])
    point = replace(optimum, unknowns=here.unknowns, fit=here.fit)
    for sensor, jacobian in sensor_jacobians(problem, point):
        seen = np.isfinite(here.left_K[:, sensor])
        own = np.r_[0:n, n + np.arange(here.told.size)[of_sensor[sensor]]]
        rows = np.hstack([jacobian, flows[sensor]])[seen] / problem.noise_K[sensor]
        hessian[np.ix_(own, own)] += rows.T @ rows
        gradient[own] -= rows.T @ (here.left_K[seen, sensor] / problem.noise_K[sensor])
    if not (np.isfinite(hessian).all() and np.isfinite(gradient).all()):
        raise ArithmeticError("the sensitivities are not finite")
    return hessian, gradient


@dataclass(frozen=True)
class _Point:
    """A point of the search: unknowns, the model there, what it leaves beside its gradients, these, and the cost."""

    unknowns: FloatArray
    fit: Fit
    left_K: FloatArray
    told: FloatArray
    cost: float


def _paid(whitener: Whitener, flows: list[FloatArray], told: FloatArray) -> float:
    """Return what gradients cost in nats: their priors, and the share of them that the readings leave (Laplace)."""
    paid = 0.5 * float(((told / BIOT) ** 2).sum())
    for sensor, columns in enumerate(flows):
        if columns.shape[1]:
            rows = BIOT * whitener.whiten(sensor, columns)
            paid += 0.5 * float(np.linalg.slogdet(np.eye(rows.shape[1]) + rows.T @ rows)[1])
    return paid


def _beside_flows(
    problem: Problem, fit: Fit, flows: list[FloatArray], of_sensor: list[slice]
) -> tuple[FloatArray, FloatArray]:
    """Return what a fit leaves beside the gradients that explain most of it, (n_rows, n_sensors), and these."""
    left = np.concatenate(problem.residuals(fit))
    told = np.zeros(sum(columns.shape[1] for columns in flows))
    for sensor, (columns, own) in enumerate(zip(flows, of_sensor, strict=True)):
        if columns.shape[1]:
            seen = np.isfinite(left[:, sensor])
            rows = columns[seen] / problem.noise_K[sensor]
            hessian = rows.T @ rows + np.eye(columns.shape[1]) / BIOT**2
            told[own] = _solved(hessian, rows.T @ (left[seen, sensor] / problem.noise_K[sensor]))
            left[:, sensor] -= columns @ told[own]
    return left, told


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve positive definite equations, every unknown scaled alike; ArithmeticError where they are not."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    try:
        return np.asarray(cho_solve(cho_factor(matrix * scale[:, None] * scale), right * scale) * scale)
    except np.linalg.LinAlgError as error:
        raise ArithmeticError("the unknowns are not told apart") from error


def _flows(problem: Problem, optimum: Optimum) -> list[FloatArray]:
    """Return per sensor q_l / G of every heat flow into its node, (n_rows, n_flows) in K, over all segments."""
    network = problem.network
    values = problem.values(optimum.unknowns)
    pairs = zip(problem.segments, optimum.fit.trajectories, strict=True)
    parts = [_links(network, values, _points(network, values, segment, path)) for segment, path in pairs]
    nodes = [link[0] for link in parts[0]]
    conductance = np.zeros(len(network.nodes))
    for part in parts:
        for node, _, of_link in part:
            conductance[node] += of_link / len(parts)
    columns: list[FloatArray] = []
    for sensor in network.spec.sensors:
        node = network.layout.node(network.layout.sensor_node(sensor))
        own = [k for k, at in enumerate(nodes) if at == node and conductance[node] > 0.0]
        stacked = [
            np.stack([np.broadcast_to(part[k][1], s.forcing.n_steps * 2)[_at_samples(s)] for k in own], axis=1)
            if own
            else np.zeros((s.record.time_s.size, 0))
            for part, s in zip(parts, problem.segments, strict=True)
        ]
        columns.append(np.concatenate(stacked) / max(conductance[node], 1e-300))
    return columns


def _points(network: Network, values: FloatArray, segment: Segment, path: Rollout) -> Along:
    """Return both ends of every step along a trajectory."""
    forcing = segment.forcing
    boundaries = fill_boundaries(network, values, forcing.boundaries_flat_K(0, forcing.n_steps))
    points = forcing.along(path.stages_K.reshape(-1, path.stages_K.shape[2]), boundaries, 0, forcing.n_steps)
    return surround(network, values, points).along


def _at_samples(segment: Segment) -> FloatArray:
    """Return which of the points of :func:`_points` is at each sample: the end of the step before it."""
    return np.maximum(2 * segment.forcing.sample_step - 1, 0)


def _links(network: Network, values: FloatArray, along: Along) -> list[tuple[int, FloatArray, float]]:
    """Return every heat flow as (node, (n_points,) in W into it, its conductance in W/K); a relay's memory takes no heat."""
    links = []
    for term, index in zip(network.terms, network.term_indices, strict=True):
        part = term.evaluate(along, values[index])
        if isinstance(term, Conductors):
            links += [(e.node, values[index][e.item] * e.series, float(values[index][e.item])) for e in part.d_values]
            continue
        for k, node in enumerate(part.nodes):
            if part.relay is not None and node == part.relay.memory:
                continue
            if part.fourth_W_per_K4 is not None:
                slope = 4.0 * part.fourth_W_per_K4[k, k] * float(np.mean(along.temperatures_K[:, node] ** 3))
            else:
                slope = 0.0 if part.relay is not None else float(part.d_temperature[:, k, k].mean())
            links.append((node, part.heat_W[:, k], max(-slope, 0.0)))
    return links


def flows_into_sensed_nodes(problem: Problem, optimum: Optimum) -> Iterator[tuple[str, FloatArray]]:
    """Yield each sensor with its node's heat flows over its conductance."""
    yield from zip(problem.network.spec.sensors, _flows(problem, optimum), strict=True)
