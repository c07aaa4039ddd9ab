"""The steps of the demonstration. Only the first knows what is hidden; the service learns it from telemetry or not."""

import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from replay.cli.console import print_line, print_table, progress_bar, short, to_json
from replay.cli.recordings import save_record
from replay.cli.service_process import running_service
from replay.errors import ReplayError
from replay.player import play
from replay.source import load
from service.client import ApiError, TwinClient, Unreachable
from service.schemas import Job
from twin_core.fem.demo import demo_scenario
from twin_core.fem.film import Film
from twin_core.fem.hidden.base import WHERE_KEYS
from twin_core.fem.scenario import Scenario
from twin_core.fem.simulate import simulate
from twin_core.files import make_folder, write_text
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import dump_spec

RECORDING = "orbits.mcap"
HOLDOUT = 0.3
PICTURE_S = 300.0
"""Between two pictures of the temperature field in the recording."""

Place = tuple[str, frozenset[tuple[str, frozenset[str]]]]
"""An effect's name and where it acts, for comparison: pairs have no order."""


class StepFailed(Exception):
    """A step of the demonstration ran and did not succeed; the message says in one line which and why."""


@dataclass(frozen=True)
class Outcome:
    """What a demonstration came to.

    Attributes
    ----------
    hidden
        Effect and place that the simulator hid; None where nothing was hidden.
    found
        "named" as a finding, "alternative" of a finding, "nothing" as there was nothing to find, or "no".
    report
        The report of the diagnosis.
    misfit
        Per sensor its noise and the residuals of the calibrated declared model, which show that something is missing.
    elapsed_s
        Wall clock.
    url
        Where the service listens.
    """

    hidden: dict[str, Any] | None
    found: str
    report: dict[str, Any]
    misfit: dict[str, Any]
    elapsed_s: float
    url: str

    @property
    def success(self) -> bool:
        """Whether the hidden effect was found and the held-out error fell (or nothing hidden, nothing found)."""
        if self.hidden is None:
            return self.found == "nothing"
        return self.found != "no" and self.report["after"]["rmse_K"] < self.report["before"]["rmse_K"]

    def to_json(self) -> dict[str, Any]:
        """Return the outcome for machines, the whole report included."""
        return {
            "hidden": self.hidden,
            "found": self.found,
            "success": self.success,
            "before_rmse_K": self.report["before"]["rmse_K"],
            "after_rmse_K": self.report["after"]["rmse_K"],
            "misfit": self.misfit,
            "elapsed_s": self.elapsed_s,
            "url": self.url,
            "report": self.report,
        }


@contextmanager
def run_demo(effect: str, seed: int, out: Path) -> Iterator[Outcome]:
    """Run the demonstration and yield its outcome while the service still runs.

    Raises
    ------
    TwinError, ReplayError
        If the effect is unknown, a file cannot be written or the service does not answer.
    StepFailed
        If a job of the service fails.
    """
    begun = time.perf_counter()
    scenario, spec = demo_scenario(effect, seed)
    make_folder(out)
    _record(scenario, spec, out / RECORDING)
    with tempfile.TemporaryDirectory(prefix="twin-demo-") as folder, running_service(Path(folder)) as url:
        try:
            with TwinClient(url) as client:
                yield _operate(client, url, spec, hidden_effect(scenario), out, begun)
        except (ApiError, Unreachable) as error:
            raise ReplayError(str(error)) from error


def _record(scenario: Scenario, spec: TwinSpec, path: Path) -> None:
    """Simulate the orbits and write what the sensors read, and the field as pictures for a viewer."""
    film = Film(scenario, PICTURE_S)
    with progress_bar("simulating orbits") as progress:
        record = simulate(scenario, progress, film.take).record
    units = {name: channel.unit for name, channel in scenario.channels.items()}
    declared = {"specification.json": to_json(dump_spec(spec)).encode()}
    save_record(path, record, units, {"scenario": scenario.scenario}, declared, film)


