"""Typed clients of the service, synchronous and asynchronous, with retries.

A lost connection, an overloaded service and what is not known yet are tried again with growing pauses, as long as sending
the request twice does no harm (samples are recognised when they come again). Any other refusal raises ``ApiError`` at once.
"""

import asyncio
import random
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self, TypeVar

import httpx
from pydantic import BaseModel

from service import calls, schemas
from service.calls import Call, Values

T = TypeVar("T", bound=BaseModel)

STREAM_TIMEOUT = httpx.Timeout(30.0, read=60.0)
"""A live stream says something every 15 s, so a minute of silence means that it is dead."""
COMPLETE_S, LOOK_S = 600.0, 0.5
"""How long residuals of a whole archive are waited for, and how often they are asked for meanwhile."""

RETRIED = frozenset({408, 429, 502, 503, 504})


class ApiError(Exception):
    """The service refused a request."""

    def __init__(self, status: int, detail: str, errors: Sequence[Mapping[str, str]] = ()) -> None:
        """Keep the status, the one-line reason and the fields to blame."""
        super().__init__(f"{status}: {detail}")
        self.status, self.detail, self.errors = status, detail, list(errors)


class Unreachable(Exception):
    """The service did not answer, however often it was asked."""


@dataclass(frozen=True)
class Retry:
    """How often and how patiently to try again: pauses double from ``first_s`` up to ``longest_s``, with jitter."""

    attempts: int = 6
    first_s: float = 0.2
    longest_s: float = 10.0

    def pause_s(self, attempt: int) -> float:
        """Return the pause after the given attempt, counted from 1."""
        return min(self.longest_s, self.first_s * 2.0 ** (attempt - 1)) * random.uniform(0.5, 1.0)


def _headers(key: str | None) -> dict[str, str]:
    return {"Authorization": f"Bearer {key}"} if key else {}


def _read(response: httpx.Response, answer: type[T]) -> T:
    if response.is_success:
        return answer.model_validate_json(response.content or b"{}")
    try:
        document = response.json()
    except ValueError:
        document = {}
    raise ApiError(response.status_code, document.get("detail", response.reason_phrase), document.get("errors", ()))


def _may_retry(call: Call[T], outcome: httpx.Response | httpx.TransportError) -> bool:
    if isinstance(outcome, httpx.Response):
        return outcome.status_code in RETRIED or "Retry-After" in outcome.headers
    return call.repeatable or isinstance(outcome, httpx.ConnectError | httpx.ConnectTimeout)


def _give_up(outcome: httpx.Response | httpx.TransportError, base_url: str, answer: type[T]) -> T:
    if isinstance(outcome, httpx.Response):
        return _read(outcome, answer)
    raise Unreachable(f"{base_url} does not answer ({outcome or type(outcome).__name__}); is the service running?")


@contextmanager
def _lost_is_unreachable(base_url: str) -> Iterator[None]:
    try:
        yield
    except httpx.TransportError as error:
        raise Unreachable(f"{base_url}: the stream broke off ({error or type(error).__name__})") from error


def _event(line: str) -> schemas.Message | None:
    return schemas.Message.model_validate_json(line.removeprefix("data:")) if line.startswith("data:") else None


