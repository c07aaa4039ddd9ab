"""The quantities of an orbit over time steps: what a rollout needs so that no heat is lost between samples.

Sunlight goes out within seconds and comes back within seconds, samples are minutes apart. Over each step a quantity is
therefore given as the straight line that has its mean and its first moment: the heat of the step is exact, and so is, to
first order, when in the step it came. The line is made flatter where it would leave the range that the quantity can have.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from twin_core._typing import BoolArray, FloatArray, IntArray
from twin_core.orbit.environment import BETA, ECLIPSE, Environment
from twin_core.orbit.sky import Sky

PIECE_S = 60.0
"""Longest piece of a step with two Gauss points: over it a low orbit turns by 4 degrees, and the means of what turns
with it are right to 1e-8; kinks, where a face turns away, cost 1e-5 of an orbit's heat."""

MOST_PIECES = 2000
"""Pieces of one step at most: what lies in a step of more than a day nobody resolves."""

EDGE_PARTS = 16
"""Parts of a piece in which the Sun sets or rises, two Gauss points each: 2 s, a fraction of a low orbit's penumbra."""

AT_ONCE = 50_000
"""Pieces that are computed at once: some hundred bytes each."""

_GAUSS = np.array([0.5 - np.sqrt(3.0) / 6.0, 0.5 + np.sqrt(3.0) / 6.0])


def over_steps(
    environment: Environment, epoch_ns: int, begin_s: FloatArray, step_s: FloatArray, at: FloatArray
) -> dict[str, FloatArray]:
    """Return the quantities of an orbit as straight lines over time steps.

    Parameters
    ----------
    environment
        Orbit, attitude and Earth.
    epoch_ns
        Unix nanoseconds of time 0.
    begin_s, step_s : (n_steps,)
        Where the steps begin, and how long they are.
    at : (n_points,)
        Places in a step, 0 at its beginning and 1 at its end, at which the lines are wanted.

    Returns
    -------
    dict
        Name (see :meth:`Environment.quantities`) -> (n_steps, n_points).

    Raises
    ------
    SpecError
        If the orbit cannot be followed over the steps.
    """
    parts = [
        _lines(environment, epoch_ns, begin_s[window], step_s[window], at) for window in _windows(np.asarray(step_s))
    ]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _windows(step_s: FloatArray) -> Iterator[slice]:
    """Yield stretches of steps of at most ``AT_ONCE`` pieces, or of a single step."""
    last = np.cumsum(_n_pieces(step_s))
    first = 0
    while True:
        done = last[first - 1] if first else 0
        stop = max(first + 1, int(np.searchsorted(last, done + AT_ONCE, side="right")))
        yield slice(first, stop)
        if stop >= step_s.size:
            return
        first = stop


def _n_pieces(step_s: FloatArray) -> IntArray:
    return np.clip(np.ceil(step_s / PIECE_S - 1e-9), 1, MOST_PIECES).astype(np.int64)


class _Points(NamedTuple):
    """Where a quadrature looks: in which step, at which share of it, with which weight, each (n_points,)."""

    step: IntArray
    place: FloatArray
    weight: FloatArray

    def time_s(self, begin_s: FloatArray, step_s: FloatArray) -> FloatArray:
        """Return when that is."""
        return begin_s[self.step] + step_s[self.step] * self.place

    def take(self, index: IntArray) -> "_Points":
        """Return some of the points."""
        return _Points(self.step[index], self.place[index], self.weight[index])


def _gauss(step: IntArray, begin: FloatArray, length: FloatArray) -> _Points:
    """Return two points for each piece that begins at a share of its step and lasts for another, (n_pieces,)."""
    place = begin[:, None] + length[:, None] * _GAUSS
    return _Points(np.repeat(step, 2), place.ravel(), np.repeat(0.5 * length, 2))


def _lines(
    environment: Environment, epoch_ns: int, begin_s: FloatArray, step_s: FloatArray, at: FloatArray
) -> dict[str, FloatArray]:
    counts = _n_pieces(step_s)
    step = np.repeat(np.arange(counts.size), counts)
    length = 1.0 / counts[step]
    begin = (np.arange(step.size) - np.repeat(np.cumsum(counts) - counts, counts)) * length
    points = _gauss(step, begin, length)
    sky = environment.sky(epoch_ns, points.time_s(begin_s, step_s))
    edge = _has_edge(sky, length * step_s[step])
    plain = np.flatnonzero(np.repeat(~edge, 2))
    seen = [(points.take(plain), sky.take(plain))]
    if edge.any():
        parts = np.arange(EDGE_PARTS) / EDGE_PARTS
        again = (begin[edge][:, None] + length[edge][:, None] * parts).ravel()
        fine = _gauss(np.repeat(step[edge], EDGE_PARTS), again, np.repeat(length[edge] / EDGE_PARTS, EDGE_PARTS))
        seen.append((fine, environment.sky(epoch_ns, fine.time_s(begin_s, step_s))))
    mean, moment = _summed(environment, seen, step_s.size)
    return {name: _line(name, mean[name], moment[name], at) for name in mean}


def _summed(
    environment: Environment, seen: Sequence[tuple[_Points, Sky]], n_steps: int
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Return means of the quantities over the steps, and first moments about their middle, (n_steps,) each."""
    mean: dict[str, FloatArray] = {}
    moment: dict[str, FloatArray] = {}
    for points, sky in seen:
        arm = points.weight * (points.place - 0.5)
        for name, series in environment.quantities(sky).items():
            for sums, weight in ((mean, points.weight), (moment, arm)):
                part: FloatArray = np.bincount(points.step, weights=weight * series, minlength=n_steps).astype(float)
                sums[name] = sums[name] + part if name in sums else part
    return mean, moment


def _line(name: str, mean: FloatArray, moment: FloatArray, at: FloatArray) -> FloatArray:
    """Return the line that has a mean and a first moment, (n_steps, n_points), within what the quantity can be."""
    rise = 12.0 * moment
    if name != BETA:
        most = 2.0 * np.maximum(mean, 0.0)
        if name == ECLIPSE:
            most = np.minimum(most, 2.0 * np.maximum(1.0 - mean, 0.0))
        rise = np.clip(rise, -most, most)
    return mean[:, None] + rise[:, None] * (np.asarray(at) - 0.5)


def _has_edge(sky: Sky, length_s: FloatArray) -> BoolArray:
    """Return in which pieces the Sun may touch the Earth's limb, (n_pieces,).

    How far the Sun's centre stands above the limb is followed as a straight line through both Gauss points; what it may
    deviate from that, and a grazing passage with it, is covered by the square of the angle that the spacecraft flies.
    """
    sun_radius, earth_radius, apart = (angle.reshape(-1, 2) for angle in sky.discs)
    above = apart - earth_radius
    middle, half = 0.5 * (above[:, 0] + above[:, 1]), np.abs(above[:, 1] - above[:, 0]) * np.sqrt(3.0) / 2.0
    margin = sun_radius[:, 0] + (length_s * _angular_speed(sky)[::2]) ** 2
    return np.abs(middle) <= half + margin


def _angular_speed(sky: Sky) -> FloatArray:
    speed2 = np.einsum("ti,ti->t", sky.velocity_m_per_s, sky.velocity_m_per_s)
    return np.sqrt(speed2 / np.einsum("ti,ti->t", sky.position_m, sky.position_m))
