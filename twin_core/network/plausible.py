"""Readings that no instrument gives: markers for missing samples, wrong units, temperatures below absolute zero."""

import numpy as np

from twin_core._typing import FloatArray
from twin_core.constants import ZERO_CELSIUS_K
from twin_core.network.spec import Channel
from twin_core.quality.sentinels import HOTTEST_K

LARGEST = 1e12
"""Beyond it any value is a marker for a missing sample, not a measurement."""


def implausible(channel: Channel, values_si: FloatArray) -> tuple[int, str] | None:
    """Return position and fault of the first value that no instrument reads, None where there is none."""
    with np.errstate(invalid="ignore"):
        huge = np.abs(values_si) > LARGEST
        cold = values_si < 0.0 if channel.kind == "temperature" else np.zeros_like(huge)
        hot = values_si > HOTTEST_K if channel.kind == "temperature" else np.zeros_like(huge)
    for wrong, fault in ((cold, "is below absolute zero"), (hot, f"is above {HOTTEST_K:g} K"), (huge, "is too large")):
        if wrong.any():
            return int(np.argmax(wrong)), f"{fault}; correct the value or the channel's unit, or leave it out"
    return None


def plausible_range(channel: Channel) -> tuple[float, float]:
    """Return the least and the largest plausible value of a channel in its own unit."""
    if channel.kind != "temperature":
        return -LARGEST, LARGEST
    shift = ZERO_CELSIUS_K if channel.unit == "degC" else 0.0
    return 0.0 - shift, HOTTEST_K - shift
