"""The step in which a channel counts, found from its readings."""

import numpy as np

from twin_core._typing import FloatArray

_ROUNDING = 1e-9


def quantum(values: FloatArray) -> float:
    """Return the quantisation step of a channel in its own unit; 0 where it shows changes of many sizes.

    A channel counts as quantised when nearly all of its changes are whole multiples of the smallest ones and it takes few
    levels; where they are few themselves, when most readings repeat the one before. A uniform error over one step has the
    variance step^2 / 12.

    Parameters
    ----------
    values : (n_times,)
        Readings, NaN where missing.
    """
    present = values[np.isfinite(values)]
    changes = np.abs(np.diff(present))
    changes = changes[changes > _ROUNDING]
    if changes.size == 0 or (changes.size < 8 and changes.size > 0.5 * (present.size - 1)):
        return 0.0
    step = float(np.quantile(changes, 0.02))
    distance = np.abs(changes / step - np.round(changes / step))
    few_levels = np.unique(np.round(present, 6)).size < 0.5 * present.size
    return step if few_levels and float(np.mean(distance < 0.12)) > 0.95 else 0.0


def resolution(values: FloatArray) -> float:
    """Return the smallest change that a channel shows, whatever else it shows; 0 where it never changes."""
    changes = np.abs(np.diff(values[np.isfinite(values)]))
    changes = changes[changes > _ROUNDING]
    return float(np.quantile(changes, 0.02)) if changes.size else 0.0
