"""The recorder: follows the live stream of a twin and writes what arrives to an MCAP file."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from replay.errors import ReplayError
from replay.mcap_writer import INFO, WARNING, McapWriter
from service.client import ApiError, AsyncTwinClient, Unreachable
from service.schemas import Archive, Message, Residuals, TwinDetail

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


class Recorder:
    """Writes one twin's samples and innovations to a file as they arrive.

    A connection that breaks is taken up again after the last message. Messages that the service dropped, because the
    recorder was too slow, are fetched from the archive; a sample may then stand in the file twice, with the same value.
    """

    def __init__(
        self,
        client: AsyncTwinClient,
        twin: str,
        writer: McapWriter,
        progress: Callable[[Tally], None] = no_tally,
    ) -> None:
        """Record ``twin`` through ``client`` into ``writer``; ``progress`` is called now and then."""
        self._client, self._twin, self._writer, self._progress = client, twin, writer, progress
        self.tally = Tally()
        self._last_ns = -1
        self._said: set[tuple[int, str]] = set()

    async def take_archive(self, start: str | None) -> None:
        """Write what the archive holds from an instant on, or all of it; ReplayError if the service refuses."""
        try:
            await self._fetch(start)
        except (ApiError, Unreachable) as error:
            raise ReplayError(f"twin '{self._twin}': {error}") from error

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
            self._say(body["anomaly"])
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

            for found in await self._client.anomalies(self._twin, start=_text(span[0]), stop=_text(span[1])):
                self._say(found.model_dump())

    def _say(self, anomaly: dict[str, Any]) -> None:
        """Write that an anomaly began, or that it ended, once each, as a log message."""
        for what, at in (("begins", anomaly["start"]), ("ends", anomaly["stop"])):
            if at is not None and (anomaly["id"], what) not in self._said:
                self._said.add((anomaly["id"], what))
                cause = f" ({anomaly['cause']['effect']})" if anomaly["cause"] else ""
                level = WARNING if what == "begins" else INFO
                self._writer.log(1000 * _us(at), level, anomaly["sensor"], f"{what}: {anomaly['message']}{cause}")

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
                self._writer.add(name, instant_ns, value)
        if is_sample and instant_ns > self._last_ns:
            self._last_ns, self.tally.last_time = instant_ns, time


def _us(time: str) -> int:
    return int(np.datetime64(time.removesuffix("Z"), "us").astype(np.int64))


def _text(instant_us: int) -> str:
    return f"{np.datetime64(instant_us, 'us')}Z"
