"""Mistakes of the declaration that would explain what a closed loop leaves unexplained, or how far its parameters went."""

import numpy as np

from twin_core._typing import Json
from twin_core.calibrate.containment import NO_DEADLINE
from twin_core.calibrate.identifiability import nothing_moves
from twin_core.calibrate.summary import stated_guesses
from twin_core.calibrate.suspicions import close_words, declared_of, is_odd, suspicions
from twin_core.discover.judge import Search


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
    looked = suspicions(declared_of(base.problem), base.network.parameters.as_dict(), deadline=deadline)
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
