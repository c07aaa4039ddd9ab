"""Mistakes of the declaration that would explain what a closed loop leaves unexplained, or how far its parameters went."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from twin_core._typing import Json
from twin_core.calibrate.containment import NO_DEADLINE
from twin_core.calibrate.identifiability import nothing_is_heated, nothing_moves
from twin_core.calibrate.second_order import Calibration
from twin_core.calibrate.summary import stated_guesses
from twin_core.calibrate.suspicions import (
    MANY_NOISES,
    SAME,
    WITHOUT_PARAMETER,
    Looked,
    close_words,
    declared_of,
    is_odd,
    suspicions,
)
from twin_core.discover.judge import Search
from twin_core.errors import ModelError, TelemetryError

MOST = 0.9
"""Share of what a model leaves of two sensors, squared: a half where they are off alike and independently, one where their
difference is all there is; above this all but a tenth, as ``REPEATABLE_SHARE`` of the search has it."""


@dataclass(frozen=True)
class Mistakes:
    """What came of a look at the mistakes that a declaration may hold.

    Attributes
    ----------
    looked
        None where there was no reason to look, or no way.
    notice
        Why not, in words.
    """

    looked: Looked | None = None
    notice: str = ""

    def outdo(self, search: Search) -> bool:
        """Return whether one of them, of the readings or of a place, would leave less than the findings do.

        It adds no parameter, and the record speaks for it more: what was found beside it stands in for it.
        """
        if self.looked is None or not search.findings:
            return False
        of_data = (s.misfit for s in self.looked.found if s.mistake in WITHOUT_PARAMETER)
        return min(of_data, default=np.inf) < SAME * misfit_of(search.trial.calibration())


def misfit_of(calibration: Calibration) -> float:
    """Return the root mean square residual of a calibration, in units of the sensors' noise."""
    squares = np.concatenate(calibration.residuals) ** 2 / calibration.problem.noise_K**2
    return float(np.sqrt(np.nanmean(squares)))


def look_for_mistakes(search: Search, *, deadline: float = NO_DEADLINE) -> Mistakes:
    """Look for mistakes of the declaration, where the fit of a finished search is odd.

    Parameters
    ----------
    search
        Its base is the declared model.
    deadline
        On the clock of ``time.monotonic``: no mistake is tried afterwards.
    """
    calibration, base = search.trial.calibration(), search.base.calibration()
    still = nothing_moves(base.network.spec, [s.record for s in base.problem.segments])
    if still or not is_odd(calibration.network.parameters, _guesses(search), misfit_of(calibration)):
        return Mistakes()
    try:
        return Mistakes(suspicions(declared_of(base.problem), base.network.parameters.as_dict(), deadline=deadline))
    except (TelemetryError, ModelError) as error:  # what was found stands without it
        return Mistakes(notice=f"mistakes of the declaration were not looked for: {error}")


def told_mistakes(search: Search, mistakes: Mistakes, report: Json) -> Json:
    """Return what a report gains: under ``suspicions`` the mistakes that would explain more than the findings do, and words.

    Parameters
    ----------
    search
        A finished search.
    mistakes
        What :func:`look_for_mistakes` returned of it.
    report
        The report so far: its words are not repeated.
    """
    looked = mistakes.looked
    if looked is None and not mistakes.notice:
        return {"suspicions": []}
    notices = [*contradictions(search.base.calibration()), *report["notices"]]
    if looked is None:
        return {"suspicions": [], "notices": [*notices, mistakes.notice]}
    calibration = search.trial.calibration()
    misfit = misfit_of(calibration)
    better = [s for s in looked.found if s.misfit < misfit or not search.findings]
    words = close_words(
        calibration.network.parameters,
        _guesses(search),
        misfit,
        better,
        report["words"],
        complete=looked.complete and not search.findings,
        left_out=looked.left_out,
    )
    problem = search.base.calibration().problem
    first = [line for line in words if line.startswith("perhaps ")]
    unheated = nothing_is_heated(problem.network.spec, [segment.record for segment in problem.segments])
    return {
        "suspicions": [s.to_json() for s in better],
        "words": [*report["words"], *(line for line in words if line not in first)],
        "notices": [*unheated, *first, *notices],
    }


def _guesses(search: Search) -> dict[str, float]:
    """Return the guesses that the declaration states."""
    return stated_guesses(search.base.calibration().problem.network)


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
