"""The recorder: follows the live stream of a twin and passes what arrives on, to an MCAP file or to viewers."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from replay.bridges.events import Note, of_activations, of_alarms, of_anomalies, of_diagnoses
from replay.errors import ReplayError
from service.client import ApiError, AsyncTwinClient, Unreachable
from service.schemas import Alarm, Anomaly, Archive, Job, Message, Residuals, TwinDetail

Part = TypeVar("Part", Archive, Residuals)

RESIDUAL = "residual_{}"
"""Topic of the innovations of one sensor, in kelvin; named so that a replay does not take it for the sensor."""
NOT_FOLLOWED = 409
"""How a service answers that follows no samples with its model: there are no innovations then."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.2, 10.0


@dataclass
class Tally:
    """How far a recording got."""

    samples: int = 0
    residuals: int = 0
    events: int = 0
    gaps: int = 0
    interruptions: int = 0
    last_time: str | None = None


def no_tally(tally: Tally) -> None:
    """Report nothing: the default of a recording."""


def topics_of(twin: TwinDetail) -> tuple[list[str], dict[str, str]]:
    """Return the topics of a twin's recording and their units: every channel, and the innovations of its sensors."""
    channels = twin.specification["channels"]
    residuals = [RESIDUAL.format(name) for name in twin.channels if channels[name]["kind"] == "temperature"]
    units = {name: channels[name]["unit"] for name in twin.channels if channels[name].get("unit")}
    return [*twin.channels, *residuals], units | dict.fromkeys(residuals, "K")


class Sink(Protocol):
    """Where a recording goes: a file, or viewers that are connected."""

    def add(self, topic: str, instant_ns: int, value: float) -> None:
        """Take one sample."""

    def tell(self, note: Note) -> None:
        """Take one event."""


