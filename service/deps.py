"""What routes are handed: the running service, the twin that a path names, and proof of the caller's role."""

from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Path
from starlette.requests import HTTPConnection

from service.access import Role
from service.metrics import Metrics
from service.problems import Problem
from service.registry import Entry, Registry
from service.settings import Settings
from service.store.database import Database


@dataclass
class Service:
    """Everything that lives as long as the application."""

    settings: Settings
    database: Database
    registry: Registry
    metrics: Metrics


def running_service(connection: HTTPConnection) -> Service:
    """Return the service behind a request or web socket."""
    service: Service = connection.app.state.service
    return service


Running = Annotated[Service, Depends(running_service)]


class Needs:
    """A dependency that refuses callers below a role (403)."""

    def __init__(self, role: Role) -> None:
        """Remember the least role."""
        self._role = role

    def __call__(self, connection: HTTPConnection) -> None:
        """Check the role that the gate found."""
        if connection.scope["state"]["role"] < self._role:
            raise Problem(403, f"this needs a key of role '{self._role.name}'")


reads = Depends(Needs(Role.read))
ingests = Depends(Needs(Role.ingest))
operates = Depends(Needs(Role.operate))


def named_twin(service: Running, twin: Annotated[str, Path(description="Id of a registered twin.")]) -> Entry:
    """Return the twin that the path names (404 if there is none)."""
    return service.registry.get(twin)


NamedTwin = Annotated[Entry, Depends(named_twin)]
