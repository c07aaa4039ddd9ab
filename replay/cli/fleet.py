"""The closed loop on many records at once: a folder per spacecraft, computed by processes here or by a Dask cluster."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, as_completed
from pathlib import Path
from typing import Any

import click

from twin_core._typing import Json
from twin_core.errors import TwinError

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


def folders_of(fleet: Path) -> list[tuple[Path, Path, list[Path]]]:
    """Return (folder, specification, records) of every spacecraft of a fleet.

    Raises
    ------
    click.UsageError
        If there is none, or a folder lacks a specification or telemetry.
    """
    found = []
    for folder in sorted(path for path in fleet.iterdir() if path.is_dir()) if fleet.is_dir() else ():
        spec = next((folder / name for name in SPECS if (folder / name).is_file()), None)
        records = sorted(path for path in folder.iterdir() if path.suffix in RECORDS)
        if spec is None or not records:
            raise click.UsageError(f"{folder}: needs a spec.yaml and telemetry, CSV or MCAP")
        found.append((folder, spec, records))
    if not found:
        raise click.UsageError(f"--fleet {fleet}: holds no folder of a spacecraft")
    return found


def close_fleet(fleet: Path, executor: str, out: Path, options: Json, *, masking: bool) -> dict[str, Json]:
    """Close the loop of every spacecraft; write model, report and page into a folder each, and return the reports.

    A spacecraft whose loop fails gets ``{"error": ...}``; the others go on.
    """
    from replay.cli.console import progress_bar, to_json
    from replay.cli.recordings import load_records
    from service.jobs.executor import JobFailed, ProcessPerTask, Task, Tasks
    from twin_core.files import make_folder, write_text
    from twin_core.network.spec_io import load_spec

    workers = max((os.cpu_count() or 1), 1)
    tasks: Tasks = ProcessPerTask(workers, DEADLINE_S)
    if executor != "process":
        from service.jobs.dask import DaskTasks

        tasks = DaskTasks(executor.replace("dask://", "tcp://"), 64, DEADLINE_S)
    reports: dict[str, Json] = {}
    running: dict[Future[Any], str] = {}
    try:
        for folder, spec_file, files in folders_of(fleet):
            spec = load_spec(spec_file)
            work = (spec, load_records(tuple(files), spec, masking=masking), options)
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
                except (JobFailed, TwinError) as error:
                    reports[name] = {"error": str(error)}
                progress(done / len(running), name)
    finally:
        tasks.shutdown()
    make_folder(out)
    write_text(out / "fleet.json", to_json({name: _brief(reports[name]) for name in sorted(reports)}))
    return reports


def _brief(report: Json) -> Json:
    if "error" in report:
        return report
    named = [{"effect": f["effect"], "where": f["where"]} for f in report["findings"]]
    rmse = {part: report[part]["rmse_K"] for part in ("before", "after")}
    return {"verdict": report["verdict"], "findings": named, "rmse_K": rmse}
