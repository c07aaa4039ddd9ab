"""What routes are handed: the running service, the twin that a path names, and proof of the caller's role.

All of them are coroutines, although none waits: a plain function would be run in a thread, once per request each.
"""

from collections.abc import Callable, Collection
from typing import Annotated

from fastapi import Depends, Path
from fastapi.dependencies.models import Dependant
from starlette.requests import HTTPConnection

from service.errors import short
from service.http.problems import Problem
from service.keys import Role
from service.running.service import Service
from service.twins.registry import Entry


async def running_service(connection: HTTPConnection) -> Service:
    """Return the service behind a request or web socket."""
    service: Service = connection.app.state.service
    return service


Running = Annotated[Service, Depends(running_service)]


def require(connection: HTTPConnection, role: Role) -> None:
    """Refuse callers below a role (403)."""
    if connection.scope["state"]["role"] < role:
        raise Problem(403, f"this needs a key of role '{role.name}'")


class Needs:
    """A dependency that refuses callers below a role (403)."""

    def __init__(self, role: Role) -> None:
        """Remember the least role."""
        self._role = role

    async def __call__(self, connection: HTTPConnection) -> None:
        """Check the role that the gate found."""
        require(connection, self._role)


reads = Depends(Needs(Role.read))
operates = Depends(Needs(Role.operate))


def refuse_unknown(connection: HTTPConnection, known: Collection[str] = ()) -> None:
    """Refuse a query parameter that would be passed over: a slip in its name would go unnoticed (422)."""
    if connection.scope["query_string"]:
        errors = [(name, "unknown parameter") for name in connection.query_params if name not in known]
        if errors:
            expected = f"known: {', '.join(known)}" if known else "there are none"
            raise Problem(422, f"{short(errors[0][0])}: unknown parameter ({expected})", errors)


async def known_parameters(connection: HTTPConnection) -> None:
    """Refuse query parameters that the route does not have."""
    refuse_unknown(connection, _parameters(connection.scope["route"].dependant))


def _parameters(dependant: Dependant) -> list[str]:
    """Return the names of the query parameters of a route and of all that it depends on."""
    inner = (name for part in dependant.dependencies for name in _parameters(part))
    return [*(parameter.alias for parameter in dependant.query_params), *inner]


async def noted(connection: HTTPConnection) -> Callable[[str], None]:
    """Return what the audit log's line of this request is told by: what the change was, and never a secret."""
    state = connection.scope["state"]
    return lambda told: state.update(told=told)


Note = Annotated[Callable[[str], None], Depends(noted)]
TwinName = Annotated[str, Path(description="Id of a registered twin.")]


async def named_twin(service: Running, twin: TwinName) -> Entry:
    """Return the twin that the path names as it is now, whichever process changed it last (404 if there is none)."""
    return await service.find_now(twin)


NamedTwin = Annotated[Entry, Depends(named_twin)]
