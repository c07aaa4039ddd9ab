"""The heat balance of a moment or a stretch of time, told flow by flow: what one wants to see drawn on the network."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from twin_core._typing import FloatArray, Json
from twin_core.calibrate.result import CalibratedModel
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4
from twin_core.effects import effect_to_json
from twin_core.effects.heat import effect_heat_W
from twin_core.forecast.assumed import future_record
from twin_core.network.dynamics import evaluate_balance, fill_boundaries
from twin_core.network.model import Network, declared_terms
from twin_core.network.terms import Along, Term
from twin_core.simulate.forcing import build_forcing
from twin_core.telemetry import Record

MOMENT_S = 1.0
"""The balance is evaluated at the beginning of a step of this length."""


def heat_flows(model: CalibratedModel, record: Record, state: Json) -> Json:
    """Return temperatures and heat flows at the end of a record.

    Parameters
    ----------
    model
        A calibrated model.
    record
        Telemetry up to the moment, for inputs and boundary temperatures.
    state
        The ``state`` of an assimilation whose last sample is the last one of ``record``.

    Returns
    -------
    dict
        ``nodes`` with temperature_K and net heat_W; ``boundaries`` with the temperature_K that is declared; ``links``
        (conductors, radiators and radiation) whose heat_W flows from ``ends[0]`` to ``ends[1]`` at these temperatures, one
        that is ``one_way`` without being taken from the first; ``loads``, ``heaters`` and ``effects`` with the heat_W that each
        brings into its nodes. The heats into a node add up to its net heat.

    Raises
    ------
    TelemetryError
        If the record lacks an input that the model needs.
    """
    network = model.network()
    temperatures = np.array(state["mean_K"], dtype=np.float64)
    return flows_along(model, network, _moment(model, network, record, temperatures))


def flows_along(model: CalibratedModel, network: Network, along: Along, weights: FloatArray | None = None) -> Json:
    """Return temperatures and heat flows as :func:`heat_flows` does, averaged over points of a trajectory.

    Parameters
    ----------
    model, network
        A calibrated model and its network.
    along
        The points; both ends of successive steps where a thermostat is to be followed.
    weights : (n_points,)
        Of the points in the mean; alike by default.
    """
    values = network.parameters.values
    mean = _Mean(weights)
    known = {name: along.temperatures_K[:, i] for i, name in enumerate(network.nodes)}
    known |= {name: along.boundaries_K[:, i] for i, name in enumerate(network.layout.boundaries)}
    net = mean(evaluate_balance(network, values, along).heat_W)
    read = {network.nodes[i] for i in network.sensor_node}
    return {
        "nodes": [
            {"id": name, "temperature_K": float(mean(known[name])), "heat_W": float(net[i]), "sensed": name in read}
            for i, name in enumerate(network.nodes)
        ],
        "boundaries": [{"id": name, "temperature_K": float(mean(known[name]))} for name in network.layout.boundaries],
        "links": [*_conductors(model, known, mean), *_radiators(model, known, mean), *_radiation(model, known, mean)],
        "heaters": _heaters(model, network, along, mean),
        "loads": _loads(model, network, along, mean),
        "effects": _effects(model, network, along, mean),
    }


@dataclass(frozen=True)
class _Mean:
    """The mean over points, weighted or not."""

    weights: FloatArray | None

    def __call__(self, values: FloatArray) -> FloatArray:
        return np.asarray(np.average(values, axis=0, weights=self.weights), dtype=np.float64)


def _moment(model: CalibratedModel, network: Network, record: Record, temperatures_K: FloatArray) -> Along:
    """Return the one point at which the balance is evaluated."""
    future = future_record(model.spec, record, MOMENT_S, MOMENT_S, None)
    forcing = build_forcing(network, future, model.max_step_s)
    boundaries = fill_boundaries(network, network.parameters.values, forcing.boundaries_K[0, :1])
    return Along(
        forcing.stage_time_s[0, :1] + forcing.epoch_s,
        temperatures_K[None, :],
        boundaries,
        {name: series[0, :1] for name, series in forcing.inputs.items()},
        forcing.sun_factor[0, :1],
    )


def _into_nodes(network: Network, term: Term, along: Along, mean: _Mean) -> FloatArray:
    """Return the heat of one term into every node, (n_nodes,)."""
    part = term.evaluate(along, network.parameters.values[network.term_index(term)])
    heat = np.zeros(len(network.nodes))
    np.add.at(heat, np.asarray(part.nodes), mean(part.heat_W))
    return heat


def _conductors(model: CalibratedModel, known_K: Mapping[str, FloatArray], mean: _Mean) -> list[Json]:
    links = []
    for conductor in model.spec.conductors:
        first, second = conductor.between
        conductance = model.values[conductor.name]
        heat_W = float(mean(conductance * (known_K[first] - known_K[second])))
        link: Json = {"kind": "conductor", "ends": [first, second], "heat_W": heat_W}
        if conductor.into is not None:
            source = first if conductor.into == second else second
            link = {**link, "ends": [source, conductor.into], "heat_W": heat_W if source == first else -heat_W}
            link["one_way"] = True
        links.append({**link, "conductance_W_per_K": conductance})
    return links


def _radiators(model: CalibratedModel, known_K: Mapping[str, FloatArray], mean: _Mean) -> list[Json]:
    links = []
    for radiator in model.spec.radiators:
        area_m2 = radiator.emissivity * radiator.area_m2
        driving = known_K[radiator.node] ** 4 - known_K[radiator.sink] ** 4
        heat_W = float(mean(STEFAN_BOLTZMANN_W_PER_M2_K4 * area_m2 * driving))
        link = {"kind": "radiator", "ends": [radiator.node, radiator.sink], "heat_W": heat_W}
        links.append({**link, "emissive_area_m2": area_m2})
    return links


def _radiation(model: CalibratedModel, known_K: Mapping[str, FloatArray], mean: _Mean) -> list[Json]:
    links = []
    for coupling in model.spec.radiation:
        first, second = coupling.between
        area_m2 = model.values[coupling.name]
        heat_W = float(mean(STEFAN_BOLTZMANN_W_PER_M2_K4 * area_m2 * (known_K[first] ** 4 - known_K[second] ** 4)))
        links.append({"kind": "radiation", "ends": [first, second], "heat_W": heat_W, "exchange_area_m2": area_m2})
    return links


def _heaters(model: CalibratedModel, network: Network, along: Along, mean: _Mean) -> list[Json]:
    """Return the declared heaters, whose terms stand behind those of the loads; a thermostat's by what its memory says."""
    n_terms = len(declared_terms(network.layout))
    terms = network.terms[n_terms - len(model.spec.heaters) : n_terms]
    found = []
    for heater, term in zip(model.spec.heaters, terms, strict=True):
        into = _into_nodes(network, term, along, mean)
        found.append({"node": heater.node, "heat_W": float(into[network.layout.node(heater.node)])})
    return found


def _loads(model: CalibratedModel, network: Network, along: Along, mean: _Mean) -> list[Json]:
    """Return the declared loads, whose terms stand at the end of the declared ones and in their order."""
    loads = model.spec.loads
    declared = [term for term in network.terms if hasattr(term, "channel")][: len(loads)]
    found = []
    for load, term in zip(loads, declared, strict=True):
        heat_W = float(_into_nodes(network, term, along, mean).sum())
        found.append({"channel": load.channel, "node": load.node, "heat_W": heat_W})
    return found


def _effects(model: CalibratedModel, network: Network, along: Along, mean: _Mean) -> list[Json]:
    """Return each effect with the heat that it brings into the nodes; effects on readings bring none."""
    found = []
    for effect in model.effects:
        heat = mean(effect_heat_W(effect, network, along))
        data = effect_to_json(effect)
        into = {name: float(q) for name, q in zip(network.nodes, heat, strict=True) if q != 0.0}
        found.append({"effect": data["effect"], "where": data["where"], "heat_W": into})
    return found
