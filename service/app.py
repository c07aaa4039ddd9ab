"""The application: layers, routes and what lives as long as it runs."""

import contextlib
from collections.abc import AsyncIterator
from functools import partial
from typing import Any

from fastapi import Depends, FastAPI

from service.http import problems
from service.http.audit import Audit
from service.http.auth import Gate
from service.http.body_limit import Bodies
from service.http.deps import known_parameters
from service.http.head import Heads
from service.http.lane import Lane
from service.http.observe import Observe
from service.http.routes import (
    admin,
    alarms,
    dashboard,
    fleet,
    health,
    jobs,
    live,
    models,
    rows,
    streams,
    telemetry,
    twins,
)
from service.monitoring.metrics import Metrics
from service.running.start import running
from service.settings import Settings, read_settings
from service.store.database import Database
from service.workbench.core import CoreWorkbench
from service.workbench.interface import MakeWorkbench

ROUTERS = (
    telemetry.router,
    telemetry.quarantine,
    twins.router,
    fleet.router,
    jobs.calibrations,
    jobs.diagnoses,
    models.router,
    live.router,
    alarms.router,
    rows.router,
    streams.router,
    admin.audit,
    admin.webhooks,
)


def _describe_access(app: FastAPI) -> None:
    """Let the description of the API say that a key is sent as a bearer token, so that its page can ask for one."""
    describe = app.openapi

    def described() -> dict[str, Any]:
        document = describe()
        document.setdefault("components", {})["securitySchemes"] = {"key": {"type": "http", "scheme": "bearer"}}
        document["security"] = [{}, {"key": []}]
        return document

    app.openapi = described  # type: ignore[method-assign]


def create_app(
    settings: Settings | None = None,
    database: Database | None = None,
    workbench: MakeWorkbench | None = None,
) -> FastAPI:
    """Return the application; the store is opened when it starts, unless it is handed over open, and closed at the end.

    Raises
    ------
    SettingsError
        If the settings are wrong or would leave the service open to strangers.
    """
    settings = settings or read_settings()
    make_workbench = workbench or partial(CoreWorkbench, settings.effect_files)
    metrics = Metrics()
    keys = settings.keys

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        store = database or Database(settings.database)
        try:
            async with running(settings, store, metrics, make_workbench) as service:
                app.state.service = service
                yield
        finally:
            store.close()

    app = FastAPI(
        title="thermal-twin",
        version="1",
        lifespan=lifespan,
        docs_url=None,  # by a route of our own, with files of our own
        redoc_url=None,
        telemetry={"tracing": False, "metrics": False, "logs": False},  # there are metrics of our own
        description="A digital twin of a spacecraft's temperatures that knows what it does not know.",
    )
    problems.install(app)
    _describe_access(app)
    for router in ROUTERS:
        app.include_router(router, dependencies=[Depends(known_parameters)])
    app.include_router(health.router)  # a probe may carry anything against caches
    app.include_router(dashboard.router)
    for path, files in dashboard.assets().items():
        app.mount(path, files, name=path)
    app.add_middleware(Bodies, max_bytes=settings.max_body_bytes, timeout_s=settings.body_timeout_s)
    app.state.keys = keys
    app.add_middleware(Gate, keys=keys)
    app.add_middleware(Audit)
    app.add_middleware(Observe, metrics=metrics)
    app.add_middleware(Heads)
    app.state.lane = Lane(app, Gate(app, keys), Observe(app, metrics), settings.max_body_bytes)
    return app
