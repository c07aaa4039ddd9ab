"""One way past the framework, for the route that is asked for most: finding it and its dependencies costs more than it does."""

from collections.abc import Awaitable, Callable

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from service.http import problems

Endpoint = Callable[[Request, str], Awaitable[Response]]


class Shortcut:
    """ASGI layer that hands the requests of one route to its endpoint, and all others on.

    The route's path has one parameter, and its endpoint takes the request and that parameter.
    """

    def __init__(self, app: ASGIApp, route: Route) -> None:
        """Remember what stands before and after the parameter."""
        self._app, self._route = app, route
        self._endpoint: Endpoint = route.endpoint
        self._methods = route.methods or set()
        self._before, self._after = route.path.split("{twin}")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, if the method and the path are those of the route."""
        if (
            scope["type"] != "http"
            or scope["method"] not in self._methods
            or not scope["path"].startswith(self._before)
        ):
            await self._app(scope, receive, send)
            return
        name, separator, rest = scope["path"].removeprefix(self._before).partition("/")
        if separator + rest != self._after:
            await self._app(scope, receive, send)
            return
        scope["route"] = self._route
        try:
            response = await self._endpoint(Request(scope, receive), name)
        except problems.TOLD as error:
            response = problems.answer(error)
        await response(scope, receive, send)