def _operate(
    client: TwinClient, url: str, spec: TwinSpec, hidden: dict[str, Any] | None, out: Path, begun: float
) -> Outcome:
    """Do what an operator does: register, stream, calibrate, look at residuals, diagnose, keep the report."""
    client.register(dump_spec(spec))
    _replay(client, spec.twin, out / RECORDING)
    made = _finish(client, spec.twin, client.calibrate(spec.twin, activate=True), "calibrating").result or {}
    misfit = _misfit(client, spec.twin, made["model_version"])
    job = _finish(client, spec.twin, client.diagnose(spec.twin, holdout=HOLDOUT, activate=True), "tracing the misfit")
    report = dict(job.result or {})
    write_text(out / "report.json", to_json(report))
    write_text(out / "report.html", client.report_html(spec.twin, job))
    return Outcome(hidden, verdict_on(report, hidden), report, misfit, time.perf_counter() - begun, url)


def _replay(client: TwinClient, twin: str, path: Path) -> None:
    (recording,) = load([path])
    with progress_bar("replaying over HTTP") as progress:
        tally = play(recording, client, twin, progress=lambda t: progress(t.sent / t.total, f"{t.sent} samples"))
    if tally.accepted != tally.total:
        raise StepFailed(f"the service took {tally.accepted} of {tally.total} samples")


def _finish(client: TwinClient, twin: str, job: Job, title: str) -> Job:
    """Return a job once it succeeded; StepFailed with its message if it did not."""
    with progress_bar(title) as progress:
        job = client.wait(twin, job, on_progress=lambda j: progress(j.progress, j.message))
    if job.state != "succeeded":
        raise StepFailed(f"{job.kind} {job.state}: {job.message}")
    return job


def _misfit(client: TwinClient, twin: str, version: int) -> dict[str, Any]:
    """Return how badly the calibrated declared model fits: per sensor its noise, one-step and open-loop residuals."""
    document = client.model(twin, version).model_dump()["model"]
    residuals = client.all_residuals(twin)
    innovations = {name: np.array(column, dtype=np.float64) for name, column in residuals.residual_K.items()}
    return {
        "noise_K": document["noise_K"],
        "one_step_rms_K": {name: float(np.sqrt(np.nanmean(column**2))) for name, column in innovations.items()},
        "open_loop_rmse_K": {name: row["rmse_K"] for name, row in document["summary"]["per_sensor"].items()},
    }


def hidden_effect(scenario: Scenario) -> dict[str, Any] | None:
    """Return effect, place and parameters of what a scenario hides, None if it hides nothing."""
    if not scenario.hidden:
        return None
    data = scenario.hidden[0].model_dump(mode="json", exclude_none=True)
    where = {key: data[key] for key in WHERE_KEYS if key in data}
    parameters = {key: value for key, value in data.items() if key not in where and key != "effect"}
    return {"effect": data["effect"], "where": where, "parameters": parameters}


def place_of(effect: Mapping[str, Any]) -> Place:
    """Return an effect's name and place in a form that compares equal whatever the order of a pair."""
    where = effect["where"].items()
    return effect["effect"], frozenset((key, frozenset([v] if isinstance(v, str) else v)) for key, v in where)


def verdict_on(report: Mapping[str, Any], hidden: Mapping[str, Any] | None) -> str:
    """Return whether the report names what was hidden: "named", "alternative", "nothing" or "no"."""
    findings = report["findings"]
    if hidden is None:
        return "no" if findings else "nothing"
    if any(place_of(finding) == place_of(hidden) for finding in findings):
        return "named"
    others = [other for finding in findings for other in finding["alternatives"]]
    return "alternative" if any(place_of(other) == place_of(hidden) for other in others) else "no"


def print_outcome(outcome: Outcome, out: Path) -> None:
    """Print what was hidden, what was found, and the error before and after."""
    from replay.cli.close_loop import describe, print_report

    columns = list(outcome.misfit.values())
    rows = [[sensor, *(short(column.get(sensor)) for column in columns)] for sensor in columns[0]]
    print_table("residual of the declared model, calibrated", ["sensor", "noise K", "one step K", "open loop K"], rows)
    print_report(outcome.report)
    hidden = "nothing" if outcome.hidden is None else describe(outcome.hidden | {"parameters": {}})
    others = len(outcome.report["findings"]) - (outcome.found in ("named", "alternative"))
    beside = f", beside {others} finding{'s' if others > 1 else ''} that it did not hide" if others else ""
    print_line(f"hidden by the simulator: {hidden}; found: {outcome.found}{beside}")
    print_line(f"wrote {out}/report.html, report.json, {RECORDING} in {outcome.elapsed_s:.0f} s")