class TwinClient:
    """A synchronous client. Use it as a context manager, or close it."""

    def __init__(
        self,
        base_url: str,
        key: str | None = None,
        *,
        retry: Retry | None = None,
        timeout_s: float = 30.0,
        transport: httpx.BaseTransport | None = None,
        sleep_s: Callable[[float], None] = time.sleep,
    ) -> None:
        """Talk to ``base_url`` with an API key; ``transport`` and ``sleep_s`` are for tests."""
        self._http = httpx.Client(
            base_url=base_url, headers=_headers(key), timeout=timeout_s, transport=transport, trust_env=False
        )
        self._retry = retry or Retry()
        self._sleep_s = sleep_s

    def __enter__(self) -> Self:
        """Return the client."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the connections."""
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def send(self, call: Call[T]) -> T:
        """Send one call; ApiError if it is refused, Unreachable if nobody answers."""
        attempt = 1
        while True:
            outcome = self._try(call)
            if attempt >= self._retry.attempts or not _may_retry(call, outcome):
                return _give_up(outcome, str(self._http.base_url), call.answer)
            self._sleep_s(self._retry.pause_s(attempt))
            attempt += 1

    def _try(self, call: Call[T]) -> httpx.Response | httpx.TransportError:
        try:
            return self._http.request(call.method, call.path, params=call.query(), json=call.body)
        except httpx.TransportError as error:
            return error

    def is_ready(self) -> bool:
        """Return whether the service answers and is ready for work."""
        try:
            return self._http.get("/readyz").is_success
        except httpx.TransportError:
            return False

    def twins(self) -> list[schemas.TwinGlance]:
        """Return every registered twin."""
        return self.send(calls.twins()).twins

    def twin(self, name: str) -> schemas.TwinDetail:
        """Return one twin."""
        return self.send(calls.twin(name))

    def register(self, specification: Mapping[str, Any]) -> schemas.TwinDetail:
        """Register a specification."""
        return self.send(calls.register(specification))

    def revise(self, name: str, specification: Mapping[str, Any]) -> schemas.RevisedTwin:
        """Give a twin another specification; the answer says which models still hold."""
        return self.send(calls.revise(name, specification))

    def delete(self, name: str) -> None:
        """Delete a twin with its archive and models."""
        self.send(calls.delete(name))

    def ingest(self, name: str, time: Sequence[str | float], values: Values) -> schemas.IngestReport:
        """Send samples as columns."""
        return self.send(calls.ingest(name, time, values))

    def archive(
        self,
        name: str,
        *,
        start: str | float | None = None,
        stop: str | float | None = None,
        channels: Sequence[str] | None = None,
        max_points: int | None = None,
    ) -> schemas.Archive:
        """Return a part of the archive."""
        named = ",".join(channels) if channels is not None else None
        parameters = {"start": start, "stop": stop, "channels": named, "max_points": max_points}
        return self.send(calls.archive(name, parameters))

    def calibrate(self, name: str, **settings: Any) -> schemas.Job:
        """Start a calibration; the settings are those of ``CalibrationRequest``."""
        return self.send(calls.start_job(name, "calibration", settings))

    def diagnose(self, name: str, **settings: Any) -> schemas.Job:
        """Start a diagnosis; the settings are those of ``DiagnosisRequest``."""
        return self.send(calls.start_job(name, "diagnosis", settings))

    def jobs(self, name: str, kind: schemas.JobKind) -> list[schemas.Job]:
        """Return the jobs of one kind, the newest first."""
        return self.send(calls.jobs(name, kind)).jobs

    def job(self, name: str, job: schemas.Job) -> schemas.Job:
        """Return the present state of a job."""
        return self.send(calls.job(name, job.kind, job.id))

    def cancel(self, name: str, job: schemas.Job) -> schemas.Job:
        """Cancel a job."""
        return self.send(calls.cancel_job(name, job.kind, job.id))

    def wait(
        self,
        name: str,
        job: schemas.Job,
        on_progress: Callable[[schemas.Job], None] | None = None,
        poll_s: float = 0.25,
    ) -> schemas.Job:
        """Return the job once it has ended, well or not."""
        while not job.done:
            self._sleep_s(poll_s)
            job = self.job(name, job)
            if on_progress is not None:
                on_progress(job)
        return job

    def report_html(self, name: str, job: schemas.Job) -> str:
        """Return the page of a diagnosis."""
        response = self._http.get(f"/v1/twins/{name}/diagnoses/{job.id}/report.html")
        if not response.is_success:
            _read(response, schemas.Job)
        return response.text

    def models(self, name: str) -> list[schemas.ModelInfo]:
        """Return every version of the model."""
        return self.send(calls.models(name)).models

    def activations(self, name: str) -> list[schemas.Activation]:
        """Return when and why versions became the active one, the newest first."""
        return self.send(calls.models(name)).activations

    def model(self, name: str, version: int) -> schemas.ModelDetail:
        """Return one version, with the model document itself in ``model``."""
        return self.send(calls.model(name, version))

    def activate(self, name: str, version: int) -> schemas.ModelInfo:
        """Make one version the active one."""
        return self.send(calls.activate(name, version))

    def forecast(self, name: str, horizon_s: float, **request: Any) -> schemas.Forecast:
        """Return a forecast; the request's other members are those of ``ForecastRequest``."""
        return self.send(calls.forecast(name, {"horizon_s": horizon_s, **request}))

    def residuals(self, name: str, **parameters: str | int | float | None) -> schemas.Residuals:
        """Return innovations and NIS between ``start`` and ``stop``."""
        return self.send(calls.residuals(name, parameters))

    def all_residuals(self, name: str, **parameters: str | int | float | None) -> schemas.Residuals:
        """Return the same once every stored sample is compared with the active model, or after ``COMPLETE_S`` what there is."""
        until_s = time.monotonic() + COMPLETE_S
        while not (found := self.residuals(name, **parameters)).complete and time.monotonic() < until_s:
            self._sleep_s(LOOK_S)
        return found

    def anomalies(self, name: str, **parameters: str | int | float | None) -> list[schemas.Anomaly]:
        """Return anomalies between ``start`` and ``stop``."""
        return self.send(calls.anomalies(name, parameters)).anomalies

    def alarms(self, name: str) -> list[schemas.Alarm]:
        """Return the alarms of limits, those first that last and are not shelved."""
        return self.send(calls.alarms(name)).alarms

    def delete_telemetry(
        self,
        name: str,
        *,
        start: str | float | None = None,
        stop: str | float | None = None,
        channels: Sequence[str] | None = None,
    ) -> schemas.Deletion:
        """Delete start <= time < stop, or the values of some channels there; ``undo_deletion`` puts it back for a day."""
        named = ",".join(channels) if channels is not None else None
        return self.send(calls.delete_telemetry(name, {"start": start, "stop": stop, "channels": named}))

    def undo_deletion(self, name: str, deletion: int) -> schemas.Deletion:
        """Put back what a deletion took."""
        return self.send(calls.undo_deletion(name, deletion))

    def events(self, name: str, after_seq: int | None = None) -> Iterator[schemas.Message]:
        """Yield the messages of the stream until the service ends it; Unreachable if the connection is lost."""
        parameters = {} if after_seq is None else {"after_seq": after_seq}
        with (
            _lost_is_unreachable(str(self._http.base_url)),
            self._http.stream("GET", f"/v1/twins/{name}/events", params=parameters, timeout=STREAM_TIMEOUT) as response,
        ):
            if not response.is_success:
                response.read()
                _read(response, schemas.Message)
            for line in response.iter_lines():
                if (message := _event(line)) is not None:
                    yield message


