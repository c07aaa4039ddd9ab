"""A specification whose unknowns have been found."""

from collections.abc import Mapping

from twin_core._typing import Json
from twin_core.network.model import conductor_name, gain_name
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import dump_spec, load_spec


def with_values(spec: TwinSpec, values: Mapping[str, float]) -> Json:
    """Return the data of a specification with calibrated values in the place of guesses, all of them held.

    Parameters
    ----------
    spec
        What was declared.
    values
        Parameter name -> value, as of a calibrated model. Shared unknowns stay shared.
    """
    data = dump_spec(spec)

    def known(entry: Json, field: str, name: str) -> None:
        declared = entry.get(field)
        tied = isinstance(declared, dict) and {"per_area", "per_mass", "scale"} & declared.keys()
        zero = isinstance(declared, dict) and declared.get("value") == 0.0
        if name in values and not tied and not zero:
            entry[field] = {"value": values[name]}

    for node in data["nodes"]:
        known(node, "capacity_J_per_K", f"C:{node['id']}")
    for entry, conductor in zip(data.get("conductors", ()), spec.conductors, strict=True):
        known(entry, "conductance_W_per_K", conductor.name if conductor.into else conductor_name(conductor.between))
    for entry, coupling in zip(data.get("radiation", ()), spec.radiation, strict=True):
        known(entry, "area_m2", coupling.name)
    for entry, load in zip(data.get("loads", ()), spec.loads, strict=True):
        if load.gain is not None:
            known(entry, "gain", gain_name(load))
        if load.table is not None and load.table.knots is not None:
            through = load.channel if load.factor is None else f"{load.channel}*{load.factor}"
            names = [f"table:{through}|{load.node}[{knot:g}]" for knot in load.table.knots]
            if all(name in values for name in names):
                entry["table"] = {"knots": list(load.table.knots), "values_W": [values[name] for name in names]}
    for entry, heater in zip(data.get("heaters", ()), spec.heaters, strict=True):
        for law, field, short in (
            ("thermostat", "power_W", "Q"),
            ("proportional", "gain_W_per_K", "k"),
            ("proportional", "most_W", "Q"),
        ):
            if field in entry.get(law, {}):
                known(entry[law], field, f"{heater.name}.{short}")
    for name, boundary in data.get("boundaries", {}).items():
        if "guess_K" in boundary and f"T:{name}" in values:
            data["boundaries"][name] = {"value_K": values[f"T:{name}"]}
    for name in data.get("parameters", {}):
        if name in values:
            data["parameters"][name] = {"value": values[name]}
    load_spec(data)
    return data
