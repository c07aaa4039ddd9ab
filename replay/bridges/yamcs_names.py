"""What a bridge publishes, and under which names."""

from replay.bridges.config import YamcsConfig
from service.schemas import TwinDetail

PER_SENSOR = {
    "forecast": "Expected temperature",
    "q05": "Temperature that is exceeded with 95 % probability",
    "q95": "Temperature that is exceeded with 5 % probability",
    "residual": "Measured less predicted one sample ahead",
    "residual_sigma": "Standard deviation of the residual that the model expects",
}
VERSION, ISSUED_BY = "model_version", "forecast_model_version"
"""Published with every row of residuals, and of forecasts: by them the bridge knows what is there already."""
NIS, HEALTH = "nis", "health"
HEALTHY, NO_MODEL, CATCHING_UP, STALE, SERVICE_AWAY = "OK", "NO_MODEL", "CATCHING_UP", "STALE", "SERVICE_AWAY"
HEALTH_STATES = (HEALTHY, NO_MODEL, CATCHING_UP, STALE, SERVICE_AWAY)


def name_of(config: YamcsConfig, *parts: str) -> str:
    """Return the qualified name of something published; dots, which XTCE does not allow in names, become underscores."""
    return "/".join([config.root, *(part.replace(".", "_") for part in parts)])


def sensors_of(twin: TwinDetail) -> list[str]:
    """Return the channels that are sensors of a node, which the twin predicts; a boundary's temperature is not among them."""
    named = [node["sensor"] for node in twin.specification["nodes"] if node.get("sensor")]
    sensors = {name for entry in named for name in ([entry] if isinstance(entry, str) else entry)}
    return [name for name in twin.channels if name in sensors]


def published_names(config: YamcsConfig, twin: TwinDetail) -> list[str]:
    """Return the qualified names of everything that is published for a twin."""
    own = [name_of(config, name) for name in (HEALTH, NIS, VERSION, ISSUED_BY)]
    return own + [name_of(config, sensor, what) for sensor in sensors_of(twin) for what in PER_SENSOR]
