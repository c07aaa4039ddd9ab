"""Starting and stopping what lives as long as the process, with or without HTTP in front of it."""

import contextlib
import logging
from collections.abc import AsyncIterator

from service.archive.intake import Intake
from service.fleet.ownership import Alone
from service.jobs.executor import ProcessPerTask, Tasks
from service.jobs.runner import Jobs
from service.jobs.schedule import Schedule
from service.live.live import Live
from service.live.silence import Silence
from service.monitoring.metrics import Metrics
from service.running.dispatch import Dispatch
from service.running.housekeeping import Housekeeping
from service.running.member import Member, join
from service.running.service import Service
from service.settings import Settings, SettingsError
from service.store import jobs as job_table
from service.store import twins as twin_table
from service.store.database import Database
from service.stream.hub import Hub
from service.twins.registry import Registry
from service.workbench.interface import MakeWorkbench

log = logging.getLogger("service")


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
        settings.job_search_s,
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
    try:
        from service.jobs.dask import DaskTasks
    except ModuleNotFoundError as error:
        raise SettingsError("TWIN_EXECUTOR: dask:// needs Dask: pip install 'thermal-twin[dask]'") from error

    return DaskTasks(settings.executor.replace("dask://", "tcp://"), workers, settings.job_deadline_s)
