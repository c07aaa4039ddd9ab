"""What the operator of a spacecraft of solid bodies declares: one node per unit, guesses far from the truth."""

from collections.abc import Mapping
from typing import Any

from benchmarks.worlds.spacecraft import Spacecraft
from benchmarks.worlds.stepping import SPACE_K
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec


def true_values(craft: Spacecraft) -> dict[str, float]:
    """Return the capacities and contact conductances by the names of the calibrated parameters' keys."""
    field = craft.field
    capacities = {f"C:{node}": value for node, value in field.node_capacity_J_per_K.items()}
    return capacities | {f"G:{a}|{b}": value for (a, b), value in field.conductance_W_per_K.items()}


def declare(
    craft: Spacecraft,
    guesses: Mapping[str, float],
    *,
    unread: str | None = None,
    name: str = "solid",
) -> TwinSpec:
    """Return the specification with given guesses; ``unread`` is a node without sensor."""

    def node(identity: str) -> dict[str, Any]:
        row: dict[str, Any] = {"id": identity, "capacity_J_per_K": {"guess": guesses[f"C:{identity}"]}}
        return row if identity == unread else row | {"sensor": f"T_{identity}"}

    channels: dict[str, Any] = {f"T_{n}": {"kind": "temperature", "unit": "K"} for n in craft.nodes if n != unread}
    channels |= {f"T_{b}": {"kind": "temperature", "unit": "K"} for b in craft.boundaries_K}
    for channel in craft.power_W:
        linear = {"interpolation": "linear"} if channel in craft.sunlit else {}
        channels[channel] = {"kind": "power", "unit": "W", **linear}
    channels["mode"] = {"kind": "auxiliary", "levels": True}
    if "roll" in craft.auxiliary:
        channels["roll"] = {"kind": "auxiliary", "unit": "deg"}
    radiating = craft.field.radiating_m2
    emissivity = {n: e for n, (_, e) in craft.plan.radiators.items()}
    return load_spec(
        {
            "twin": name,
            "boundaries": {"space": {"value_K": SPACE_K}} | {b: {"channel": f"T_{b}"} for b in craft.boundaries_K},
            "channels": channels,
            "nodes": [node(identity) for identity in craft.nodes],
            "conductors": [
                {"between": [a, b], "conductance_W_per_K": {"guess": guesses[f"G:{a}|{b}"]}}
                for a, b in craft.field.conductance_W_per_K
            ],
            "radiators": [
                {"node": n, "emissivity": emissivity[n], "area_m2": float(row.sum()) / emissivity[n], "sink": "space"}
                for n, row in radiating.items()
            ],
            "loads": [{"channel": c, "node": c[2:]} for c in craft.power_W],
        }
    )
