"""The heat as a polynomial of temperature, learned from the samples themselves under the model's full covariance.

Smoothed forces are strongly correlated in time, so fitting a curve through them as if they were independent gives weights
that are far too certain. Here the weights enter the heat balance: y = network + sum_j w_j (response to term j along the
smoothed temperatures) + latent force as the misfit + noise. One filter whitens samples and responses together, so that
every degree, and every combination of degrees over the forces, is a small ridge regression with an exact evidence.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.errors import ModelError
from twin_core.gp.basis import Basis
from twin_core.gp.checked import numbers, positive, whole
from twin_core.gp.columns import whiten_responses
from twin_core.gp.discretise import discretise
from twin_core.gp.polynomial import ForcePolynomial
from twin_core.latent_force.augment import Force, augment, drive, step_table
from twin_core.latent_force.evidence import Choice, Family, Problem
from twin_core.latent_force.model import ForceModel
from twin_core.latent_force.smooth import LatentForce

MISFIT_SHARES = (1e-4, 1e-2, 3e-2, 0.1, 0.3, 1.0)
"""Misfits tried, as shares of the latent force's own standard deviation; the first is none at all."""


@dataclass(frozen=True)
class LearnedHeatFlow:
    """Polynomials of all forces, learned together.

    Attributes
    ----------
    polynomials
        One per force that was learned.
    degrees
        Theirs.
    misfit_W : (n_forces,)
        Standard deviation of the heat that is left beside the polynomial, averaged over the misfits tried.
    log_evidence
        ln p(y | degrees).
    log_bayes_factor
        Of the polynomials against the latent force alone, a heat that does not repeat with temperature. Negative: the
        data do not support a static heat flow, however well its curve looks.
    evidence_by_degree
        Degree common to all forces -> ln evidence.
    """

    polynomials: tuple[ForcePolynomial, ...]
    degrees: tuple[int, ...]
    misfit_W: FloatArray
    log_evidence: float
    log_bayes_factor: float
    evidence_by_degree: dict[int, float]


def learn_heat_flow(
    model: ForceModel,
    observations: FloatArray,
    values: FloatArray,
    smoothed: LatentForce,
    *,
    max_degree: int = 5,
    degree: int | None = None,
    boundary_K: FloatArray | None = None,
    vanishing: bool | None = None,
    only: Sequence[int] | None = None,
) -> LearnedHeatFlow:
    """Learn each force, or some of them, as a polynomial of its node's temperature.

    Parameters
    ----------
    model
        Network, forces, sensors; its kernel becomes that of the misfit.
    observations : (n_times, n_sensors)
        NaN where missing.
    values : (n_free,)
        Parameters, as fitted; the forces' ``std`` is scaled down to what the polynomial leaves.
    smoothed
        Temperatures along which the terms are evaluated.
    max_degree
        Highest degree tried.
    degree
        One degree for all forces instead of the evidence's choice.
    boundary_K : (n_times,), optional
        Boundary temperature, a second variable.
    vanishing
        Whether the heat is a polynomial of the difference to the boundary that vanishes with it. By default the
        evidence decides where a boundary is given.
    only
        Positions of the forces to be learned, in the order of the result; the others stay as they are. All by default.

    Raises
    ------
    ModelError
        The model has no force, a learned one shares hyperparameters with one that stays, or a shape does not fit.
    """
    picked = tuple(range(len(model.forces))) if only is None else tuple(only)
    if not picked:
        raise ModelError("the model has no latent force to learn a heat flow from")
    values = positive(values, model.names)
    n_times = model.network(values[list(model.network_index)]).time_s.size
    for k in picked:
        if k not in range(len(model.forces)) or picked.count(k) > 1:
            raise ModelError(f"only: there is no force {k}, or it is named twice; the model has {len(model.forces)}")
    if smoothed.mean_W.shape != (n_times, len(model.forces)):
        raise ModelError(f"smoothed has {smoothed.mean_W.shape} forces, the model needs {(n_times, len(model.forces))}")
    whole(
        max_degree if degree is None else degree,
        "max_degree" if degree is None else "degree",
        lowest=int(bool(vanishing)),
    )
    if boundary_K is not None:
        boundary_K = numbers(boundary_K, "boundary_K", (n_times,))
    _refuse_shared(model, picked)
    forms = [vanishing] if vanishing is not None else [False] if boundary_K is None else [False, True]
    learned = [
        _learn(model, observations, values, smoothed, _Range(picked, max_degree, degree, boundary_K, form))
        for form in forms
    ]
    return max(learned, key=lambda found: found.log_evidence)


