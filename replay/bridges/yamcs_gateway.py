"""A Yamcs server as the bridge sees it: names and units, values by generation time, a way in, events.

Everything goes through Yamcs' own client. Its exceptions become two: ``BridgeError`` for what trying again does not cure
(wrong credentials, unknown instance, no privilege) and ``Away`` for what it may.
"""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import requests
from requests.adapters import HTTPAdapter
from yamcs.client import (
    ConnectionFailure,
    Credentials,
    NotFound,
    ParameterData,
    Unauthorized,
    YamcsClient,
    YamcsError,
)
from yamcs.protobuf.pvalue.pvalue_service_pb2 import LoadParameterValuesResponse

from replay.bridges.errors import Away, BridgeError
from replay.bridges.events import Note
from replay.bridges.instants import to_datetime, to_ms, to_text
from replay.bridges.yamcs_encoding import CHUNK, USABLE, Row, messages, rows_of, updates

for _chatty in ("yamcs-client", "websocket"):
    logging.getLogger(_chatty).setLevel(logging.CRITICAL)  # the bridge tells itself what breaks, once
TIMEOUT_S = 60.0
"""Longest silence of the server within a request."""
READINGS = 4
_AS_JSON = {"Accept": "application/json"}


@dataclass(frozen=True)
class Declared:
    """What the mission database says of a parameter: its unit, and alarm ranges as level -> (low, high)."""

    unit: str | None
    kind: str
    ranges: Mapping[str, tuple[float | None, float | None]]
    has_contexts: bool = False


class _Patient(HTTPAdapter):
    """Sends requests with a timeout where they have none, for Yamcs' client waits for ever, each over its own connection.

    Yamcs closes a connection behind a streamed answer; a request that meets such a connection in the pool is lost.
    """

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        super().__init__()

    def send(self, request: Any, *args: Any, **options: Any) -> requests.Response:
        options["timeout"] = options.get("timeout") or self._timeout_s
        request.headers["Connection"] = "close"
        return super().send(request, *args, **options)


