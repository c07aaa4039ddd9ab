"""The closed loop on many records at once: a folder per spacecraft, computed by processes here or by a Dask cluster."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, as_completed
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from replay.errors import ReplayError
from twin_core._typing import Json
from twin_core.errors import TwinError

if TYPE_CHECKING:
    from service.jobs.executor import Tasks

SPECS = ("spec.yaml", "spec.yml", "spec.json")
RECORDS = (".csv", ".mcap")
DEADLINE_S = 86_400.0


def close_one(
    spec: Any, records: Sequence[Any], options: Json, progress: Callable[[float, str], None]
) -> tuple[Json, Json, str]:
    """Close the loop on one record; worker processes find this function by its name. Return model, report and page."""
    from twin_core.closed_loop import close_loop
    from twin_core.report.html import render

    loop = close_loop(spec, records, progress=progress, **options)
    return loop.model.to_json(), loop.report, render(loop.report, loop.plots)


def folders_of(fleet: Path, out: Path) -> list[Path]:
    """Return the folders of the spacecraft of a fleet, without that of the results; click.UsageError if there is none."""
    folders = sorted(fleet.iterdir()) if fleet.is_dir() else []
    found = [one for one in folders if one.is_dir() and not one.name.startswith(".") and one.resolve() != out.resolve()]
    if not found:
        raise click.UsageError(f"--fleet {fleet}: holds no folder of a spacecraft")
    return found


def contents_of(folder: Path) -> tuple[Path, list[Path]]:
    """Return specification and records of a spacecraft; ReplayError if one of them is missing."""
    spec = next((folder / name for name in SPECS if (folder / name).is_file()), None)
    records = sorted(path for path in folder.iterdir() if path.suffix in RECORDS)
    if spec is None or not records:
        raise ReplayError(f"{folder}: needs a spec.yaml and telemetry, CSV or MCAP")
    return spec, records


def close_fleet(fleet: Path, executor: str, out: Path, options: Json, *, masking: bool) -> dict[str, Json]:
    """Close the loop of every spacecraft; write model, report and page into a folder each, and return the reports.

    A spacecraft that cannot be read, or whose loop fails, gets ``{"error": ...}``; the others go on.

    Raises
    ------
    click.ClickException
        If there is no spacecraft, or nothing that computes.
    """
    from replay.cli.console import progress_bar, to_json
    from replay.cli.recordings import load_records
    from service.jobs.executor import ExecutorLost, JobFailed, Task
    from twin_core.files import make_folder, write_text
    from twin_core.network.spec_io import load_spec

    folders = folders_of(fleet, out)
    tasks = _tasks(executor)
    reports: dict[str, Json] = {}
    running: dict[Future[Any], str] = {}
    try:
        for folder in folders:
            try:
                spec_file, files = contents_of(folder)
                spec = load_spec(spec_file)
                work = (spec, load_records(tuple(files), spec, masking=masking), options)
            except (TwinError, ReplayError) as error:
                reports[folder.name] = {"error": str(error)}
                continue
            running[tasks.start(Task(close_one, work))] = folder.name
        with progress_bar("closing the loops") as progress:
            for done, future in enumerate(as_completed(running), start=1):
                name = running[future]
                try:
                    model, report, page = future.result()
                    place = out / name
                    make_folder(place)
                    write_text(place / "model.json", to_json(model))
                    write_text(place / "report.json", to_json(report))
                    write_text(place / "report.html", page)
                    reports[name] = report
                except (JobFailed, ExecutorLost, TwinError) as error:
                    reports[name] = {"error": str(error)}
                progress(done / len(running), name)
    finally:
        tasks.shutdown()
    make_folder(out)
    write_text(out / "fleet.json", to_json({name: _brief(reports[name]) for name in sorted(reports)}))
    return reports


def _tasks(executor: str) -> "Tasks":
    """Return what computes; click.ClickException if it is not there."""
    from service.jobs.executor import ExecutorLost, ProcessPerTask

    if executor == "process":
        return ProcessPerTask(max(os.cpu_count() or 1, 1), DEADLINE_S)
    try:
        from service.jobs.dask import DaskTasks
    except ModuleNotFoundError as error:
        raise click.ClickException(f"--executor {executor} needs Dask: pip install 'thermal-twin[dask]'") from error
    tasks = DaskTasks(executor.replace("dask://", "tcp://"), 64, DEADLINE_S)
    try:
        tasks.reach()
    except ExecutorLost:
        tasks.shutdown()
        raise click.ClickException(f"--executor {executor}: no scheduler of Dask answers there") from None
    return tasks


def _brief(report: Json) -> Json:
    if "error" in report:
        return report
    named = [{"effect": f["effect"], "where": f["where"]} for f in report["findings"]]
    rmse = {part: report[part]["rmse_K"] for part in ("before", "after")}
    return {"verdict": report["verdict"], "findings": named, "rmse_K": rmse}
