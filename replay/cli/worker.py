"""``twin worker``: does what the service queues."""

import click

from replay.cli.command import Command


@click.command(cls=Command, short_help="Do the jobs of a fleet.", example="twin worker --jobs 2")
@click.option("--jobs", type=click.IntRange(1, 64), help="Jobs at the same time.  [default: TWIN_JOB_WORKERS, else 1]")
@click.option(
    "--metrics-port",
    type=click.IntRange(0, 65535),
    help="Serve /metrics for Prometheus here, 0 for a free port.  [default: TWIN_METRICS_PORT, else nowhere]",
)
def worker(jobs: int | None, metrics_port: int | None) -> None:
    """Do calibrations and diagnoses from the PostgreSQL database that TWIN_DATABASE_URL names, until interrupted.

    Any number of workers on any machines may share a database; a job whose worker dies is done by another one.
    """
    from replay.cli.console import print_line
    from service.monitoring.logs import start_logging
    from service.settings import read_settings
    from service.worker import work

    given = {"job_workers": jobs, "metrics_port": metrics_port}
    settings = read_settings(host="127.0.0.1", **{name: value for name, value in given.items() if value is not None})
    start_logging(settings.log_level)
    work(settings, on_ready=lambda: print_line("waiting for jobs"))