class AsyncTwinClient:
    """The asynchronous client: ``await client.send(calls.twins())``, with short names for the hot paths."""

    def __init__(
        self,
        base_url: str,
        key: str | None = None,
        *,
        retry: Retry | None = None,
        timeout_s: float = 30.0,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        """Talk to ``base_url`` with an API key; ``transport`` is for tests."""
        self._http = httpx.AsyncClient(
            base_url=base_url, headers=_headers(key), timeout=timeout_s, transport=transport, trust_env=False
        )
        self._retry = retry or Retry()

    async def __aenter__(self) -> Self:
        """Return the client."""
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def send(self, call: Call[T]) -> T:
        """Send any call of ``service.calls``; ApiError if it is refused, Unreachable if nobody answers."""
        attempt = 1
        while True:
            outcome = await self._try(call)
            if attempt >= self._retry.attempts or not _may_retry(call, outcome):
                return _give_up(outcome, str(self._http.base_url), call.answer)
            await asyncio.sleep(self._retry.pause_s(attempt))
            attempt += 1

    async def _try(self, call: Call[T]) -> httpx.Response | httpx.TransportError:
        try:
            return await self._http.request(call.method, call.path, params=call.query(), json=call.body)
        except httpx.TransportError as error:
            return error

    async def twin(self, name: str) -> schemas.TwinDetail:
        """Return one twin."""
        return await self.send(calls.twin(name))

    async def archive(
        self, name: str, *, start: str | float | None = None, stop: str | float | None = None
    ) -> schemas.Archive:
        """Return a part of the archive."""
        return await self.send(calls.archive(name, {"start": start, "stop": stop}))

    async def residuals(self, name: str, **parameters: str | int | float | None) -> schemas.Residuals:
        """Return innovations and NIS between ``start`` and ``stop``."""
        return await self.send(calls.residuals(name, parameters))

    async def anomalies(self, name: str, **parameters: str | int | float | None) -> list[schemas.Anomaly]:
        """Return anomalies between ``start`` and ``stop``."""
        return (await self.send(calls.anomalies(name, parameters))).anomalies

    async def alarms(self, name: str) -> list[schemas.Alarm]:
        """Return the alarms of limits, those first that last and are not shelved."""
        return (await self.send(calls.alarms(name))).alarms

    async def activations(self, name: str) -> list[schemas.Activation]:
        """Return when and why versions became the active one, the newest first."""
        return (await self.send(calls.models(name))).activations

    async def jobs(self, name: str, kind: schemas.JobKind) -> list[schemas.Job]:
        """Return the jobs of one kind, the newest first."""
        return (await self.send(calls.jobs(name, kind))).jobs

    async def register(self, specification: Mapping[str, Any]) -> schemas.TwinDetail:
        """Register a specification."""
        return await self.send(calls.register(specification))

    async def ingest(self, name: str, time: Sequence[str | float], values: Values) -> schemas.IngestReport:
        """Send samples as columns."""
        return await self.send(calls.ingest(name, time, values))

    async def forecast(self, name: str, horizon_s: float, **request: Any) -> schemas.Forecast:
        """Return a forecast; the request's other members are those of ``ForecastRequest``."""
        return await self.send(calls.forecast(name, {"horizon_s": horizon_s, **request}))

    async def events(self, name: str, after_seq: int | None = None) -> AsyncIterator[schemas.Message]:
        """Yield the messages of the stream until the service ends it; Unreachable if the connection is lost."""
        parameters = {} if after_seq is None else {"after_seq": after_seq}
        route = f"/v1/twins/{name}/events"
        with _lost_is_unreachable(str(self._http.base_url)):
            async with self._http.stream("GET", route, params=parameters, timeout=STREAM_TIMEOUT) as response:
                if not response.is_success:
                    await response.aread()
                    _read(response, schemas.Message)
                async for line in response.aiter_lines():
                    if (message := _event(line)) is not None:
                        yield message
