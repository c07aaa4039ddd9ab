"""What becomes of each arriving sample: stored, known already, or in conflict. The first value always stays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ACCEPTED, DUPLICATE, CONFLICT, QUARANTINED = 0, 1, 2, 3


@dataclass(frozen=True)
class Merge:
    """The fate of a batch.

    Attributes
    ----------
    status : (n_times,)
        ACCEPTED, DUPLICATE or CONFLICT (QUARANTINED is decided before), in the order of arrival.
    n_instants
        How many instants are new to the archive.
    """

    status: NDArray[np.int8]
    n_instants: int


def merge(
    stored_us: NDArray[np.int64], stored: NDArray[np.float64], time_us: NDArray[np.int64], values: NDArray[np.float64]
) -> Merge:
    """Decide about each arriving sample as if they came one after another.

    A sample whose instant is new is accepted. At a known instant it is a conflict if any channel has another value
    there, accepted if it adds a channel that was missing, and otherwise a duplicate.

    Parameters
    ----------
    stored_us, stored : (n_stored,), (n_channels, n_stored)
        What the archive holds at these instants, each instant once.
    time_us, values : (n_times,), (n_channels, n_times)
        What arrives, in the order of arrival.
    """
    axis = np.unique(np.concatenate([stored_us, time_us]))
    known = np.isin(axis, stored_us)
    n_known = int(known.sum())
    state = np.full((values.shape[0], axis.size), np.nan)
    state[:, known] = stored[:, np.argsort(stored_us)]
    position = np.searchsorted(axis, time_us)
    status = np.empty(time_us.size, dtype=np.int8)
    pending = np.arange(time_us.size)
    while pending.size:  # at most n_channels + 1 rounds: each adds a channel to every instant that stays pending
        here, new = state[:, position[pending]], values[:, pending]
        conflict = (~np.isnan(here) & ~np.isnan(new) & (here != new)).any(axis=0)
        adds = (np.isnan(here) & ~np.isnan(new)).any(axis=0) | ~known[position[pending]]
        status[pending] = np.where(conflict, CONFLICT, DUPLICATE)
        hopeful = pending[~conflict & adds]
        _, first = np.unique(position[hopeful], return_index=True)
        taken = hopeful[first]
        status[taken] = ACCEPTED
        slots = position[taken]
        state[:, slots] = np.where(np.isnan(state[:, slots]), values[:, taken], state[:, slots])
        known[slots] = True
        pending = np.delete(hopeful, first)
    return Merge(status, int(known.sum()) - n_known)


def collapse(time_us: NDArray[np.int64], values: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return samples sorted by time with each instant once, its channels gathered from all samples there.

    Parameters
    ----------
    time_us, values : (n_times,), (n_channels, n_times)
        In any order; no two samples of an instant disagree about a channel.
    """
    if bool((time_us[1:] > time_us[:-1]).all()):
        return time_us, values
    order = np.argsort(time_us, kind="stable")
    time_us, values = time_us[order], values[:, order]
    first = np.flatnonzero(np.diff(time_us, prepend=time_us[0] - 1))
    if first.size == time_us.size:
        return time_us, values
    return time_us[first], np.fmax.reduceat(values, first, axis=1)
