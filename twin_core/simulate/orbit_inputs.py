"""The channels that come from the orbit, over the steps of a rollout."""

from collections.abc import Sequence

import numpy as np

from twin_core._typing import FloatArray
from twin_core.errors import SpecError, TelemetryError
from twin_core.network.orbit_block import PREFIX, OrbitBlock
from twin_core.network.spec import TwinSpec
from twin_core.orbit.attitude import Commanded
from twin_core.orbit.means import over_steps
from twin_core.telemetry import Record
from twin_core.units import format_instant

STALE_DAYS = 14.0
"""Elements further from the telemetry are told: SGP4 is off by 1 to 3 km a day in a low orbit (Vallado et al. 2006),
which after two weeks makes eclipses come some seconds early or late."""


def orbit_inputs(
    spec: TwinSpec, record: Record, begin_s: FloatArray, step_s: FloatArray, at: FloatArray
) -> dict[str, FloatArray]:
    """Return the channels of the orbit over time steps; none where no orbit is declared.

    Parameters
    ----------
    spec
        Declares the orbit.
    record
        Gives the dates, and the attitude where it is told by channels.
    begin_s, step_s : (n_steps,)
        On the record's own axis.
    at : (n_points,)
        Places in a step, 0 at its beginning and 1 at its end.

    Returns
    -------
    dict
        Channel -> (n_steps, n_points): on the straight line that has the channel's mean and first moment over the step.

    Raises
    ------
    TelemetryError
        If the record carries no dates, or lacks the attitude.
    SpecError
        If the orbit cannot be followed over the record.
    """
    if spec.orbit is None:
        return {}
    if record.epoch_ns is None:
        raise TelemetryError(f"{record.name}: the orbit needs dates; give a 'time' column in RFC 3339, not 'time_s'")
    environment = spec.orbit.environment(_told_attitude(spec.orbit, record))
    try:
        lines = over_steps(environment, record.epoch_ns, begin_s, step_s, at)
    except SpecError as error:
        raise SpecError(f"orbit.{error}") from error
    return {PREFIX + name: line for name, line in lines.items()}


def _told_attitude(orbit: OrbitBlock, record: Record) -> Commanded | None:
    """Return the attitude that the telemetry tells, None where it is declared."""
    names = orbit.attitude.quaternion_channels
    if names is None:
        return None
    parts = np.stack([record.channel(name) for name in names], axis=1)
    known = np.isfinite(parts).all(axis=1) & (np.abs(np.nan_to_num(parts)).max(axis=1) > 0.0)
    if not known.any():
        raise TelemetryError(f"{record.name}: channels {', '.join(names)} tell no attitude; the orbit needs it")
    return Commanded(orbit.attitude.frame or "inertial", record.time_s[known], parts[known])


def orbit_notices(spec: TwinSpec, records: Sequence[Record]) -> tuple[str, ...]:
    """Return what should be known about the orbit's elements for these records: how far off in time they are."""
    if spec.orbit is None:
        return ()
    epoch_ns = spec.orbit.elements.epoch_ns
    ends = [r.epoch_ns + float(t) * 1e9 for r in records if r.epoch_ns is not None for t in (r.time_s[0], r.time_s[-1])]
    days = max((abs(end - epoch_ns) for end in ends), default=0.0) / 86_400e9
    if days <= STALE_DAYS:
        return ()
    return (
        f"orbit.tle: elements of {format_instant(epoch_ns)[:10]} are {days:.0f} days from the telemetry; eclipses may be"
        " seconds off for each week; give elements of its time",
    )
