"""Which parameters of a large model are worth varying: chosen by how they move the sensors, before anything is fitted."""

from collections.abc import Sequence

import numpy as np

from twin_core._typing import FloatArray
from twin_core.calibrate.approach import coarse_problem
from twin_core.calibrate.noise import sensor_noise_K
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.calibrate.second_order import sampling_step_s
from twin_core.calibrate.starting import table_levels
from twin_core.errors import ModelError, NoSolutionError
from twin_core.network.calibrated import with_values
from twin_core.network.model import build_network
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

FLAT_STD = 10.0
"""Standard deviation of an unknown that has no prior, an unknown boundary, in K: what a room or a panel may be off by. It ranks,
and bends no fit."""
NOTHING = 1e-12
"""Share of the largest response below which a parameter moves nothing that the chosen ones do not."""


def by_sensitivity(spec: TwinSpec, records: Sequence[Record], most: int) -> tuple[TwinSpec, tuple[str, ...]]:
    """Hold all but the parameters that the sensors tell most of.

    The first one chosen moves the readings most, each further one adds most to what those before it can do: a parameter whose
    response others can imitate is worth nothing beside them. Responses are those at the guesses, to first order, in units of the
    sensors' noise and for one standard deviation of the guess; what initial temperatures can do is projected off.

    Source: K. Z. Yao et al., "Modeling ethylene/butene copolymerization with multi-site catalysts: parameter estimability and
    experimental design", Polymer Reaction Engineering 11 (2003) 563, section 3.

    Parameters
    ----------
    spec
        The declared network.
    records
        Segments of telemetry in SI.
    most
        How many parameters to leave free at most.

    Returns
    -------
    TwinSpec, tuple of str
        The network with the other parameters known at their guesses, and their names.

    Raises
    ------
    ModelError
        If ``most`` is below one.
    NoSolutionError
        If the heat balance has no solution at the guesses.
    """
    if most < 1:
        raise ModelError(f"at least one parameter must stay free (got {most})")
    knots = table_levels(spec, records)
    network = build_network(spec, table_knots=knots)
    step_s = 1.5 * sampling_step_s(records)
    problem = build_problem(network, records, sensor_noise_K(spec, list(records)), step_s)
    names = [network.parameters.parameters[int(i)].name for i in network.parameters.free_index]
    if len(names) <= most:
        return spec, ()
    chosen = {names[position] for position in pivots(responses(coarse_problem(problem, step_s)), most)}
    values = network.parameters.as_dict()
    known = load_spec(with_values(spec, {name: values[name] for name in names if name not in chosen}))
    free = build_network(known, table_knots=knots).parameters.free_names
    return known, tuple(name for name in names if name not in free)


def responses(problem: Problem) -> FloatArray:
    """Return the Gram matrix of the responses of all readings to the free parameters, (n_free, n_free).

    In units of the noise, for one standard deviation of each prior; initial temperatures are projected off.
    """
    start = problem.start()
    fit = problem.solve(start)
    if len(fit.predicted_K) < len(problem.segments) or not np.isfinite(fit.cost):
        raise NoSolutionError("the heat balance has no solution at the guesses, from which sensitivities are taken")
    n = problem.n_free
    grams = np.zeros((len(problem.segments), n + problem.n_nodes, n + problem.n_nodes))
    for i, samples, block in problem.jacobian_stretches(start, fit):
        read = np.isfinite(problem.segments[i].measured_K[samples])
        columns = (block / problem.noise_K[:, None])[read]
        grams[i] += columns.T @ columns
    total = np.zeros((n, n))
    for gram, segment in zip(grams, problem.segments, strict=True):
        known = gram[n:, n:] + np.diag(1.0 / segment.start_std_K**2)
        total += gram[:n, :n] - gram[:n, n:] @ np.linalg.solve(known, gram[n:, :n])
    std = np.where(np.isfinite(problem.network.parameters.prior_std), problem.network.parameters.prior_std, FLAT_STD)
    return total * std[:, None] * std


def pivots(gram: FloatArray, most: int) -> list[int]:
    """Return the first pivots of a Cholesky decomposition that takes the largest remaining diagonal each time."""
    left = gram.copy()
    found: list[int] = []
    for _ in range(min(most, gram.shape[0])):
        best = int(np.argmax(np.diag(left)))
        if left[best, best] <= NOTHING * gram.diagonal().max():
            break
        found.append(best)
        left -= np.outer(left[:, best], left[best]) / left[best, best]
        left[found, found] = -np.inf
    return found
