"""Who may do what: the gate in front of every route."""

from functools import lru_cache
from urllib.parse import urlsplit

from starlette.types import ASGIApp, Receive, Scope, Send

from service.http.problems import problem
from service.keys import Key, Keys, Role
from service.settings import is_loopback

OPEN_PATHS = frozenset({"/", "/healthz", "/readyz", "/docs", "/openapi.json", "/favicon.ico"})
OPEN_PREFIXES = ("/assets/", "/docs/")
SUBPROTOCOL = "bearer."


class Gate:
    """ASGI layer: finds the caller's role before a byte of the body is read.

    With keys, every path but the open ones needs one of them (401). Without keys only callers on this machine are
    served, and no foreign web page may speak through a browser that runs here (403).
    """

    def __init__(self, app: ASGIApp, keys: Keys) -> None:
        """Ask for these keys, if there are any."""
        self._app, self._keys = app, keys

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on with ``scope['state']['role']`` set, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {name: value for name, value in scope["headers"] if name in _HEADERS}
        key = self._key(headers)
        refusal = self._refusal(scope, headers, key)
        state = scope.setdefault("state", {})
        if key is not None or not self._keys.needed:
            state["who"] = "this machine" if key is None else key.name
        if refusal is None:
            state["role"] = self._role_of(key)
            await self._app(scope, receive, send)
        else:
            status, detail = refusal
            extra = {"WWW-Authenticate": "Bearer"} if status == 401 else None
            await problem(status, detail, headers=extra)(scope, receive, send)

    def role(self, scope: Scope, headers: dict[bytes, bytes]) -> Role | None:
        """Return what a caller may do, None if it is refused or has no role."""
        key = self._key(headers)
        return self._role_of(key) if self._refusal(scope, headers, key) is None else None

    def _key(self, headers: dict[bytes, bytes]) -> Key | None:
        return self._keys.find(sent) if self._keys.needed and (sent := _sent(headers)) else None

    def _role_of(self, key: Key | None) -> Role | None:
        if not self._keys.needed:
            return Role.operate
        return None if key is None or key.is_over else key.role

    def _refusal(self, scope: Scope, headers: dict[bytes, bytes], key: Key | None) -> tuple[int, str] | None:
        path = scope["path"]
        if path in OPEN_PATHS or path.startswith(OPEN_PREFIXES):
            return None
        if self._keys.needed and key is None:
            return 401, "a valid API key is needed: send 'Authorization: Bearer KEY'"
        if key is not None and key.is_over:
            return 401, f"the API key of '{key.name}' has expired"
        if not self._keys.needed and not _is_local(scope.get("client")):
            return 403, "this service has no API keys, so it answers callers on its own machine only"
        host = headers.get(b"host", b"").decode("latin-1")
        if not self._keys.needed and not _names_this_machine(host):
            return 403, "this service has no API keys, so it answers to local names only, such as localhost"
        origin = headers.get(b"origin")
        if origin is not None and not self._keys.needed and _netloc(origin) != host:
            return 403, "requests from other web sites are refused"
        return None


def _sent(headers: dict[bytes, bytes]) -> bytes:
    """Return the key that a request brings along, empty where it has none."""
    scheme, _, key = headers.get(b"authorization", b"").partition(b" ")
    if scheme.lower() != b"bearer":
        protocols = headers.get(b"sec-websocket-protocol", b"").split(b",")
        marked = [p.strip() for p in protocols if p.strip().startswith(SUBPROTOCOL.encode())]
        key = marked[0].removeprefix(SUBPROTOCOL.encode()) if marked else b""
    return key.strip()


_HEADERS = frozenset({b"authorization", b"sec-websocket-protocol", b"origin", b"host"})


def _netloc(origin: bytes) -> str:
    return urlsplit(origin.decode("latin-1")).netloc


@lru_cache(maxsize=64)
def _names_this_machine(host: str) -> bool:
    """Return whether a ``Host`` cannot be a public name, which its owner may point at this machine for his pages."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return False
    return is_loopback(name) or not ("." in name or ":" in name)


def _is_local(client: tuple[str, int] | None) -> bool:
    """Return whether the caller is this machine; callers without an address come over a local socket or in process."""
    return client is None or client[0] in ("testclient", "::1") or client[0].startswith("127.")
