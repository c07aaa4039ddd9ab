"""The model of a linearised network with its latent forces and sensors, over a vector of parameters.

    x as in :mod:`twin_core.latent_force.augment`,   y = H T + noise

Kouw et al. (CCTA 2024), eqs. 10-21, for any network, any subset of nodes and any kernel.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.errors import ModelError
from twin_core.gp.checked import numbers
from twin_core.gp.discretise import Scheme, discretise
from twin_core.gp.kernels import Block, Kernel, Values
from twin_core.gp.score import Slopes
from twin_core.gp.state_space import LinearModel
from twin_core.latent_force.augment import Force, augment, drive, step_table
from twin_core.latent_force.linearised import Linearised

STEP = 1e-30
"""Imaginary step; its square is far below rounding, so derivatives are exact."""
VAGUEST = 1e6
"""Largest deviation of a first temperature over the finest sensor noise. The filter subtracts variances, so that it loses
twice as many digits as this ratio has; at a million, smoothed states are still right to 1e-4 of their deviation."""


@dataclass(frozen=True)
class ForceModel:
    """Network, forces and sensors over a vector of positive parameters; build it with :meth:`build`.

    Attributes
    ----------
    names
        Of the parameters: hyperparameters first, then the network's, then noise.
    network
        Called with the network's part of the vector (possibly complex); a constant network takes an empty one.
    network_index
        Positions of the network's parameters.
    forces
        Latent heats.
    observation : (n_sensors, n_nodes)
        H.
    noise_std_K : (n_sensors,)
        Where ``noise_index`` is negative.
    noise_index : (n_sensors,)
        Positions of estimated noise, -1 where given.
    prior_mean_K, prior_std_K : (n_nodes,)
        Temperatures at the first sample, before it is seen.
    drift_K2_per_s : (n_nodes,)
        Spectral density of white noise in dT/dt; zero unless asked.
    scheme
        Discretisation, exact or the paper's.
    """

    names: tuple[str, ...]
    network: Callable[[Values], Linearised]
    network_index: tuple[int, ...]
    forces: tuple[Force, ...]
    observation: FloatArray
    noise_std_K: FloatArray
    noise_index: IntArray
    prior_mean_K: FloatArray
    prior_std_K: FloatArray
    drift_K2_per_s: FloatArray
    scheme: Scheme = "exact"

    @classmethod
    def build(
        cls,
        network: Linearised | Callable[[Values], Linearised],
        nodes: Sequence[int],
        kernel: Kernel,
        *,
        observation: FloatArray,
        noise_std_K: FloatArray,
        prior_mean_K: FloatArray,
        prior_std_K: FloatArray | float,
        shared: bool = True,
        network_names: Sequence[str] = (),
        estimate_noise: Sequence[int] = (),
        drift_K2_per_s: FloatArray | float = 0.0,
        scheme: Scheme = "exact",
    ) -> Self:
        """Put a model together.

        Parameters
        ----------
        network
            Plain arrays, or a function of the values of ``network_names`` (joint estimation; it must accept complex).
        nodes
            Nodes that receive a force, in the order of the result.
        kernel
            Of every force.
        observation : (n_sensors, n_nodes)
        noise_std_K : (n_sensors,)
        prior_mean_K : (n_nodes,)
        prior_std_K : (n_nodes,) or one number
        shared
            One set of hyperparameters for all forces (as in the paper), or one each.
        network_names
            Names of the network's parameters, positive.
        estimate_noise
            Sensors whose noise is a parameter.
        drift_K2_per_s : (n_nodes,) or one number
        scheme
            Discretisation.

        Raises
        ------
        ModelError
            A node or sensor does not exist, a shape does not fit, or what should be a kernel is none.
        """
        if not isinstance(kernel, Kernel):
            raise ModelError(f"kernel: must be a kernel such as Matern(3), it is {kernel!r}")
        names = list(kernel.names) if shared else [f"{name}[{node}]" for node in nodes for name in kernel.names]
        size = len(kernel.names)
        starts = [0 if shared else k * size for k in range(len(nodes))]
        forces = tuple(
            Force(int(node), kernel, tuple(range(s, s + size))) for node, s in zip(nodes, starts, strict=True)
        )
        if not forces:
            names = []
        network_index = tuple(range(len(names), len(names) + len(network_names)))
        h = np.atleast_2d(numbers(observation, "observation"))
        _check_places(nodes, estimate_noise, h, network)
        noise_index = np.full(h.shape[0], -1, dtype=np.int64)
        for position, sensor in enumerate(estimate_noise):
            noise_index[sensor] = len(names) + len(network_names) + position
        names += [*network_names, *(f"noise_std_K[{sensor}]" for sensor in estimate_noise)]
        n = h.shape[1]
        noise = numbers(noise_std_K, "noise_std_K", (h.shape[0],), lowest=0.0)
        return cls(
            tuple(names),
            (lambda values: network) if isinstance(network, Linearised) else network,
            network_index,
            forces,
            h,
            noise,
            noise_index,
            numbers(prior_mean_K, "prior_mean_K", (n,)),
            _prior_std_K(prior_std_K, n, noise),
            numbers(drift_K2_per_s, "drift_K2_per_s", (n,), lowest=0.0),
            scheme,
        )

    @property
    def n_nodes(self) -> int:
        """Number of nodes, the first states."""
        return int(self.observation.shape[1])

    def blocks(self, values: Values) -> list[Block]:
        """Return each force's differential equation at parameters (n_free,)."""
        return [force.kernel.block(values[list(force.index)]) for force in self.forces]

    def force_rows(self, values: FloatArray) -> FloatArray:
        """Return the rows that read each force out of the state, (n_forces, n_states)."""
        blocks = self.blocks(np.asarray(values, dtype=np.float64))
        n_states = self.n_nodes + sum(b.observation.size for b in blocks)
        rows, at = np.zeros((len(blocks), n_states)), self.n_nodes
        for k, block in enumerate(blocks):
            rows[k, at : at + block.observation.size] = block.observation
            at += block.observation.size
        return rows

    def linear_model(self, values: FloatArray) -> LinearModel:
        """Return the discrete model at parameters (n_free,)."""
        at = np.asarray(values, dtype=np.float64)
        network = self.network(at[list(self.network_index)])
        steps, index = step_table(network)
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is named by the discretisation
            moved = [np.asarray(np.real(a), dtype=np.float64) for a in self._assemble(at, network, steps, index)]
        observation = np.hstack([self.observation, np.zeros((self.observation.shape[0], moved[4].size - self.n_nodes))])
        return LinearModel.build(
            transition=moved[0],
            process_cov=moved[1],
            offset=moved[2],
            noise_variance=moved[3],
            prior_mean=moved[4],
            prior_cov=moved[5],
            observation=observation,
            step_index=index,
            n_times=network.time_s.size,
        )

    def slopes(self, values: FloatArray) -> Slopes:
        """Return the exact derivatives of the discrete model in the logarithms of the parameters."""
        columns = []
        for p in range(len(self.names)):
            moved = np.array(values, dtype=np.complex128)
            moved[p] *= 1.0 + 1j * STEP
            network = self.network(moved[list(self.network_index)])
            steps, index = step_table(network)
            columns.append([np.imag(a) / STEP for a in self._assemble(moved, network, steps, index)])
        return Slopes(*(np.ascontiguousarray(np.stack(arrays)) for arrays in zip(*columns, strict=True)))

    def _assemble(self, values: Values, network: Linearised, steps: FloatArray, index: IntArray) -> tuple[Values, ...]:
        """Return transition, process_cov, offset, noise_variance, prior_mean, prior_cov; complex where values are."""
        blocks, n = self.blocks(values), self.n_nodes
        feedback, diffusion = augment(network, self.forces, blocks, self.drift_K2_per_s)
        discrete = discretise(feedback, diffusion, steps, scheme=self.scheme)
        offset = drive(discrete.hold[:, :, :n], discrete.ramp[:, :, :n], index, network.constant_K_per_s)
        noise = self.noise_std_K.astype(values.dtype)
        estimated = self.noise_index >= 0
        noise[estimated] = values[self.noise_index[estimated]]
        n_states = feedback.shape[-1]
        mean, cov = np.zeros(n_states), np.zeros((n_states, n_states), dtype=values.dtype)
        mean[:n] = self.prior_mean_K
        cov[range(n), range(n)] = self.prior_std_K**2
        at = n
        for block in blocks:
            size = block.observation.size
            cov[at : at + size, at : at + size] = block.stationary_cov
            at += size
        return discrete.transition, discrete.process_cov, offset, noise**2, mean, cov


