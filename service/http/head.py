"""HEAD on every route that has a GET: the same status and headers, no body."""

from starlette.types import ASGIApp, Message, Receive, Scope, Send


class Heads:
    """ASGI layer that answers HEAD as GET and keeps the body to itself."""

    def __init__(self, app: ASGIApp) -> None:
        """Stand in front of all other layers."""
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on as a GET; a body without end is over with its head."""
        if scope.get("method") != "HEAD":
            await self._app(scope, receive, send)
            return

        async def bodiless(message: Message) -> None:
            if message["type"] == "http.response.start":
                await send(message)
                await send({"type": "http.response.body"})

        await self._app({**scope, "method": "GET"}, receive, bodiless)
