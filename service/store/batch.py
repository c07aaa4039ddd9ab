"""Samples on their way into the store."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.instants import Instants

MOST_VALUES = 2**24
"""Of one batch, missing ones included: a short body may stand for very many of them. 16 MiB of numbers are always fewer."""


@dataclass(frozen=True)
class Batch:
    """Samples in the order of their arrival.

    Attributes
    ----------
    time_us : (n_times,)
        Microseconds since 1970.
    values : (n_channels, n_times)
        In the channels' own units, rows in the order of the twin's channels; NaN is a missing sample.
    received_us
        When each arrived, (n_times,) microseconds since 1970 of this machine's clock; None where nobody noted it.
    """

    time_us: Instants
    values: NDArray[np.float64]
    received_us: Instants | None = None

    @property
    def received(self) -> Instants:
        """When each sample arrived, (n_times,); 0 where nobody noted it."""
        return np.zeros_like(self.time_us) if self.received_us is None else self.received_us

    def take(self, keep: NDArray[np.bool_] | slice) -> "Batch":
        """Return the samples that a mask, or a slice, selects."""
        received_us = None if self.received_us is None else self.received_us[keep]
        return Batch(self.time_us[keep], self.values[:, keep], received_us)