class Recorder:
    """Writes one twin's samples, innovations and events to a sink as they arrive.

    A connection that breaks is taken up again after the last message. Messages that the service dropped, because the
    recorder was too slow, are fetched from the archive; a sample may then stand in the file twice, with the same value.
    """

    def __init__(
        self,
        client: AsyncTwinClient,
        twin: str,
        sink: Sink,
        progress: Callable[[Tally], None] = no_tally,
        service_url: str = "",
    ) -> None:
        """Record ``twin`` through ``client`` into ``sink``; ``progress`` is called now and then.

        ``service_url`` is where links to reports begin.
        """
        self._client, self._twin, self._sink, self._progress = client, twin, sink, progress
        self._reports = f"{service_url.rstrip('/')}/v1/twins/{twin}/diagnoses"
        self.tally = Tally()
        self._last_ns = -1
        self._told: set[str] = set()

    async def take_archive(self, start: str | None) -> None:
        """Write what the archive holds from an instant on, or all of it; ReplayError if the service refuses."""
        try:
            await self._fetch(start)
        except (ApiError, Unreachable) as error:
            raise ReplayError(f"twin '{self._twin}': {error}") from error

    async def take_events(self, start: str | None = None) -> None:
        """Tell what the service knows: anomalies and limits that last or ended after an instant, all models and diagnoses.

        ApiError or Unreachable as the client raises them.
        """
        client, twin = self._client, self._twin
        alarms = [alarm for alarm in await client.alarms(twin) if not start or not alarm.stop or alarm.stop >= start]
        notes = [
            *of_anomalies(await client.anomalies(twin, start=start)),
            *of_alarms(alarms),
            *of_activations(await client.activations(twin)),
            *of_diagnoses(await client.jobs(twin, "diagnosis"), self._reports),
        ]
        self._tell(notes)

    async def follow(self, after_seq: int) -> None:
        """Write what arrives until cancelled; ReplayError if the service refuses."""
        seq, pause_s = after_seq, FIRST_PAUSE_S
        while True:
            try:
                async for message in self._client.events(self._twin, seq):
                    await self._take(message)
                    seq, pause_s = message.seq, FIRST_PAUSE_S
            except ApiError as error:
                raise ReplayError(f"twin '{self._twin}': {error}") from error
            except Unreachable:
                self.tally.interruptions += 1
            await asyncio.sleep(pause_s)
            pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)

    async def _take(self, message: Message) -> None:
        body = message.model_extra or {}
        if message.type == "sample":
            self._write(message.time, body["values"])
            self.tally.samples += 1
        elif message.type == "residual":
            values = {RESIDUAL.format(name): value for name, value in body["residual_K"].items()}
            self._write(message.time, values, is_sample=False)
            self.tally.residuals += 1
        elif message.type == "anomaly":
            self._tell(of_anomalies([Anomaly.model_validate(body["anomaly"])]))
        elif message.type == "alarm":
            self._tell(of_alarms([Alarm.model_validate(body["alarm"])]))
        elif message.type == "model" and body["active"]:
            self._tell(of_activations(await self._client.activations(self._twin)))
        elif message.type == "job" and (job := Job.model_validate(body["job"])).kind == "diagnosis" and job.done:
            self._tell(of_diagnoses(await self._client.jobs(self._twin, "diagnosis"), self._reports))
        elif message.type == "dropped":
            self.tally.gaps += 1
            await self._fetch(self.tally.last_time)
        self._progress(self.tally)

    async def _fetch(self, start: str | None) -> None:
        """Write samples and innovations of the archive from an instant on."""
        head = await self._client.twin(self._twin)
        if head.first_time is None or head.last_time is None:
            return
        span = (_us(start or head.first_time), _us(head.last_time) + 1)
        async for samples in self._parts(self._client.archive, span):
            for row, time in enumerate(samples.time):
                self._write(time, {name: column[row] for name, column in samples.values.items()})
            self.tally.samples += len(samples.time)
            self._progress(self.tally)
        if head.active_model is not None:
            await self._fetch_residuals(span)
        await self.take_events(start)

    def _tell(self, notes: Iterable[Note]) -> None:
        """Write events, once each, in the order of time."""
        for note in sorted((note for note in notes if note.key not in self._told), key=lambda note: note.time_ms):
            self._told.add(note.key)
            self._sink.tell(note)
            self.tally.events += 1

    async def _fetch_residuals(self, span: tuple[int, int]) -> None:
        try:
            async for found in self._parts(self._client.residuals, span):
                for row, time in enumerate(found.time):
                    values = {RESIDUAL.format(name): column[row] for name, column in found.residual_K.items()}
                    self._write(time, values, is_sample=False)
                self.tally.residuals += len(found.time)
                self._progress(self.tally)
        except ApiError as error:
            if error.status != NOT_FOLLOWED:
                raise

    async def _parts(self, read: Callable[..., Awaitable[Part]], span: tuple[int, int]) -> AsyncIterator[Part]:
        """Yield what lies in a span, in the order of time, in parts that the service gives out whole."""
        spans = [span]
        while spans:
            first_us, stop_us = spans.pop()
            part = await read(self._twin, start=_text(first_us), stop=_text(max(first_us, stop_us)))
            if not part.downsampled:
                yield part
                continue
            middle_us = (first_us + stop_us) // 2
            spans += [(middle_us, stop_us), (first_us, middle_us)]

    def _write(self, time: str, values: dict[str, float | None], *, is_sample: bool = True) -> None:
        instant_ns = 1000 * _us(time)
        for name, value in values.items():
            if value is not None:
                self._sink.add(name, instant_ns, value)
        if is_sample and instant_ns > self._last_ns:
            self._last_ns, self.tally.last_time = instant_ns, time


def _us(time: str) -> int:
    return int(np.datetime64(time.removesuffix("Z"), "us").astype(np.int64))


def _text(instant_us: int) -> str:
    return f"{np.datetime64(instant_us, 'us')}Z"
