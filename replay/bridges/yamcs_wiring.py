"""Which parameter feeds which channel, in which unit: checked by name before anything flows."""

from collections.abc import Mapping
from dataclasses import dataclass

from replay.bridges.config import YamcsConfig
from replay.bridges.units import Conversion, conversion
from replay.bridges.yamcs_gateway import Declared, Row
from service.schemas import TwinDetail

NUMBERS = ("float", "integer", "enumeration", "boolean", "")
"""Types of parameters that can be read as numbers: states by their raw value."""


@dataclass(frozen=True)
class Wiring:
    """Qualified name -> (channel, conversion into its unit); ``faults`` tells what fits not, one sentence each."""

    feeds: Mapping[str, tuple[str, Conversion]]
    faults: tuple[str, ...]

    def values(self, row: Row) -> dict[str, float]:
        """Return the values of a row by channel, in the channels' units."""
        found = {}
        for name, value in row.values.items():
            if name in self.feeds and not isinstance(value, str):
                channel, convert = self.feeds[name]
                found[channel] = convert(value)
        return found


def wire(config: YamcsConfig, twin: TwinDetail, declared: Mapping[str, Declared]) -> Wiring:
    """Return how parameters feed channels, and every fault by name: nothing is guessed."""
    feeds: dict[str, tuple[str, Conversion]] = {}
    faults = []
    for channel, source in config.parameters.items():
        wanted = twin.specification["channels"].get(channel)
        found = declared.get(source.name)
        if wanted is None:
            faults.append(f"channel '{channel}' is none of the twin '{twin.id}' ({', '.join(twin.channels)})")
            continue
        if found is None:
            faults.append(f"parameter {source.name} is unknown to the mission database")
            continue
        if found.kind not in NUMBERS:
            faults.append(f"parameter {source.name} is of type {found.kind}, no number")
            continue
        if source.unit is not None and found.unit is not None and source.unit != found.unit:
            faults.append(
                f"parameter {source.name}: the configuration says {source.unit}, the mission database {found.unit}"
            )
            continue
        unit = source.unit or found.unit
        convert = conversion(unit, wanted.get("unit"))
        if convert is None:
            stated = f"is in {unit}" if unit else "has no unit in the mission database; state one in the configuration"
            faults.append(f"parameter {source.name} {stated}, channel '{channel}' in {wanted['unit']}")
            continue
        feeds[source.name] = (channel, convert)
    return Wiring(feeds, tuple(faults))
