"""The layer that counts, times and traces requests."""

import time
from functools import cache
from http import HTTPMethod

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.monitoring import tracing
from service.monitoring.metrics import Metrics

METHODS = frozenset(HTTPMethod)
"""Counted by name; whatever else a caller makes up is not, since each name is kept for ever."""


class Observe:
    """ASGI layer that counts, times and traces every HTTP request by the template of its route."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        """Count into ``metrics``."""
        self._app = app
        self._requests, self._duration_s = cache(metrics.requests.labels), cache(metrics.duration_s.labels)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and note its status."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        status = 500
        started_s = time.perf_counter()

        async def watched(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        method = scope["method"] if scope["method"] in METHODS else "other"
        with tracing.request(method, scope["headers"]) as span:
            try:
                await self._app(scope, receive, watched)
            finally:
                route = getattr(scope.get("route"), "path", "other")
                tracing.answered(span, method, route, status)
                self.count(method, route, status, started_s)

    def count(self, method: str, route: str, status: int, started_s: float) -> None:
        """Note a request that is answered; ``started_s`` is what ``time.perf_counter`` showed when it came."""
        self._requests(method, route, str(status)).inc()
        self._duration_s(route).observe(time.perf_counter() - started_s)