def _check_places(
    nodes: Sequence[int], noisy: Sequence[int], h: FloatArray, network: Linearised | Callable[[Values], Linearised]
) -> None:
    """Refuse forces and estimated noises that have no place, or one between two; ModelError names it."""
    n_sensors, n = h.shape
    if isinstance(network, Linearised) and network.n_nodes != n:
        raise ModelError(f"observation has {n} columns, the network {network.n_nodes} nodes")
    for what, places, count in (("force on node", nodes, n), ("noise of sensor", noisy, n_sensors)):
        for place in places:
            if not isinstance(place, int | np.integer) or not 0 <= place < count:
                raise ModelError(f"{what} {place}: there are 0 to {count - 1}")
        if len(set(places)) < len(places):
            raise ModelError(f"{what} {next(p for p in places if list(places).count(p) > 1)}: is named twice")


def _prior_std_K(given: FloatArray | float, n: int, noise_std_K: FloatArray) -> FloatArray:
    """Return the deviations of the first temperatures; refuse what a filter in double precision cannot carry."""
    if np.isinf(given).any():
        raise ModelError("prior_std_K: is infinite; no temperature is further than 1000 K from any guess, give that")
    std = numbers(given, "prior_std_K", (n,), lowest=0.0)
    limit = VAGUEST * float(noise_std_K[noise_std_K > 0.0].min(initial=np.inf))
    if (std > limit).any():
        node = int(np.argmax(std))
        raise ModelError(
            f"prior_std_K[{node}]: {std[node]:g} K beside a sensor noise of {limit / VAGUEST:g} K is more than double "
            f"precision carries; give at most {limit:g} K, and a mean that near"
        )
    return std
