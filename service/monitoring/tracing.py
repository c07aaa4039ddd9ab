"""Traces by OpenTelemetry: a request, the storing of its samples, and the filter that they wake, as one trace.

Nothing of OpenTelemetry is imported until somebody asks for traces, and until then every function here does next to nothing.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

NAME = "thermal-twin"
Value = str | int | float | bool

_tracer: Any = None
_causes: dict[int, Any] = {}
"""Of each twin, the context of the request whose samples came last."""


def start(url: str) -> None:
    """Send traces to a collector, OTLP over HTTP; ModuleNotFoundError if what that needs is not installed."""
    from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
    from opentelemetry.sdk.resources import Resource
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import BatchSpanProcessor

    provider = TracerProvider(resource=Resource.create({"service.name": NAME}))
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter(endpoint=url)))
    use(provider)


def use(provider: Any | None) -> None:
    """Trace by a provider of OpenTelemetry from now on, or not at all."""
    global _tracer
    _causes.clear()
    _tracer = None if provider is None else provider.get_tracer(NAME)


def is_on() -> bool:
    """Return whether anybody asked for traces."""
    return _tracer is not None


@contextmanager
def request(method: str, headers: Iterable[tuple[bytes, bytes]]) -> Iterator[Any]:
    """Trace a request, as a part of the caller's trace if its headers name one; yields the span, None without traces."""
    if _tracer is None:
        yield None
        return
    from opentelemetry.trace import SpanKind
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    named = {name.decode("latin-1"): value.decode("latin-1") for name, value in headers}
    caller = TraceContextTextMapPropagator().extract(named)
    with _tracer.start_as_current_span(method, caller, SpanKind.SERVER, {"http.request.method": method}) as span:
        yield span


def answered(span: Any, method: str, route: str, status: int) -> None:
    """Note how a request was answered, in the words of OpenTelemetry's conventions."""
    if span is not None:
        from opentelemetry.trace import StatusCode

        span.update_name(f"{method} {route}")
        span.set_attributes({"http.route": route, "http.response.status_code": status})
        if status >= 500:
            span.set_status(StatusCode.ERROR)


@contextmanager
def part(name: str, attributes: Mapping[str, Value], *, cause: int | None = None) -> Iterator[None]:
    """Trace a part of what is under way, or of what the newest samples of a twin, ``cause``, have caused."""
    if _tracer is None:
        yield
        return
    context = None if cause is None else _causes.get(cause)
    with _tracer.start_as_current_span(name, context, attributes=attributes):
        yield


def remember(twin: int) -> None:
    """Let what happens to a twin from now on be caused by what is under way."""
    if _tracer is not None:
        from opentelemetry.context import get_current

        _causes[twin] = get_current()
