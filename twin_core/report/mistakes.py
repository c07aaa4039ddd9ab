"""Mistakes of the declaration that would explain what a closed loop leaves unexplained, or how far its parameters went."""

from itertools import combinations

import numpy as np

from twin_core._typing import Json
from twin_core.calibrate.containment import NO_DEADLINE
from twin_core.calibrate.identifiability import nothing_moves
from twin_core.calibrate.second_order import Calibration
from twin_core.calibrate.summary import stated_guesses
from twin_core.calibrate.suspicions import MANY_NOISES, close_words, declared_of, is_odd, suspicions
from twin_core.discover.judge import Search
from twin_core.errors import ModelError, TelemetryError

MOST = 0.9
"""Share of what a model leaves of two sensors, squared: a half where they are off alike and independently, one where their
difference is all there is; above this all but a tenth, as ``REPEATABLE_SHARE`` of the search has it."""


def told_mistakes(search: Search, report: Json, *, deadline: float = NO_DEADLINE) -> Json:
    """Return what a report gains: under ``suspicions`` the mistakes that would explain more than the findings do, and words.

    Parameters
    ----------
    search
        A finished search; its base is the declared model.
    report
        The report so far: its words are not repeated.
    deadline
        On the clock of ``time.monotonic``: no mistake is tried afterwards.
    """
    calibration = search.trial.calibration()
    parameters, guesses = calibration.network.parameters, stated_guesses(search.base.calibration().problem.network)
    squares = np.concatenate(calibration.residuals) ** 2 / calibration.problem.noise_K**2
    misfit = float(np.sqrt(np.nanmean(squares)))
    base = search.base.calibration()
    still = nothing_moves(base.network.spec, [s.record for s in base.problem.segments])
    if still or not is_odd(parameters, guesses, misfit):
        return {"suspicions": []}
    report = report | {"notices": [*contradictions(base), *report["notices"]]}
    try:
        looked = suspicions(declared_of(base.problem), base.network.parameters.as_dict(), deadline=deadline)
    except (TelemetryError, ModelError) as error:  # what was found stands without it
        notice = f"mistakes of the declaration were not looked for: {error}"
        return {"suspicions": [], "notices": [*report["notices"], notice]}
    better = [s for s in looked.found if s.misfit < misfit or not search.findings]
    complete = looked.complete and not search.findings
    told = report["words"]
    words = close_words(parameters, guesses, misfit, better, told, complete=complete, left_out=looked.left_out)
    first = [line for line in words if line.startswith("perhaps ")]
    return {
        "suspicions": [s.to_json() for s in better],
        "words": [*report["words"], *(line for line in words if line not in first)],
        "notices": [*first, *report["notices"]],
    }


def contradictions(calibration: Calibration) -> list[str]:
    """Return in words which sensors of one node differ by all but a little of what a model leaves of them: that is no heat.

    One temperature is predicted for both: of readings that differ by d (rms) it leaves a and b with a + b >= d, whatever it is.
    Where they are off alike for reasons of their own, d² is half of (a + b)².
    """
    network, residual_K = calibration.network, np.concatenate(calibration.residuals)
    sensors, noise_K, said = network.spec.sensors, calibration.problem.noise_K, []
    for pair in combinations(range(len(sensors)), 2):
        (a, b), left_K = (sensors[i] for i in pair), residual_K[:, pair]
        node, both = network.layout.sensor_node(a), np.isfinite(left_K).all(axis=1)
        if node != network.layout.sensor_node(b) or not both.any():
            continue
        apart_K = float(np.sqrt(np.mean(np.diff(left_K[both]) ** 2)))
        left = float(np.sqrt(np.mean(left_K[both] ** 2, axis=0)).sum())
        if apart_K > MANY_NOISES * np.hypot(*noise_K[list(pair)]) and apart_K**2 > MOST * left**2:
            said.append(
                f"'{a}' and '{b}' read one node, {node}, and differ by {apart_K:.3g} K (rms): no heat explains that;"
                " one of them is wrong, or they belong to two nodes"
            )
    return said
