"""What a bridge is told: which parameter feeds which channel, and what to publish where."""

import re
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from replay.bridges.errors import BridgeError
from replay.bridges.instants import parse_utc_ms

_QUALIFIED = re.compile(r"(/[^/.:\[\] ]+)+")
"""An XTCE name from the root on."""


def _is_qualified(name: str) -> str:
    if not _QUALIFIED.fullmatch(name):
        raise ValueError(f"'{name}' is no qualified name, such as /SAT/thermal/T_px")
    return name


def _is_instant(text: str) -> str:
    try:
        parse_utc_ms(text)
    except BridgeError as error:
        raise ValueError(str(error)) from error
    return text


Qualified = Annotated[str, AfterValidator(_is_qualified)]
Instant = Annotated[str, AfterValidator(_is_instant)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Source(_Strict):
    """A parameter that feeds a channel; ``unit`` is needed where the mission database states none."""

    name: Qualified
    unit: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _a_name_suffices(cls, data: Any) -> Any:
        return {"name": data} if isinstance(data, str) else data


class Forecasts(_Strict):
    """How far ahead forecasts are published, and how far apart."""

    lead_s: Annotated[float, Field(gt=0, le=30 * 86400)] = 3600.0
    step_s: Annotated[float, Field(ge=0.1)] = 60.0


class Backfill(_Strict):
    """What is fetched from the archive: all since ``start`` at first, then ``look_back_s`` every ``every_s``."""

    start: Instant | None = None
    look_back_s: Annotated[float, Field(gt=0)] = 86400.0
    every_s: Annotated[float, Field(ge=1)] = 300.0


class YamcsConfig(_Strict):
    """The configuration of ``twin bridge yamcs``.

    Attributes
    ----------
    twin
        The twin's id.
    parameters
        Channel of the twin -> parameter of Yamcs that feeds it.
    system
        Space system below which everything is published: ``/THERMAL_TWIN/<twin>`` by default.
    stream, dump_stream
        Parameter streams of the instance for what is new, and for what belongs to the past.
    report_url
        How links to reports begin, as operators reach the service; its own address by default.
    """

    twin: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,62}$")]
    parameters: Annotated[dict[str, Source], Field(min_length=1)]
    system: Qualified | None = None
    stream: str = "pp_realtime"
    dump_stream: str = "pp_dump"
    report_url: str | None = None
    forecast: Forecasts = Forecasts()
    backfill: Backfill = Backfill()
    health_s: Annotated[float, Field(ge=1)] = 10.0

    @model_validator(mode="after")
    def _one_channel_each(self) -> "YamcsConfig":
        feeds: dict[str, str] = {}
        for channel, source in self.parameters.items():
            if source.name in feeds:
                raise ValueError(f"{source.name} feeds both {feeds[source.name]} and {channel}")
            feeds[source.name] = channel
        return self

    @property
    def root(self) -> str:
        """Qualified name of the space system that holds what is published."""
        return self.system or f"/THERMAL_TWIN/{self.twin}"

    @property
    def source(self) -> str:
        """Source that events bear."""
        return f"thermal-twin/{self.twin}"


def read_config(path: Path) -> YamcsConfig:
    """Read a configuration, YAML or JSON; BridgeError names file and field."""
    try:
        data = yaml.safe_load(path.read_text())
    except OSError as error:
        raise BridgeError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise BridgeError(f"{path}: is no YAML ({' '.join(str(error).split())})") from error
    if not isinstance(data, dict):
        raise BridgeError(f"{path}: is no configuration; it needs 'twin' and 'parameters'")
    try:
        return YamcsConfig.model_validate(data)
    except ValidationError as error:
        faults = [f"{'.'.join(map(str, e['loc'])) or 'the whole'}: {e['msg']}" for e in error.errors()]
        raise BridgeError(f"{path}: {'; '.join(faults)}") from error