@dataclass(frozen=True)
class _Range:
    """What may be learned: which forces (their positions), degrees, second variable, form."""

    picked: tuple[int, ...]
    max_degree: int
    degree: int | None
    boundary_K: FloatArray | None
    vanishing: bool

    @property
    def degrees(self) -> range:
        """Degrees tried."""
        lowest = int(self.vanishing)
        return range(lowest, self.max_degree + 1) if self.degree is None else range(self.degree, self.degree + 1)


def _learn(
    model: ForceModel, observations: FloatArray, values: FloatArray, smoothed: LatentForce, allowed: _Range
) -> LearnedHeatFlow:
    """Learn within one form of basis: misfit and degrees by evidence."""
    forces = [model.forces[k] for k in allowed.picked]
    bases = [
        Basis.over(
            allowed.degrees[-1], smoothed.temperature_K[:, f.node], allowed.boundary_K, vanishing=allowed.vanishing
        )
        for f in forces
    ]
    scales = _scales(model, values)[list(allowed.picked)]
    prior_std_W = np.maximum(scales, np.sqrt(np.mean(smoothed.mean_W[:, list(allowed.picked)] ** 2, axis=0)))
    offsets = _responses(model, values, smoothed, forces, bases, allowed.boundary_K)
    problems = []
    for share in MISFIT_SHARES:
        white = whiten_responses(
            model.linear_model(_shrink(model, values, share, allowed.picked)), observations, offsets
        )
        problems.append(Problem.of(white, bases, prior_std_W))
    family = Family(tuple(problems), np.outer(MISFIT_SHARES, scales))
    degrees = family.choose(allowed.degrees)
    choice = family.solve(degrees)
    return LearnedHeatFlow(
        tuple(_polynomial(k, basis, degrees[k], choice, problems[0].owner) for k, basis in enumerate(bases)),
        degrees,
        choice.misfit_W,
        choice.log_evidence,
        choice.log_evidence - smoothed.log_likelihood,
        {d: family.log_evidence((d,) * len(bases)) for d in allowed.degrees},
    )


def _scales(model: ForceModel, values: FloatArray) -> FloatArray:
    """Return the stationary standard deviation of each force, (n_forces,)."""
    blocks = model.blocks(np.asarray(values, dtype=np.float64))
    return np.array([np.sqrt(np.real(b.observation @ b.stationary_cov @ b.observation)) for b in blocks])


def _refuse_shared(model: ForceModel, picked: tuple[int, ...]) -> None:
    """Refuse to learn a force whose size is also that of one that stays."""
    learned = {i for k in picked for i in model.forces[k].index}
    for k, force in enumerate(model.forces):
        if k not in picked and learned & set(force.index):
            raise ModelError(f"force on node {force.node} stays but shares hyperparameters with one that is learned")


def _shrink(model: ForceModel, values: FloatArray, share: float, picked: tuple[int, ...]) -> FloatArray:
    """Return the parameters with every standard deviation of the picked forces scaled."""
    shrunk = np.array(values, dtype=np.float64)
    forces = [model.forces[k] for k in picked]
    scaled = {i for f in forces for i, name in zip(f.index, f.kernel.names, strict=True) if name[:3] == "std"}
    shrunk[sorted(scaled)] *= share
    return shrunk


def _responses(
    model: ForceModel,
    values: FloatArray,
    smoothed: LatentForce,
    forces: Sequence[Force],
    bases: Sequence[Basis],
    boundary_K: FloatArray | None,
) -> FloatArray:
    """Return what a weight of one adds to the offset, (n_columns, n_steps, n_states): heat over capacity into the node."""
    at = np.asarray(values, dtype=np.float64)
    network = model.network(at[list(model.network_index)])
    feedback, diffusion = augment(network, model.forces, model.blocks(at), model.drift_K2_per_s)
    steps, index = step_table(network)
    discrete = discretise(np.real(feedback), np.real(diffusion), steps)
    capacity = np.broadcast_to(network.capacity_J_per_K, (index.size, model.n_nodes))
    columns = []
    for force, basis in zip(forces, bases, strict=True):
        node = force.node
        terms = basis.terms(smoothed.temperature_K[:, node], boundary_K, smoothed.temperature_std_K[:, node])
        into = slice(node, node + 1)
        for term in terms.T:
            ends = (np.stack([term[:-1], term[1:]], axis=1) / capacity[:, node, None])[:, :, None]
            columns.append(drive(discrete.hold[:, :, into], discrete.ramp[:, :, into], index, ends))
    return np.array(columns)


def _polynomial(k: int, basis: Basis, degree: int, choice: Choice, owner: IntArray) -> ForcePolynomial:
    """Cut one force out of the joint posterior."""
    own = np.flatnonzero(owner[choice.kept] == k)
    short = replace(basis, degree=degree)
    cov = choice.cov[np.ix_(own, own)]
    return ForcePolynomial(short, choice.mean[own], cov, float(choice.misfit_W[k]), choice.log_evidence)
