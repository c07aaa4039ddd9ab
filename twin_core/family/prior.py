"""What a family knows, written into the specification of a sibling: guesses with their spread, for its own calibration."""

from typing import Any

import numpy as np

from twin_core.family.pool import Family
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import dump_spec, load_spec


def declared(spec: TwinSpec, family: Family) -> TwinSpec:
    """Return a specification whose guesses of capacities and conductances are those of the family.

    Their spread holds what siblings differ by and what is not known of their mean. All else stays as it is declared.
    """
    document = dump_spec(spec)
    known = {
        name: {"guess": float(np.exp(mean)), "spread": float(np.exp(np.hypot(spread, error)))}
        for name, mean, spread, error in zip(family.names, family.mean, family.spread, family.mean_std, strict=True)
    }
    for node in document["nodes"]:
        _take_over(node, "capacity_J_per_K", known.get(f"C:{node['id']}"))
    for conductor in document.get("conductors") or ():
        one, other = conductor["between"]
        _take_over(conductor, "conductance_W_per_K", known.get(f"G:{one}|{other}") or known.get(f"G:{other}|{one}"))
    return load_spec(document)


def _take_over(item: dict[str, Any], field: str, known: dict[str, float] | None) -> None:
    if known is not None and "per_area" not in (item.get(field) or {}) and "per_mass" not in (item.get(field) or {}):
        item[field] = {**(item.get(field) or {}), **known}
        item[field].pop("value", None)
