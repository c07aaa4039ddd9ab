"""What a bridge publishes, as XTCE for the mission database; and limits of the mission as limits of a twin."""

from collections.abc import Mapping
from typing import Any

from yamcs.pymdb import (
    DataSource,
    EnumeratedParameter,
    FloatParameter,
    IntegerParameter,
    Subsystem,
    System,
    ThresholdAlarm,
)

from replay.bridges.config import YamcsConfig
from replay.bridges.errors import BridgeError
from replay.bridges.units import conversion
from replay.bridges.yamcs_gateway import Declared
from replay.bridges.yamcs_names import HEALTH, HEALTH_STATES, ISSUED_BY, NIS, PER_SENSOR, VERSION, sensors_of
from service.schemas import TwinDetail

YELLOW, RED = ("WARNING", "WATCH"), ("CRITICAL", "DISTRESS", "SEVERE")
"""Alarm levels of XTCE that are taken as a limit of that colour: the first one that is there."""


def write_xtce(config: YamcsConfig, twin: TwinDetail) -> str:
    """Return XTCE that declares everything that is published, with the twin's limits as alarms of its forecasts."""
    first, *others = config.root.strip("/").split("/")
    root: System = System(first)
    place = root
    for name in others:
        place = Subsystem(place, name)
    ground: dict[str, Any] = {"data_source": DataSource.GROUND}
    EnumeratedParameter(place, HEALTH, choices=list(enumerate(HEALTH_STATES)), **ground)
    FloatParameter(place, NIS, bits=64, short_description="Normalised innovation squared", **ground)
    for name, what in ((VERSION, "Model that residuals rest on"), (ISSUED_BY, "Model of forecasts")):
        IntegerParameter(place, name, signed=False, bits=32, short_description=what, **ground)
    for sensor in sensors_of(twin):
        channel = twin.specification["channels"][sensor]
        system = Subsystem(place, sensor.replace(".", "_"))
        for what, description in PER_SENSOR.items():
            in_kelvin = what.startswith("residual")
            FloatParameter(
                system,
                what,
                bits=64,
                units="K" if in_kelvin else channel["unit"],
                short_description=f"{sensor}: {description[0].lower()}{description[1:]}",
                alarm=None if in_kelvin else _alarm(channel.get("limits")),
                **ground,
            )
    return str(root.dumps())


def _alarm(limits: Mapping[str, Any] | None) -> ThresholdAlarm | None:
    if not limits:
        return None
    ends = {
        f"{level}_{side}": bound
        for colour, level in (("yellow", "warning"), ("red", "critical"))
        for side, bound in zip(("low", "high"), limits.get(colour) or (None, None), strict=True)
        if bound is not None
    }
    return ThresholdAlarm(**ends) if ends else None


Limits = dict[str, dict[str, list[float | None]]]
"""Channel -> colour -> low and high."""


def read_limits(
    config: YamcsConfig, channels: Mapping[str, Mapping[str, Any]], declared: Mapping[str, Declared]
) -> tuple[Limits, list[str]]:
    """Return the limits of the mission's parameters by channel, in the channels' units, and what was not taken.

    Raises
    ------
    BridgeError
        If a unit does not fit: a limit is never guessed.
    """
    limits: Limits = {}
    notices: list[str] = []
    for channel, source in config.parameters.items():
        found = declared.get(source.name)
        if found is None or channel not in channels:
            what = f"{source.name}: unknown to the mission database" if found is None else f"{channel}: no such channel"
            notices.append(what)
            continue
        if found.has_contexts:
            notices.append(f"{source.name}: alarms that depend on a context are not taken")
        levels = {
            colour: next((level for level in order if level in found.ranges), None)
            for colour, order in (("yellow", YELLOW), ("red", RED))
        }
        unused = sorted(found.ranges.keys() - {level for level in levels.values() if level})
        if unused:
            notices.append(f"{source.name}: a twin has two colours; {', '.join(unused)} not taken")
        if not any(levels.values()):
            continue
        convert = conversion(source.unit or found.unit, channels[channel].get("unit"))
        if convert is None:
            raise BridgeError(
                f"parameter {source.name} is in {source.unit or found.unit}, channel '{channel}' in "
                f"{channels[channel].get('unit')}; its limits cannot be converted"
            )
        limits[channel] = {
            colour: [None if end is None else round(convert(end), 9) for end in found.ranges[level]]
            for colour, level in levels.items()
            if level is not None
        }
    return limits, notices
