"""The range of a straight line over temperature: a property that turned negative where it was measured follows no such law."""

from collections.abc import Mapping
from typing import Any

from twin_core._typing import FloatArray
from twin_core.effects.base import ParameterSpec


def range_of_slope(temperature_K: FloatArray, reference_K: float, least_share: float = 0.0) -> dict[str, float]:
    """Return the settings that keep 1 + slope (T - T_ref) above a share at every temperature of the training record.

    A bound that no temperature sets is left out.

    Parameters
    ----------
    temperature_K : (n_points,)
        What the model goes through there.
    reference_K
        T_ref, between the lowest and the highest of them.
    least_share
        Least value of the line.
    """
    below, above = reference_K - float(temperature_K.min()), float(temperature_K.max()) - reference_K
    most = 1.0 - least_share
    bounds = {"least_per_K": -most / above} if above > 0.0 else {}
    return bounds | ({"most_per_K": most / below} if below > 0.0 else {})


def slope_spec(name: str, settings: Mapping[str, Any]) -> ParameterSpec:
    """Return the slope of a straight line as a parameter, within its range where a training record tells one."""
    lower, upper = settings.get("least_per_K"), settings.get("most_per_K")
    return ParameterSpec(name, "1/K", null=0.0, lower=lower, upper=upper, breaks_down=True)
