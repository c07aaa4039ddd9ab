"""Down-sampling for plots: keep the samples that hold the extremes, so that no spike disappears."""

import numpy as np
from numpy.typing import NDArray


def extremes(values: NDArray[np.float64], max_points: int) -> NDArray[np.int64]:
    """Return the indices of at most ``max_points`` samples, in order.

    The samples are cut into equally long blocks; of each block those stay where any channel has its least or its
    greatest value. The first and the last sample always stay. Every point of the plot is thus a measured one.

    Parameters
    ----------
    values : (n_channels, n_times)
        NaN is a missing sample.
    max_points
        At least 2.
    """
    n_channels, n_times = values.shape
    if n_times <= max_points:
        return np.arange(n_times)
    n_blocks = max(1, (max_points - 2) // (2 * max(n_channels, 1)))
    if max_points < 2 * n_channels + 2:
        return np.unique(np.linspace(0, n_times - 1, max_points).astype(np.int64))
    edges = np.linspace(0, n_times, n_blocks + 1).astype(np.int64)
    length = int(np.diff(edges).max())
    index = np.minimum(edges[:-1, None] + np.arange(length), edges[1:, None] - 1)  # the last sample pads a short block
    kept = [np.array([0, n_times - 1])]
    for channel in values:
        block = channel[index]
        missing = np.isnan(block)
        for pick in (np.where(missing, np.inf, block).argmin(axis=1), np.where(missing, -np.inf, block).argmax(axis=1)):
            kept.append(np.take_along_axis(index, pick[:, None], axis=1)[:, 0])
    return np.unique(np.concatenate(kept))
