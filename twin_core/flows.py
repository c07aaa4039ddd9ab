"""The heat balance of one moment, told flow by flow: what an operator wants to see drawn on the network."""

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
    along = _moment(model, network, record, temperatures)
    values = network.parameters.values
    boundaries = dict(zip(network.layout.boundaries, along.boundaries_K[0].tolist(), strict=True))
    known = dict(zip(network.nodes, temperatures.tolist(), strict=True)) | boundaries
    net = evaluate_balance(network, values, along).heat_W[0]
    read = {network.nodes[i] for i in network.sensor_node}
    return {
        "nodes": [
            {"id": name, "temperature_K": known[name], "heat_W": float(net[i]), "sensed": name in read}
            for i, name in enumerate(network.nodes)
        ],
        "boundaries": [{"id": name, "temperature_K": value} for name, value in boundaries.items()],
        "links": [*_conductors(model, known), *_radiators(model, known), *_radiation(model, known)],
        "heaters": _heaters(model, network, along, values),
        "loads": _loads(model, network, along, values),
        "effects": _effects(model, network, along),
    }


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


def _into_nodes(network: Network, term: Term, along: Along, values: FloatArray) -> FloatArray:
    """Return the heat of one term into every node, (n_nodes,)."""
    part = term.evaluate(along, values[network.term_index(term)])
    heat = np.zeros(len(network.nodes))
    heat[np.asarray(part.nodes)] += part.heat_W[0]
    return heat


def _conductors(model: CalibratedModel, known_K: dict[str, float]) -> list[Json]:
    links = []
    for conductor in model.spec.conductors:
        first, second = conductor.between
        conductance = model.values[conductor.name]
        heat_W = conductance * (known_K[first] - known_K[second])
        link: Json = {"kind": "conductor", "ends": [first, second], "heat_W": heat_W}
        if conductor.into is not None:
            source = first if conductor.into == second else second
            link = {**link, "ends": [source, conductor.into], "heat_W": heat_W if source == first else -heat_W}
            link["one_way"] = True
        links.append({**link, "conductance_W_per_K": conductance})
    return links


def _radiators(model: CalibratedModel, known_K: dict[str, float]) -> list[Json]:
    links = []
    for radiator in model.spec.radiators:
        area_m2 = radiator.emissivity * radiator.area_m2
        heat_W = STEFAN_BOLTZMANN_W_PER_M2_K4 * area_m2 * (known_K[radiator.node] ** 4 - known_K[radiator.sink] ** 4)
        link = {"kind": "radiator", "ends": [radiator.node, radiator.sink], "heat_W": heat_W}
        links.append({**link, "emissive_area_m2": area_m2})
    return links


def _radiation(model: CalibratedModel, known_K: dict[str, float]) -> list[Json]:
    links = []
    for coupling in model.spec.radiation:
        first, second = coupling.between
        area_m2 = model.values[coupling.name]
        heat_W = STEFAN_BOLTZMANN_W_PER_M2_K4 * area_m2 * (known_K[first] ** 4 - known_K[second] ** 4)
        links.append({"kind": "radiation", "ends": [first, second], "heat_W": heat_W, "exchange_area_m2": area_m2})
    return links


def _heaters(model: CalibratedModel, network: Network, along: Along, values: FloatArray) -> list[Json]:
    """Return the declared heaters, whose terms stand behind those of the loads; a thermostat's by what its memory says."""
    n_terms = len(declared_terms(network.layout))
    terms = network.terms[n_terms - len(model.spec.heaters) : n_terms]
    found = []
    for heater, term in zip(model.spec.heaters, terms, strict=True):
        into = _into_nodes(network, term, along, values)
        found.append({"node": heater.node, "heat_W": float(into[network.layout.node(heater.node)])})
    return found


def _loads(model: CalibratedModel, network: Network, along: Along, values: FloatArray) -> list[Json]:
    """Return the declared loads, whose terms stand at the end of the declared ones and in their order."""
    loads = model.spec.loads
    declared = [term for term in network.terms if hasattr(term, "channel")][: len(loads)]
    found = []
    for load, term in zip(loads, declared, strict=True):
        heat_W = float(_into_nodes(network, term, along, values).sum())
        found.append({"channel": load.channel, "node": load.node, "heat_W": heat_W})
    return found


def _effects(model: CalibratedModel, network: Network, along: Along) -> list[Json]:
    """Return each effect with the heat that it brings into the nodes; effects on readings bring none."""
    found = []
    for effect in model.effects:
        heat = effect_heat_W(effect, network, along)[0]
        data = effect_to_json(effect)
        into = {name: float(q) for name, q in zip(network.nodes, heat, strict=True) if q != 0.0}
        found.append({"effect": data["effect"], "where": data["where"], "heat_W": into})
    return found
