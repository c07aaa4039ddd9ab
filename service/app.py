"""The application: layers, routes and what lives as long as it runs."""

import contextlib
import logging
from collections.abc import AsyncIterator
from functools import partial
from typing import Any

from fastapi import Depends, FastAPI

from service.core_workbench import CoreWorkbench
from service.dispatch import Dispatch
from service.fleet.member import Member, join
from service.fleet.ownership import Alone
from service.housekeeping import Housekeeping
from service.http import problems
from service.http.audit import Audit
from service.http.auth import Gate
from service.http.body_limit import Bodies
from service.http.deps import Service, known_parameters
from service.http.head import Heads
from service.http.observe import Observe
from service.http.routes import admin, alarms, dashboard, health, jobs, live, models, rows, streams, telemetry, twins
from service.http.shortcut import Shortcut
from service.intake import Intake
from service.jobs.executor import ProcessPerTask, Tasks
from service.jobs.runner import Jobs
from service.jobs.schedule import Schedule
from service.live.live import Live
from service.live.silence import Silence
from service.metrics import Metrics
from service.registry import Registry
from service.settings import Settings, read_settings
from service.store import jobs as job_table
from service.store import twins as twin_table
from service.store.database import Database
from service.streams import Hub
from service.workbench import MakeWorkbench

log = logging.getLogger("service")

ROUTERS = (
    telemetry.router,
    telemetry.quarantine,
    twins.router,
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


@contextlib.asynccontextmanager
async def running(
    settings: Settings, database: Database, metrics: Metrics, workbench: MakeWorkbench
) -> AsyncIterator[Service]:
    """Start everything that works in the background, and stop it in the opposite order."""
    leases, bus = join(database, settings)
    owners = leases or Alone()
    if not database.is_shared:
        interrupted = await database.write(job_table.fail_interrupted)
        if interrupted:
            log.warning("jobs were interrupted when the service stopped", extra={"jobs": interrupted})
    hub = Hub(database, metrics, settings.stream_buffer, None if bus is None else bus.hint)
    live_state = Live(
        database,
        hub,
        metrics,
        workbench,
        settings.false_alarm_rate,
        settings.limit_horizon_s,
        settings.assimilate_samples,
        owners,
    )
    executor = _executor(settings)
    rooms = (database, hub, metrics, workbench, executor)
    runner = Jobs(
        *rooms,
        settings.job_workers,
        settings.job_values,
        live_state.model_changed,
        lambda twin: service.find_key(twin),
    )
    intake = Intake(hub, live_state, metrics, settings.clock_tolerance_s)
    housekeeping = Housekeeping(database, owners)
    service = Service(settings, database, Registry(()), metrics, hub, live_state, intake, runner, housekeeping, owners)
    for twin in await database.read(twin_table.select):
        service.add_twin(twin)
    dispatch = Dispatch(database, owners)
    silence = Silence(service.registry, live_state, hub, owners)
    schedule = Schedule(
        database,
        service.registry,
        runner,
        settings.calibrate_every_s,
        settings.anomaly_patience_s,
        settings.refutation_rate,
        live_state.evidence,
        owners,
    )
    member = None if leases is None or bus is None else Member(service, bus, leases)
    if member is not None:
        await member.joined()
    try:
        yield service
    finally:
        hub.close()
        if member is not None:
            await member.close()
        await silence.close()
        await schedule.close()
        await dispatch.close()
        await housekeeping.close()
        await runner.close()
        await live_state.close()


def _executor(settings: Settings) -> Tasks:
    """Return what computes jobs."""
    workers = max(settings.job_workers, 1)
    if settings.executor == "process":
        return ProcessPerTask(workers, settings.job_deadline_s, settings.job_memory_mib)
    from service.jobs.dask import DaskTasks

    return DaskTasks(settings.executor.replace("dask://", "tcp://"), workers, settings.job_deadline_s)


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
    app.add_middleware(Shortcut, route=telemetry.ingesting)
    app.add_middleware(Bodies, max_bytes=settings.max_body_bytes, timeout_s=settings.body_timeout_s)
    app.state.keys = keys
    app.add_middleware(Gate, keys=keys)
    app.add_middleware(Audit)
    app.add_middleware(Observe, metrics=metrics)
    app.add_middleware(Heads)
    return app
