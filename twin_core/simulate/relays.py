"""Heats that a temperature switches, within the steps of a rollout: shares of full power, and their slopes."""

from typing import NamedTuple

import numpy as np
from numba import njit

from twin_core._typing import FloatArray, IntArray


class Relays(NamedTuple):
    """Heats that a state switches, (n_relays,) each.

    Attributes
    ----------
    node, memory
        The state that switches it, and the one that remembers it.
    low, high
        On below, off above.
    rate
        What it adds to the rate of ``node`` at full power.
    off, on
        The memory where it is off and on.
    approach
        How fast the node comes to a threshold.
    """

    node: IntArray
    memory: IntArray
    low: FloatArray
    high: FloatArray
    rate: FloatArray
    off: FloatArray
    on: FloatArray
    approach: FloatArray


_NOTHING, _NOWHERE = np.zeros(0), np.zeros(0, dtype=np.int64)
NO_RELAYS = Relays(_NOWHERE, _NOWHERE, _NOTHING, _NOTHING, _NOTHING, _NOTHING, _NOTHING, _NOTHING)

N_KICK = 22
"""Columns of what ``march`` tells of each relay and step: its shares of full power at the begin and the end of the step; the
slopes of both with the memory (2, 3), the node at the begin (4, 5), the low (6, 7) and the high threshold (8, 9) and the node
at the end of the step as it were without a switch (10, 11). From 12 on, the first ten as they were without one."""

UNSETTLED = 0.02
"""A memory this near to off or on, as a share of the way between, is off or on."""


LEAST_TRAVEL = 0.005
"""A state that moves less over a step counts as moving this far where its way tells an instant, in K."""


@njit(cache=True, nogil=True)
def shares_before(relays: Relays, r: int, state: FloatArray, step_s: float, kick: FloatArray) -> float:
    """Tell a relay's shares unless a threshold is passed in the step; return the share in force at its end."""
    kick[:] = 0.0
    slope = (1.0 + UNSETTLED) / (relays.on[r] - relays.off[r])
    share = slope * (state[relays.memory[r]] - relays.off[r]) - 0.5 * UNSETTLED
    if share <= 0.0 or share >= 1.0:
        slope, share = 0.0, min(max(share, 0.0), 1.0)
    here = state[relays.node[r]]
    if relays.low[r] <= here <= relays.high[r]:
        kick[0], kick[1], kick[2], kick[3] = share, share, slope, slope
        return share
    now = 1.0 if here < relays.low[r] else 0.0
    reach = max(relays.approach[r] * step_s, LEAST_TRAVEL)
    beyond = relays.low[r] - here if now == 1.0 else here - relays.high[r]
    passed, gap = min(beyond / reach, 1.0), now - share
    kick[0], kick[1], kick[2] = share + gap * passed, now, (1.0 - passed) * slope
    if passed < 1.0:
        sign = 1.0 if now == 1.0 else -1.0
        kick[4] = -sign * gap / reach
        kick[6 if now == 1.0 else 8] = sign * gap / reach
    return now


@njit(cache=True, nogil=True)
def switch(relays: Relays, r: int, begin: float, end: float, share: float, kick: FloatArray) -> bool:
    """Tell a relay's shares where the step passes a threshold; return whether it does.

    The instant s is told by the chord of the step without a switch. The heat from it on enters as the straight line with its
    mean and first moment over the step: what it adds is (1 - s)(1 - 3 s) at the begin and (1 - s)(1 + 3 s) at the end.
    """
    if end < relays.low[r] and share < 1.0 and begin >= relays.low[r]:
        now, threshold, column = 1.0, relays.low[r], 6
    elif end > relays.high[r] and share > 0.0 and begin <= relays.high[r]:
        now, threshold, column = 0.0, relays.high[r], 8
    else:
        return False
    kick[12:] = kick[:10]
    travel, gap = end - begin, now - share
    s = (threshold - begin) / travel
    by_s = (gap * (6.0 * s - 4.0), gap * (2.0 - 6.0 * s))
    shares = ((1.0 - s) * (1.0 - 3.0 * s), (1.0 - s) * (1.0 + 3.0 * s))
    for side in range(2):
        kick[side] += gap * shares[side]
        kick[2 + side] *= 1.0 - shares[side]
        kick[4 + side] -= by_s[side] * (1.0 - s) / travel
        kick[column + side] += by_s[side] / travel
        kick[10 + side] -= by_s[side] * s / travel
    return True


@njit(cache=True, nogil=True)
def is_recalled(relays: Relays, r: int, begin: FloatArray, kick: FloatArray) -> bool:
    """Return whether a relay's memory was set in a step: its threshold lay behind, or was passed."""
    inside = relays.low[r] <= begin[relays.node[r]] <= relays.high[r]
    return not inside or kick[10] != 0.0 or kick[11] != 0.0