class YamcsGateway:
    """One instance of one Yamcs server. Use it as a context manager, or close it."""

    def __init__(
        self,
        url: str,
        instance: str,
        processor: str = "realtime",
        username: str | None = None,
        password: str | None = None,
        timeout_s: float = TIMEOUT_S,
    ) -> None:
        """Log in; BridgeError if the server refuses, Away if it does not answer."""
        self.url, self.instance = url.rstrip("/"), instance
        credentials = None if username is None else Credentials(username=username, password=password or "")
        with self._told():
            self._client = YamcsClient(self.url, credentials=credentials)
            for scheme in ("http://", "https://"):
                self._client.ctx.session.mount(scheme, _Patient(timeout_s))
            self._client.ctx.session.trust_env = False
            self._archive = self._client.get_archive(instance)
            self._mdb = self._client.get_mdb(instance)
            self._processor = self._client.get_processor(instance, processor)
            state = self._client.ctx.get_proto(f"/instances/{instance}").status_code
        assert state == 200

    def __enter__(self) -> "YamcsGateway":
        """Return the gateway."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connections."""
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Turn what Yamcs' client raises into the two errors that the bridge tells apart."""
        where = f"Yamcs at {self.url}, instance '{self.instance}'"
        try:
            yield
        except Unauthorized as error:
            raise BridgeError(f"{where} refuses the credentials; check --user and YAMCS_PASSWORD") from error
        except NotFound as error:
            raise BridgeError(f"{where}: {error}") from error
        except (ConnectionFailure, requests.exceptions.RequestException, OSError) as error:
            raise Away(f"{where} does not answer ({type(error).__name__})") from error
        except YamcsError as error:
            if "Client Error" in str(error):
                raise BridgeError(f"{where} refuses: {error}") from error
            raise Away(f"{where}: {error}") from error

    def declared(self, names: Iterable[str]) -> dict[str, Declared]:
        """Return what the mission database says of these parameters; those that it lacks are left out."""
        found = {}
        for name in names:
            try:
                with self._told():
                    parameter = self._mdb.get_parameter(name)
            except BridgeError as error:
                if not isinstance(error.__cause__, NotFound):
                    raise
                continue
            found[name] = _declared(parameter)
        return found

    def publish(self, stream: str, rows: Sequence[Row]) -> int:
        """Send rows into a parameter stream and return how many values the server took.

        The same rows sent once more are the same values: Yamcs keys them by generation time and by their number within
        the request.
        """
        url = f"/parameter-values/{self.instance}/streams/{stream}:load"
        with self._told():
            answer = self._client.ctx.post_proto(url, data=updates(rows))
            return int(LoadParameterValuesResponse.FromString(answer.content).valueCount)

    def history(self, names: Sequence[str], start_ms: int | None, stop_ms: int | None = None) -> Iterator[Row]:
        """Yield the values of start <= generation time < stop from the archive, in the order of time.

        Where Yamcs gives up midway, all is read and yielded again: a replay that is over before Yamcs has seen it begin ends
        as a fault of its server now and then.
        """
        for attempt in range(READINGS):
            try:
                yield from self._read(names, start_ms, stop_ms)
                return
            except Away:
                if attempt + 1 == READINGS:
                    raise

    def _read(self, names: Sequence[str], start_ms: int | None, stop_ms: int | None) -> Iterator[Row]:
        span = {"start": start_ms, "stop": stop_ms}
        question: dict[str, Any] = {"ids": [{"name": name} for name in names]}
        question |= {key: to_text(time_ms) for key, time_ms in span.items() if time_ms is not None}
        url = f"/stream-archive/{self.instance}:streamParameterValues"
        where = f"Yamcs at {self.url}, instance '{self.instance}'"
        with self._told():
            answer = self._client.ctx.request("post", url, json=question, headers=dict(_AS_JSON), stream=True)
            try:
                for document in messages(answer.iter_content(CHUNK)):
                    yield from rows_of(document)
            except ValueError as error:
                raise Away(f"{where}: an answer broke off") from error

    def subscribe(self, names: Sequence[str], take: Callable[[Row], None]) -> Any:
        """Call ``take`` with every new row, from a thread of its own; the answer tells by ``done()`` when it broke off."""

        def hear(data: ParameterData) -> None:
            for row in _rows(data):
                take(row)

        with self._told():
            return self._processor.create_parameter_subscription(
                list(names),
                on_data=hear,
                abort_on_invalid=False,
                send_from_cache=True,
                timeout=TIMEOUT_S,
            )

    def send_event(self, source: str, note: Note) -> None:
        """Send an event; one with the same time, source and number is the same event."""
        extra = {"key": note.key} | ({"link": note.link} if note.link else {})
        with self._told():
            self._client.send_event(
                self.instance,
                note.message,
                event_type=note.kind,
                time=to_datetime(note.time_ms),
                severity=note.severity,
                source=source,
                sequence_number=note.number,
                extra=extra,
            )

    def event_keys(self, source: str, start_ms: int) -> set[str]:
        """Return the keys of the events of a source from an instant on."""
        with self._told():
            found = self._archive.list_events(source=source, start=to_datetime(start_ms))
            return {event.extra["key"] for event in found if "key" in (event.extra or {})}


def _declared(parameter: Any) -> Declared:
    proto = parameter._proto.type  # alarms are not among what the client wraps
    alarm = proto.defaultAlarm
    ranges = {_level(found): _ends(found) for found in alarm.staticAlarmRanges}
    units = parameter.units
    return Declared(units[0] if units else None, parameter.type or "", ranges, bool(proto.contextAlarm))


def _level(found: Any) -> str:
    field = type(found).DESCRIPTOR.fields_by_name["level"]
    return str(field.enum_type.values_by_number[found.level].name)


def _ends(found: Any) -> tuple[float | None, float | None]:
    """Return the range outside which the alarm is raised; exclusive ends count as inclusive ones."""
    low = next((getattr(found, n) for n in ("minInclusive", "minExclusive") if found.HasField(n)), None)
    high = next((getattr(found, n) for n in ("maxInclusive", "maxExclusive") if found.HasField(n)), None)
    return low, high


def _rows(data: ParameterData) -> Iterator[Row]:
    """Yield one row per generation time, in their order; what is no reading, or no number, is left out."""
    rows: dict[datetime, dict[str, float | str]] = {}
    for value in data.parameters:
        number = _number(value)
        if number is not None and value.validity_status in (None, USABLE):
            rows.setdefault(value.generation_time, {})[value.name] = number
    for when in sorted(rows):
        yield Row(to_ms(when), rows[when])


def _number(value: Any) -> float | None:
    """Return a value as a number: states by their raw value."""
    for candidate in (value.eng_value, value.raw_value):
        if isinstance(candidate, int | float) and abs(candidate) < float("inf"):
            return float(candidate)
    return None
