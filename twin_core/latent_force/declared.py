"""Latent forces on a declared network, fitted together with its conductances, capacities and sensor noise.

The heat balance is linearised about temperatures close to the measured ones; the parameters that are asked for move it.
Where it is not linear, fit and linearisation take turns until the smoothed temperatures rest.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from twin_core._typing import FloatArray
from twin_core.errors import ModelError
from twin_core.gp.checked import numbers
from twin_core.gp.kernels import Kernel, Values
from twin_core.latent_force.hyperparameters import MapFit, fit_map
from twin_core.latent_force.linearised import Linearised
from twin_core.latent_force.model import ForceModel
from twin_core.latent_force.network import linearise_network, on_grid
from twin_core.latent_force.posterior import GammaPrior
from twin_core.latent_force.smooth import LatentForce, smooth_force
from twin_core.network.model import Network
from twin_core.simulate.forcing import Forcing
from twin_core.simulate.rollout import rollout

DIFFERENCE = 1e-4
"""Step of ln(parameter); a central difference of the balance, which is smooth, is then good to 1e-8 of it."""
SETTLED_K = 1e-3
"""Fit and linearisation have settled when no smoothed temperature moves by more: its square is what T⁴ makes of it."""


def along_parameters(
    network: Network, forcing: Forcing, temperatures_K: FloatArray, names: Sequence[str]
) -> Callable[[Values], Linearised]:
    """Return a network linearised about temperatures as a function of some of its parameters, for a :class:`ForceModel`.

    Parameters
    ----------
    network
        The others keep its values.
    forcing
        n_steps steps.
    temperatures_K : (n_steps + 1, n_nodes)
    names
        Parameters, positive, such as ``C:px`` or ``G:px|tank``.

    Returns
    -------
    callable
        Values (n_names,) -> network. Complex ones, of a complex step, carry their derivatives along.

    Raises
    ------
    ModelError
        A name that the network lacks, or whose value is not positive.
    """
    parameters = network.parameters
    for name in names:
        if name not in parameters.index:
            raise ModelError(f"parameter '{name}': the network has {', '.join(parameters.index)}")
        if not parameters.parameters[parameters.index[name]].value > 0.0:
            raise ModelError(f"parameter '{name}': only a positive one can be fitted beside a latent force")

    @lru_cache(maxsize=2 * len(names) + 2)
    def at(*values: float) -> Linearised:
        moved = network.with_parameters(parameters.updated(dict(zip(names, values, strict=True))))
        return linearise_network(moved, forcing)(temperatures_K)

    def about(values: Values) -> Linearised:
        here = np.real(values)
        found = at(*here.tolist())
        for p in np.flatnonzero(np.imag(values)):
            up, down = (
                at(*(here * np.exp(sign * DIFFERENCE * (np.arange(here.size) == p))).tolist()) for sign in (1, -1)
            )
            found = _tilted(found, up, down, complex(0.0, np.imag(values)[p] / here[p] / (2.0 * DIFFERENCE)))
        return found

    return about


def _tilted(at: Linearised, up: Linearised, down: Linearised, share: complex) -> Linearised:
    """Return a network plus a share of the difference of two others; what all steps share stays shared."""

    def moved(here: Values, above: Values, below: Values) -> Values:
        difference = above - below
        return here + share * (difference.mean(axis=0) if here.shape[0] == 1 else difference)

    return Linearised(
        at.time_s,
        moved(at.jacobian_per_s, up.jacobian_per_s, down.jacobian_per_s),
        moved(at.constant_K_per_s, up.constant_K_per_s, down.constant_K_per_s),
        moved(at.capacity_J_per_K, up.capacity_J_per_K, down.capacity_J_per_K),
    )


def declared_model(
    network: Network,
    forcing: Forcing,
    temperatures_K: FloatArray,
    nodes: Sequence[str],
    kernel: Kernel,
    *,
    names: Sequence[str] = (),
    estimate_noise: Sequence[str] = (),
    **options: object,
) -> ForceModel:
    """Return a declared network with latent forces.

    Parameters
    ----------
    network, forcing, temperatures_K, names
        As :func:`along_parameters`.
    nodes
        Names of the nodes that receive a force.
    kernel
        Of every force.
    estimate_noise
        Sensors whose noise is a parameter.
    options
        The others of :meth:`ForceModel.build`: ``noise_std_K``, ``prior_mean_K``, ``prior_std_K``, ``shared``, ...

    Raises
    ------
    ModelError
        A name does not exist, or as :meth:`ForceModel.build`.
    """
    observation = np.zeros((network.sensor_node.size, len(network.nodes)))
    observation[np.arange(network.sensor_node.size), network.sensor_node] = 1.0
    return ForceModel.build(
        along_parameters(network, forcing, temperatures_K, names),
        [network.layout.node(node) for node in nodes],
        kernel,
        observation=observation,
        network_names=names,
        estimate_noise=[network.layout.sensor(sensor) for sensor in estimate_noise],
        **options,  # type: ignore[arg-type]
    )


@dataclass(frozen=True)
class DeclaredFit:
    """Forces and parameters of a declared network.

    Attributes
    ----------
    network
        At the fitted values.
    model
        Its linearisation about the smoothed temperatures.
    fit
        All parameters with their covariance; its notices name what the data cannot tell.
    force
        The smoothed forces there.
    n_linearisations
        How often the network was linearised.
    settled
        Whether the last linearisation changed nothing.
    """

    network: Network
    model: ForceModel
    fit: MapFit
    force: LatentForce
    n_linearisations: int
    settled: bool


def fit_declared(
    network: Network,
    forcing: Forcing,
    samples_K: FloatArray,
    nodes: Sequence[str],
    kernel: Kernel,
    priors: Mapping[str, GammaPrior],
    start: Mapping[str, float],
    *,
    prior_mean_K: FloatArray | float,
    names: Sequence[str] = (),
    max_linearisations: int = 8,
    **options: object,
) -> DeclaredFit:
    """Fit latent forces on a declared network, and some of its parameters and noises with them.

    Parameters
    ----------
    network
        Parameters start from its values.
    forcing
        Steps, inputs and boundaries of the record.
    samples_K : (n_samples, n_sensors)
        Measured temperatures without the network's own reading faults; NaN where missing.
    nodes, kernel, options
        As :func:`declared_model`.
    priors, start
        As :func:`twin_core.latent_force.hyperparameters.fit_map`; ``start`` needs the hyperparameters and noises alone.
    prior_mean_K : (n_nodes,) or one number
        Temperatures at the start; the first linearisation is about the network's own trajectory from there.
    names
        The network's parameters that are fitted, positive.
    max_linearisations
        Where to stop; the result says whether it had settled.

    Raises
    ------
    ModelError
        As :func:`declared_model` and :func:`twin_core.latent_force.hyperparameters.fit_map`.
    """
    if max_linearisations < 1:
        raise ModelError(f"max_linearisations must be at least 1, it is {max_linearisations}")
    observations, values = on_grid(forcing, samples_K), network.parameters.as_dict()
    begin = {name: values[name] for name in names if name in values} | dict(start)
    mean_K = numbers(prior_mean_K, "prior_mean_K", (len(network.nodes),))
    about_K, done, settled = _first_temperatures_K(network, forcing, mean_K), 0, False
    while not settled and done < max_linearisations:
        model = declared_model(
            network,
            forcing,
            about_K,
            nodes,
            kernel,
            names=names,
            prior_mean_K=mean_K,
            **options,  # type: ignore[arg-type]
        )
        fit = fit_map(model, observations, priors, begin)
        force = smooth_force(model, observations, fit.values)
        settled, done = float(np.abs(force.temperature_K - about_K).max()) < SETTLED_K, done + 1
        begin, about_K = fit.named(), force.temperature_K
        network = network.with_parameters(network.parameters.updated({name: begin[name] for name in names}))
    return DeclaredFit(network, model, fit, force, done, settled)


def _first_temperatures_K(network: Network, forcing: Forcing, start_K: FloatArray) -> FloatArray:
    """Return the declared network's own trajectory (n_steps + 1, n_nodes); the start held where it has none."""
    path = rollout(network, network.parameters.values, start_K, forcing)
    return np.vstack([start_K, path.stages_K[:, 1]]) if path.converged else np.tile(start_K, (forcing.n_steps + 1, 1))
