"""The past of a stream: samples, residuals and events put back into the order of their numbers."""

from service.store import events, residuals, samples
from service.store.connection import Connection
from service.stream.messages import EventStretch, Json, ResidualStretch, SampleStretch, Stretch


def since_seq(
    connection: Connection,
    twin: int,
    channels: tuple[str, ...],
    sensors: tuple[str, ...],
    after_seq: int,
    count: int,
) -> list[Json]:
    """Return the first ``count`` messages after a number, in order."""
    numbers, found = samples.since_seq(connection, twin, len(channels), after_seq)
    stretches: list[Stretch] = [SampleStretch(channels, numbers, found.time_us, found.values)]
    stretches += [ResidualStretch(sensors, r) for r in residuals.since_seq(connection, twin, len(sensors), after_seq)]
    stretches.append(EventStretch(tuple(events.since_seq(connection, twin, after_seq))))
    messages = [message for stretch in stretches for message in stretch.messages(after_seq, count)]
    return sorted(messages, key=lambda message: int(message["seq"]))[:count]
