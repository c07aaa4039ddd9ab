"""Numbers at the door: of the right shape and finite, or one error that names them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from twin_core._typing import FloatArray
from twin_core.errors import ModelError


def numbers(values: Any, name: str, shape: tuple[int, ...] | None = None, *, lowest: float = -np.inf) -> FloatArray:
    """Return values as contiguous finite floats.

    Parameters
    ----------
    values
        Anything that numpy takes.
    name
        For the error.
    shape
        What they are broadcast to; any by default.
    lowest
        Smallest value allowed.

    Raises
    ------
    ModelError
        Not numbers, not of that shape, not finite, or too small.
    """
    try:
        array = np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelError(f"{name}: must be numbers ({error})") from error
    if not np.isfinite(array).all():
        raise ModelError(f"{name}: holds a number that is not finite")
    if not (array >= lowest).all():
        raise ModelError(f"{name}: must be at least {lowest:g}, one is {array.min():g}")
    if shape is None:
        return array
    try:
        return np.ascontiguousarray(np.broadcast_to(array, shape)).copy()
    except ValueError as error:
        raise ModelError(f"{name}: has shape {array.shape}, it must have {shape}") from error


def positive(values: Any, names: Sequence[str]) -> FloatArray:
    """Return one positive finite number per name, (n_names,).

    Raises
    ------
    ModelError
        Too few, too many, or one that is not positive.
    """
    words = f"values must be {len(names)} positive numbers: {', '.join(names)}"
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelError(words) from error
    if array.shape != (len(names),) or not ((array > 0.0) & np.isfinite(array)).all():
        raise ModelError(words)
    return array


def whole(value: Any, name: str, *, lowest: int) -> None:
    """Refuse what is no whole number from ``lowest`` on; ModelError names it."""
    if not isinstance(value, int | np.integer):
        raise ModelError(f"{name} must be a whole number, it is {value}")
    if value < lowest:
        raise ModelError(f"{name} must be at least {lowest}, it is {value}")
