"""A workbench that answers at once, for tests of everything around the science."""

import json
import os
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from service.workbench.interface import (
    CalibrationTask,
    DiagnosisTask,
    Filtered,
    Forecasted,
    ForecastTask,
    Json,
    Masks,
    Outcome,
    Progress,
    Stretch,
    Telemetry,
)
from twin_core.errors import ModelError

SENSORS = ("T_px", "T_tank")
UNFIT = 666.0
"""A reading that the fake filter cannot assimilate."""
GATED, GATE = 18.0, "FAKE_GATE"
"""A calibration with such a power ends once there is a file of the name that the environment tells."""
SHORTEST_SEARCH_S = 5.0
"""A calibration that has less does not end its search."""
DEADLY = 667.0
"""A reading over which the process of the fake filter dies."""


class FakeWorkbench:
    """Calibrates to a given error, crashes or dawdles when a channel says so.

    The mean of ``Q_px`` chooses what a calibration does: 13 dies, 14 raises, 15 refuses, 16 runs for ever, 17 cannot be
    scored, 18 waits for a gate, anything else is the RMSE in K that the new model claims on recent data.
    """

    def calibrate(self, task: CalibrationTask, progress: Progress) -> Outcome:
        progress(0.3, "warming up")
        wish = float(np.nanmean(task.telemetry.values["Q_px"][-20:]))
        if wish == 13:
            os.kill(os.getpid(), 9)
        if wish == 14:
            raise ZeroDivisionError("unexpected")
        if wish == 15:
            raise ModelError("the balance has no solution")
        while wish == 16 or (wish == GATED and not Path(os.environ[GATE]).exists()):
            progress(0.5, "at it")
            time.sleep(0.02)
        train = task.telemetry.before(task.validation_us)
        cut_short = task.deadline_s < SHORTEST_SEARCH_S
        rival = None if task.rival is None else float(task.rival["rmse_K"])
        made = _outcome(task.specification, wish, rival, int(train.time_us.size), int(train.time_us[-1]))
        return replace(made, cut_short=cut_short)

    def diagnose(self, task: DiagnosisTask, progress: Progress) -> Outcome:
        progress(0.5, "searching")
        wish = float(np.nanmean(task.telemetry.values["Q_px"][-20:]))
        made = _outcome(
            task.specification, 0.1, None, int(task.telemetry.time_us.size), int(task.telemetry.time_us[-1])
        )
        finding = {"effect": "constant_heat_load", "where": {"node": "px"}, "parameters": {}}
        report = {"twin": "benchsat", "verdict": "effect_added", "findings": [finding], "train": made.train}
        if wish == 0:
            report |= {"verdict": "no_effect_supported", "findings": []}
        report |= {"holdout_share": task.holdout}
        effects = [finding] if wish else []
        return Outcome(made.document, made.train, made.validation, effects, report=report, page="<h1>found</h1>")

    def inspect(self, document: Json) -> Outcome:
        if "spec" not in document:
            raise ModelError("spec: is missing")
        return Outcome(document, {}, {"rmse_K": 1.0}, [])

    def assimilate(self, stretches: Sequence[Stretch]) -> list[Filtered | Exception]:
        """Filter one stretch after the other."""
        found: list[Filtered | Exception] = []
        for stretch in stretches:
            try:
                found.append(self.filtered(stretch.document, stretch.telemetry, stretch.state))
            except Exception as error:
                found.append(error)
        return found

    def filtered(self, document: str, telemetry: Telemetry, state: Json | None) -> Filtered:
        """Predict that nothing changes: innovations are first differences, the state the last readings."""
        if "poison" in document and not Path(document[document.index("/") :].split('"')[0]).exists():
            os.kill(os.getpid(), 9)
        read = np.stack([telemetry.values[s] for s in SENSORS], axis=1)
        if (read == DEADLY).any():
            os.kill(os.getpid(), 9)
        if (read == UNFIT).any():
            raise ModelError("the filter cannot make sense of a reading")
        before = np.array(state["last"]) if state else read[0]
        before = np.where(np.isnan(before), 0.0, before)
        if state:
            read[0] = before
        innovation = np.diff(read, axis=0, prepend=before[None, :])
        last = np.where(np.isnan(read[-1]), before, read[-1])
        nis = np.nansum(innovation**2, axis=1)
        return Filtered(SENSORS, innovation, np.ones_like(innovation), nis, {"last": last.tolist()})

    def memory_s(self, document: str, telemetry: Telemetry) -> float:
        """Forget within half a minute."""
        return 30.0

    def score(self, document: str, telemetry: Telemetry) -> float | None:
        """Score a model by what its document says of it."""
        return float(json.loads(document)["rmse_K"])

    def screen(self, units: Mapping[str, str | None], inputs: Collection[str], telemetry: Telemetry) -> Masks:
        """Take everything for a reading."""
        return {}

    def forecast(self, document: str, task: ForecastTask) -> Forecasted:
        """Hold the last readings; the planned power, if there is one, is added to them."""
        assert task.step_s is not None and task.state is not None
        count = round(task.horizon_s / task.step_s)
        start = int(task.telemetry.time_us[-1])
        time_us = start + np.arange(1, count + 1) * round(task.step_s * 1e6)
        planned = 0.0 if task.plan is None else task.plan.values["Q_px"][-1]
        mean = {s: np.full(count, last + planned) for s, last in zip(SENSORS, task.state["last"], strict=True)}
        quantiles = {q: {s: m + q - 0.5 for s, m in mean.items()} for q in task.quantiles}
        inputs = {"Q_px": "hold" if task.plan is None else "plan"}
        present = dict(zip(SENSORS, task.state["last"], strict=True))
        return Forecasted(time_us, mean, quantiles, present, ("held the last readings",), inputs=inputs)

    def flows(self, document: str, telemetry: Telemetry, state: Json) -> Json:
        nodes = [{"id": "px", "temperature_K": state["last"][0], "heat_W": 0.0, "sensed": True}]
        return {"nodes": nodes, "boundaries": [], "links": [], "loads": [], "effects": []}


def _outcome(specification: Json, rmse_K: float, rival: float | None, samples: int, stop_us: int) -> Outcome:
    stop = f"{np.datetime64(stop_us, 'us')}Z"
    train = {"start": "1970-01-01T00:00:00Z", "stop": stop, "samples": samples}
    document = {"spec": specification, "rmse_K": rmse_K, "max_step_s": 60.0}
    return Outcome(document, train, {"rmse_K": None if rmse_K == 17 else rmse_K}, [], rival)
