"""Small networks, records and models that several tests share, and the central difference that judges derivatives."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin_core.calibrate.result import CalibratedModel
from twin_core.effects.base import Effect
from twin_core.effects.testbed import EVERY_TERM as EVERY_TERM
from twin_core.effects.testbed import EVERY_TERM_KNOTS as EVERY_TERM_KNOTS
from twin_core.effects.testbed import active_effect as active_effect
from twin_core.effects.testbed import every_term_network as every_term_network
from twin_core.effects.testbed import null_effects as null_effects
from twin_core.effects.testbed import points as points
from twin_core.effects.testbed import survey_of as survey_of
from twin_core.network.model import Network, build_network
from twin_core.network.spec import TwinSpec
from twin_core.telemetry import Record

FloatArray = NDArray[np.float64]


def central_difference(function: Callable[[float], FloatArray], at: float, step: float) -> FloatArray:
    """Return d function / dx by a central difference of fourth order: the error falls with step^4."""
    near = function(at + step) - function(at - step)
    far = function(at + 2.0 * step) - function(at - 2.0 * step)
    return (8.0 * near - far) / (12.0 * step)


def conductive_spec(n_nodes: int, edges: Sequence[tuple[int, int]], **fields: Any) -> dict[str, Any]:
    """Return a specification of sensed nodes ``n0``, ``n1``, ... with unknown capacities and conductances."""
    return {
        "twin": "conductive",
        "channels": {f"T{i}": {"kind": "temperature", "unit": "K"} for i in range(n_nodes)}
        | fields.pop("channels", {}),
        "nodes": [{"id": f"n{i}", "sensor": f"T{i}", "capacity_J_per_K": {"guess": 5.0e3}} for i in range(n_nodes)],
        "conductors": [{"between": [f"n{a}", f"n{b}"], "conductance_W_per_K": {"guess": 1.0}} for a, b in edges],
        **fields,
    }


def at_named(network: Network, named: dict[str, float]) -> Network:
    """Return the network with some of its parameters at other values; a name that it lacks is an error."""
    lacking = set(named) - set(network.parameters.index)
    assert not lacking, f"the network has no parameter {sorted(lacking)}"
    return network.with_parameters(network.parameters.updated(named))


def model_of(
    spec: TwinSpec,
    values: dict[str, float],
    *,
    effects: Sequence[Effect] = (),
    noise_K: float = 0.1,
    misfit_K: float = 0.0,
    misfit_length_s: float = 600.0,
    std: float = 0.0,
    max_step_s: float = 60.0,
) -> CalibratedModel:
    """Return a model at given values, every free parameter with the same standard deviation in the solver's number."""
    network = at_named(build_network(spec, effects), values)
    names = network.parameters.free_names
    each = spec.sensors
    return CalibratedModel(
        spec,
        tuple(effects),
        network.parameters.as_dict(),
        std**2 * np.eye(len(names)),
        names,
        dict.fromkeys(each, noise_K),
        dict.fromkeys(each, misfit_K),
        dict.fromkeys(each, misfit_length_s),
        max_step_s,
    )


def record_of(time_s: FloatArray, **channels: FloatArray | float) -> Record:
    """Return a record; a single number holds all along."""
    columns = {
        name: np.broadcast_to(np.asarray(x, dtype=np.float64), time_s.shape).copy() for name, x in channels.items()
    }
    return Record(time_s.astype(np.float64), columns)
