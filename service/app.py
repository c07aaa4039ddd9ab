"""The application: layers, routes and what lives as long as it runs."""

import contextlib
from collections.abc import AsyncIterator

from fastapi import FastAPI

from service import problems
from service.access import Gate
from service.bodies import Bodies
from service.deps import Service
from service.metrics import Metrics, Observe
from service.registry import Registry
from service.routes import health, telemetry, twins
from service.settings import Settings, read_settings
from service.store import twins as twin_table
from service.store.database import Database

ROUTERS = (health.router, twins.router, telemetry.router)


def create_app(settings: Settings | None = None, database: Database | None = None) -> FastAPI:
    """Return the application; the store is opened when it starts, unless it is handed over open, and closed at the end.

    Raises
    ------
    SettingsError
        If the settings are wrong or would leave the service open to strangers.
    """
    settings = settings or read_settings()
    metrics = Metrics()

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        store = database or Database(settings.database_path)
        try:
            registry = Registry(await store.read(twin_table.select))
            app.state.service = Service(settings, store, registry, metrics)
            yield
        finally:
            store.close()

    app = FastAPI(
        title="thermal-twin",
        version="1",
        lifespan=lifespan,
        description="A digital twin of a spacecraft's temperatures that knows what it does not know.",
    )
    problems.install(app)
    for router in ROUTERS:
        app.include_router(router)
    app.add_middleware(Bodies, max_bytes=settings.max_body_bytes, timeout_s=settings.body_timeout_s)
    app.add_middleware(Gate, keys=settings.roles)
    app.add_middleware(Observe, metrics=metrics)
    return app
