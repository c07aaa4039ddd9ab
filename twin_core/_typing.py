"""Array aliases. Shapes are written in docstrings with the words n_times, n_nodes, n_sensors, n_free, ..."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Json = dict[str, Any]

Progress = Callable[[float, str], None]
"""Called with the fraction done (0 to 1) and a short message; may raise to cancel the work."""


def no_progress(fraction: float, message: str) -> None:
    """Report nothing: the default of every long job."""
