"""A running twin for viewers of Foxglove: what a recording would hold, over the web socket of its SDK as it arrives."""

import threading
from collections import deque
from collections.abc import Iterable, Mapping
from types import TracebackType
from typing import Any, Self

import foxglove
import orjson
from foxglove.websocket import Capability, ChannelView, Client, ServerListener

from replay.bridges.errors import BridgeError
from replay.bridges.events import Note
from replay.bridges.foxglove_messages import EVENT, EVENT_TOPIC, LOG, LOG_TOPIC, SCHEMAS, event_of, log_of
from replay.mcap_writer import sample_bytes, sample_schema

KEPT = 1000
"""Most events of the past that a viewer is told when it subscribes."""
BACKLOG = 4096
"""Messages that may wait for one viewer; beyond them the oldest are dropped, and nobody else waits."""


class FoxgloveServer(ServerListener):
    """Serves one twin's topics. Use it as a context manager: it listens until that ends.

    Samples are heard from the moment a viewer subscribes; events of the past are told when it does.
    """

    def __init__(self, twin: str, topics: Iterable[str], units: Mapping[str, str], host: str, port: int) -> None:
        """Prepare to serve ``topics`` with their units; port 0 takes any free one."""
        self._twin, self._address = twin, (host, port)
        self._context = foxglove.Context()
        self._channels = {
            topic: self._channel(topic, sample_schema(topic, units.get(topic)), units.get(topic)) for topic in topics
        }
        self._channels |= {t: self._channel(t, SCHEMAS[name]) for t, name in ((LOG_TOPIC, LOG), (EVENT_TOPIC, EVENT))}
        self._past: deque[tuple[str, int, bytes]] = deque(maxlen=KEPT)
        self._lock = threading.Lock()
        self._newest_ns = -1

    def _channel(self, topic: str, schema: Mapping[str, Any], unit: str | None = None) -> foxglove.Channel:
        metadata = {"unit": unit} if unit else {}
        return foxglove.Channel(topic, schema=dict(schema), context=self._context, metadata=metadata)

    def __enter__(self) -> Self:
        """Listen; BridgeError if the address is taken or not of this machine."""
        host, port = self._address
        try:
            self._server = foxglove.start_server(
                name=f"thermal-twin {self._twin}",
                host=host,
                port=port,
                capabilities=[Capability.Time],
                server_listener=self,
                context=self._context,
                message_backlog_size=BACKLOG,
            )
        except (OSError, RuntimeError) as error:
            raise BridgeError(f"cannot listen on {host}:{port} ({error}); choose another --port or --host") from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Send viewers away."""
        self._server.stop()

    @property
    def url(self) -> str:
        """Where it listens."""
        return f"ws://{self._address[0]}:{self._server.port}"

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Tell a viewer, and nobody else, what happened before it came."""
        with self._lock:
            past = [(instant_ns, data) for topic, instant_ns, data in self._past if topic == channel.topic]
            for instant_ns, data in past:
                self._channels[channel.topic].log(data, log_time=instant_ns, sink_id=client.id)

    def add(self, topic: str, instant_ns: int, value: float) -> None:
        """Pass one sample on; NaN, the missing sample, is none."""
        if value != value:
            return
        if instant_ns > self._newest_ns:
            self._newest_ns = instant_ns
            self._server.broadcast_time(instant_ns)  # a twin's present is that of its telemetry
        self._channels[topic].log(sample_bytes(value), log_time=instant_ns)

    def tell(self, note: Note) -> None:
        """Pass one event on, and keep it for viewers to come."""
        for topic, body in ((LOG_TOPIC, log_of(note)), (EVENT_TOPIC, event_of(note))):
            if body is not None:
                data, instant_ns = orjson.dumps(body), 1_000_000 * note.time_ms
                with self._lock:
                    self._past.append((topic, instant_ns, data))
                    self._channels[topic].log(data, log_time=instant_ns)
