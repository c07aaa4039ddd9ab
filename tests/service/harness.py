"""A synchronous client of an application in the same process: requests run in one event loop, as in the server."""

import contextlib
import time
from collections.abc import Callable
from typing import Any

import httpx
from anyio.from_thread import start_blocking_portal
from fastapi import FastAPI


def until(found: Callable[[], Any], patience_s: float = 60.0) -> Any:
    """Return what a question finds, once it finds something; AssertionError if it never does."""
    until_s = time.monotonic() + patience_s
    while not (answer := found()):
        assert time.monotonic() < until_s, "it never came true"
        time.sleep(0.05)
    return answer


def notices(forecast: dict[str, Any]) -> list[str]:
    """Return what a forecast tells besides that its telemetry is of long ago, as it is in most tests."""
    return [text for text in forecast["notices"] if not text.startswith("telemetry arrives ")]


class AppClient:
    """Starts an application and speaks to it without a socket."""

    def __init__(self, app: FastAPI, key: str | None = None) -> None:
        """Run the application's start-up."""
        self.app = app
        self._stack = contextlib.ExitStack()
        self.portal = self._stack.enter_context(start_blocking_portal())
        self._stack.enter_context(self.portal.wrap_async_context_manager(app.router.lifespan_context(app)))
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        self.http = httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1", headers=headers)

    def close(self) -> None:
        """Run the application's shut-down."""
        self._stack.close()

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Send one request."""

        async def send() -> httpx.Response:
            return await self.http.request(method, path, **options)

        return self.portal.call(send)

    def get(self, path: str, **options: Any) -> httpx.Response:
        """Send a GET."""
        return self.request("GET", path, **options)

    def post(self, path: str, **options: Any) -> httpx.Response:
        """Send a POST."""
        return self.request("POST", path, **options)

    def delete(self, path: str, **options: Any) -> httpx.Response:
        """Send a DELETE."""
        return self.request("DELETE", path, **options)
