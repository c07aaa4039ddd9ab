"""Settings: read once from ``TWIN_*`` environment variables into one frozen record."""

import ipaddress
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pydantic import Field, SecretStr, ValidationError, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from service.keys import Key, Keys, parse_keys
from twin_core.errors import TwinError

MIB = 1024 * 1024
POSTGRES = "postgresql://"


class SettingsError(TwinError):
    """A setting is wrong, or the settings together would be unsafe."""


def is_loopback(host: str) -> bool:
    """Return whether an address can only be reached from this machine."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Settings(BaseSettings):
    """Everything that the service can be told. Each field is read from ``TWIN_<FIELD>``."""

    model_config = SettingsConfigDict(env_prefix="TWIN_", frozen=True, extra="ignore")

    host: str = Field("127.0.0.1", description="Address to listen on; anything but loopback needs TWIN_API_KEYS.")
    port: int = Field(8000, ge=0, le=65535, description="Port to listen on; 0 picks a free one.")
    database_url: str = Field(
        "sqlite:///thermal-twin.sqlite3",
        repr=False,  # it may hold a password
        description="Where everything is stored: a SQLite file, or postgresql://… for several processes.",
    )
    api_keys: SecretStr = Field(SecretStr(""), description="role:key pairs separated by commas.")
    api_keys_file: Path | None = Field(
        None, description="File with a line 'name role key [expires]' per key; read again whenever it changes."
    )
    max_body_bytes: int = Field(16 * MIB, ge=1024, description="Largest request body, after decompression.")
    body_timeout_s: float = Field(
        30.0, gt=0, description="Longest wait for a request head, or a body (plus 1 s per 32 KiB)."
    )
    stream_buffer: int = Field(
        20_000, ge=10, description="Messages a slow reader may lag behind before some are dropped."
    )
    job_workers: int = Field(
        1,
        ge=0,
        le=64,
        description="Calibrations and diagnoses that this process runs at the same time; 0: others do (`twin worker`).",
    )
    executor: str = Field(
        "process",
        pattern=r"^(process|dask://[^/]+:[0-9]+)$",
        description="Where jobs compute: `process`, or `dask://HOST:PORT`, the scheduler of a Dask cluster.",
    )
    job_deadline_s: float = Field(3600.0, gt=0, description="A job that runs longer is ended and marked failed.")
    job_search_s: float = Field(
        240.0, gt=0, description="A job that searches longer goes on with the best so far unless its request says more."
    )
    job_values: int = Field(
        250_000,
        ge=1000,
        description="Most values, samples times channels, that a job takes unless its request says more.",
    )
    job_memory_mib: int = Field(2048, ge=256, description="A job that needs more memory is ended and marked failed.")
    assimilate: bool = Field(True, description="Whether new samples update the state of the active model.")
    assimilate_samples: int = Field(
        200_000, ge=1000, description="A model that becomes active follows at most so many samples of the past."
    )
    calibrate_every_s: float | None = Field(None, gt=0, description="Recalibrate on this schedule; unset: on request.")
    anomaly_patience_s: float = Field(3600.0, ge=0, description="Recalibrate if an anomaly lasts so long; 0: never.")
    refutation_rate: float = Field(
        0.01,
        ge=0,
        lt=1,
        description="False discovery rate at which models count as refuted and are diagnosed; 0: never.",
    )
    false_alarm_rate: float = Field(
        2e-8, gt=0, le=1e-4, description="Chance that a statistic of a healthy sensor alarms at one sample."
    )
    effects: str = Field("", description="Plug-ins with effects of your own: Python files, separated by colons.")
    limit_horizon_s: float = Field(
        21_600.0, ge=0, le=1e7, description="How far ahead forecasts are watched for limits; 0: not at all."
    )
    clock_tolerance_s: float = Field(
        300.0,
        ge=0,
        le=1e9,
        description="Samples further ahead of this machine's clock go into quarantine; 0: none does.",
    )
    traces_url: str = Field(
        "",
        pattern="^(https?://.+)?$",
        description="Collector of OpenTelemetry traces, OTLP over HTTP; needs thermal-twin[traces]. Empty: no traces.",
    )
    metrics_port: int | None = Field(
        None, ge=0, le=65535, description="Port at which `twin worker` serves /metrics; 0: a free one. Unset: nowhere."
    )
    metrics_host: str = Field(
        "127.0.0.1", description="Address of those metrics, for which no key is needed: they show no telemetry."
    )
    log_level: str = Field("info", pattern="^(debug|info|warning|error)$", description="Least severe message logged.")

    @field_validator("database_url")
    @classmethod
    def _is_known(cls, value: str) -> str:
        if value.startswith(POSTGRES):
            return value
        if not value.startswith("sqlite:///") or len(value) <= len("sqlite:///"):
            raise ValueError("must be sqlite:///FILE (sqlite:////FILE for an absolute path) or postgresql://…")
        if value.removeprefix("sqlite:///").startswith((":memory:", "file:")):
            raise ValueError("must name a file: what is in memory only does not survive, and readers would not see it")
        return value

    @field_validator("api_keys")
    @classmethod
    def _keys_parse(cls, value: SecretStr) -> SecretStr:
        parse_keys(value.get_secret_value())
        return value

    @model_validator(mode="after")
    def _open_only_on_loopback(self) -> "Settings":
        if self.api_keys_file is None and not self.fixed_keys and not is_loopback(self.host):
            raise ValueError(f"host {self.host} is not loopback and TWIN_API_KEYS is empty; set keys or use 127.0.0.1")
        return self

    @property
    def fixed_keys(self) -> tuple[Key, ...]:
        """The API keys of the environment."""
        return parse_keys(self.api_keys.get_secret_value())

    @property
    def keys(self) -> Keys:
        """All API keys; SettingsError if their file cannot be used."""
        try:
            return Keys(self.fixed_keys, self.api_keys_file)
        except (ValueError, OSError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            raise SettingsError(f"TWIN_API_KEYS_FILE: {self.api_keys_file}: {reason}") from None

    @property
    def effect_files(self) -> tuple[Path, ...]:
        """The plug-ins with effects."""
        return tuple(Path(file) for file in self.effects.split(os.pathsep) if file)

    @property
    def database_path(self) -> Path:
        """The SQLite file; SettingsError if it is a server instead."""
        if self.database_url.startswith(POSTGRES):
            raise SettingsError(
                "TWIN_DATABASE_URL: names a PostgreSQL server; use its own tools there (pg_dump, pg_restore)"
            )
        return Path(self.database_url.removeprefix("sqlite:///"))

    @property
    def database(self) -> Path | str:
        """The SQLite file, or the URL of the PostgreSQL database."""
        return self.database_url if self.database_url.startswith(POSTGRES) else self.database_path


OF_OTHERS = frozenset({"TWIN_API_KEY"})
"""Variables that the clients of the service read."""


def unknown_variables(environment: Iterable[str]) -> list[str]:
    """Return the names that look like settings and are none, most likely misspelt."""
    known = {f"TWIN_{name.upper()}" for name in Settings.model_fields} | OF_OTHERS
    return sorted(name for name in environment if name.upper().startswith("TWIN_") and name.upper() not in known)


def read_settings(**overrides: Any) -> Settings:
    """Return the settings of the environment, with ``overrides`` in their place.

    Raises
    ------
    SettingsError
        With one line naming the variable, and never its value where it is secret.
    """
    try:
        return Settings(**overrides)
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        name = f"TWIN_{str(first['loc'][0]).upper()}: " if first["loc"] else ""
        raise SettingsError(name + first["msg"].removeprefix("Value error, ")) from None
