"""Which samples may enter the archive: none that lies ahead of the present, so that a wrong clock cannot move it.

The present is the clock of this machine when a sample is received, plus a tolerance. Recordings are allowed to differ:

- A twin all of whose samples lie ahead runs on a clock of its own (a simulation of next year): all of them enter. Where samples
  come that are of the present, or more samples of the past than there are ahead, it does not, and those ahead go into quarantine.
- A recording may run on past the present as long as its samples follow one another, in steps of at most ``FAR`` usual ones. This
  does not hold where the newest samples came when they were taken: nothing of a live twin is of the future.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.store import appending, aside, rewrite, samples
from service.store.appending import Receipt
from service.store.batch import Batch
from service.store.connection import Connection
from service.store.merge import QUARANTINED
from service.store.quarters import EVER_US
from service.store.segments import WITHIN, within

FAR = 10.0
"""In usual distances: a sample that lies further ahead of the others does not follow them."""
RECENT = 12
"""So many of the last samples tell their usual distance, and whether they came live."""


def admit(connection: Connection, twin: int, batch: Batch, tolerance_us: int, *, compacts: bool = True) -> Receipt:
    """Store what is new in a batch, and put into quarantine what lies ahead of the present.

    Parameters
    ----------
    batch
        With the instants of its reception.
    tolerance_us
        By how much a clock may be fast; 0: whatever comes is stored.
    compacts
        See ``appending.append``.
    """
    if tolerance_us == 0 or not batch.time_us.size:
        return appending.append(connection, twin, batch, compacts=compacts)
    limit_us = _greatest(batch.received) + tolerance_us
    if _greatest(batch.time_us) <= limit_us:
        receipt = appending.append(connection, twin, batch, compacts=compacts)
    else:
        receipt = _admit_some(connection, twin, batch, limit_us)
    if receipt.last_us is not None and receipt.last_us > limit_us and bool((batch.time_us <= limit_us).any()):
        moved = _recover(connection, twin, batch, limit_us, tolerance_us)
        if moved:
            last_us = connection.execute("SELECT last_us FROM head WHERE twin = ?", (twin,)).fetchone()[0]
            return replace(receipt, moved=moved, last_us=last_us)
    return receipt


def _greatest(instants: NDArray[np.int64]) -> int:
    """Return the last of some instants; of one, without what looking through an array costs."""
    return int(instants[0]) if instants.size == 1 else int(instants.max())


def _admit_some(connection: Connection, twin: int, batch: Batch, limit_us: int) -> Receipt:
    """Store a batch without the samples that neither are of the present nor go on from it."""
    ahead = batch.time_us > limit_us
    ahead[ahead] &= batch.time_us[ahead] > _reach_us(connection, twin, batch, limit_us)
    if ahead.any():  # what is in the archive already is no news
        span = (int(batch.time_us[ahead].min()), int(batch.time_us[ahead].max()) + 1)
        ahead &= ~np.isin(batch.time_us, samples.arrived(connection, twin, -1, *span))
    if not ahead.any():
        return appending.append(connection, twin, batch)
    receipt = appending.append(connection, twin, batch.take(~ahead))
    aside.quarantine(connection, twin, batch.take(ahead))
    status = np.full(batch.time_us.size, QUARANTINED, dtype=np.int8)
    status[~ahead] = receipt.status
    return replace(receipt, status=status)


def _reach_us(connection: Connection, twin: int, batch: Batch, limit_us: int) -> int:
    """Return the last instant that follows from what is known, although it lies ahead of the present."""
    row = connection.execute("SELECT first_us, last_us FROM head WHERE twin = ?", (twin,)).fetchone()
    first_us, last_us = (None, None) if row is None else row
    ahead = np.unique(batch.time_us[batch.time_us > limit_us])
    past = np.unique(batch.time_us[batch.time_us <= limit_us])
    if (past.size == 0) if first_us is None else first_us > limit_us:
        return int(ahead[-1])  # a clock of its own
    recent = samples.newest(connection, twin, batch.values.shape[0], RECENT)
    if _is_live(connection, twin, recent.time_us, limit_us, batch):
        return limit_us
    known = np.unique(np.concatenate([recent.time_us, past]))[-RECENT:]
    if known.size < 3:
        return limit_us
    farthest = FAR * float(np.median(np.diff(known)))
    path = np.concatenate([[known[-1] if last_us is None else max(int(known[-1]), last_us)], ahead])
    gaps = np.flatnonzero(np.diff(path) > farthest)
    return int(path[gaps[0]] if gaps.size else path[-1])


def _is_live(connection: Connection, twin: int, recent_us: NDArray[np.int64], limit_us: int, batch: Batch) -> bool:
    """Return whether the last samples of the archive were received when they were taken, within the tolerance."""
    if not recent_us.size:
        return False
    tolerance_us = limit_us - int(batch.received.max())
    query = f"SELECT time, received FROM chunk WHERE {WITHIN} AND received IS NOT NULL"
    delays = [np.empty(0)]
    for time, received in connection.execute(query, within(twin, int(recent_us[0]), EVER_US)):
        time_us = np.frombuffer(time, dtype="<i8")
        delays.append((np.frombuffer(received, dtype="<i8") - time_us)[time_us >= recent_us[0]].astype(np.float64))
    delay_us = np.concatenate(delays)
    return delay_us.size > 0 and bool(np.median(np.abs(delay_us)) <= tolerance_us)


def _recover(connection: Connection, twin: int, batch: Batch, limit_us: int, tolerance_us: int) -> int:
    """Move what the archive holds ahead of the present into quarantine, if it was no clock of its own; return how many."""
    past = batch.time_us <= limit_us
    live = bool((np.abs(batch.received - batch.time_us)[past] <= tolerance_us).any())
    ahead = np.unique(samples.arrived(connection, twin, -1, limit_us + 1, EVER_US))
    (n_samples,) = connection.execute("SELECT samples FROM head WHERE twin = ?", (twin,)).fetchone()
    if not ahead.size or not (live or n_samples - ahead.size > ahead.size):
        return 0
    (last_us,) = connection.execute(
        "SELECT max(first_us) FROM chunk WHERE twin = ? AND first_us <= ?", (twin, limit_us)
    ).fetchone()
    if last_us is None:
        return 0  # nothing of the past was stored
    before = np.unique(samples.arrived(connection, twin, -1, last_us, limit_us + 1))
    usual = np.concatenate([np.diff(before[-RECENT:]), np.diff(ahead[:RECENT])])
    if usual.size and ahead[0] - before[-1] <= FAR * np.median(usual):
        return 0  # one recording that runs on
    n_channels = batch.values.shape[0]
    taken = rewrite.take_out(connection, twin, n_channels, limit_us + 1, EVER_US, None)
    aside.quarantine(connection, twin, taken)
    return int(ahead.size)
