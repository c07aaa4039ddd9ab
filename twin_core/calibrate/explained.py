"""A calibration that says what its oddities usually mean: the second-order fit, followed by suspicions where it is odd."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from twin_core._typing import Progress
from twin_core.calibrate.containment import NO_DEADLINE
from twin_core.calibrate.identifiability import nothing_moves
from twin_core.calibrate.noise import sensor_noise_K
from twin_core.calibrate.problem import build_problem
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.second_order import Calibration, Loss, fit_trajectories
from twin_core.calibrate.starting import table_levels
from twin_core.calibrate.summary import stated_guesses, to_model
from twin_core.calibrate.suspicions import close_words, declared_of, is_odd, suspicions
from twin_core.errors import NoSolutionError
from twin_core.network.doubts import doubts
from twin_core.network.model import build_network
from twin_core.network.screened import all_screened
from twin_core.network.spec import TwinSpec
from twin_core.telemetry import Record


def calibrate_and_explain(
    spec: TwinSpec, records: Sequence[Record], loss: Loss, deadline: float, progress: Progress
) -> CalibratedModel:
    """Return the model of the second-order method, whose words close with what an odd fit usually means.

    Parameters
    ----------
    spec, records, loss, deadline, progress
        As in :func:`twin_core.calibrate.calibrate`.

    Raises
    ------
    TelemetryError
        If the telemetry lacks what the model needs.
    NoSolutionError
        If the heat balance has no solution from any start; with the mistake that would explain it, where one does.
    """
    try:
        calibration = fit_trajectories(spec, records, loss=loss, deadline=deadline, progress=progress)
    except NoSolutionError as error:
        raise NoSolutionError(advised(str(error), spec, records, deadline)) from error
    return explained(to_model(calibration, ()), calibration, deadline=deadline)


def explained(model: CalibratedModel, calibration: Calibration, *, deadline: float = NO_DEADLINE) -> CalibratedModel:
    """Return a model with words on what an odd fit usually means; itself where nothing is odd, or no sensor ever changes."""
    problem, parameters = calibration.problem, calibration.network.parameters
    guesses = stated_guesses(problem.network)
    misfit = float(np.sqrt(np.nanmean(np.concatenate(calibration.residuals) ** 2 / problem.noise_K**2)))
    if nothing_moves(problem.network.spec, [s.record for s in problem.segments]) or not is_odd(
        parameters, guesses, misfit
    ):
        return model
    looked = suspicions(declared_of(problem), parameters.as_dict(), deadline=deadline)
    told = model.summary["words"]
    added = close_words(
        parameters, guesses, misfit, looked.found, told, complete=looked.complete, left_out=looked.left_out
    )
    words = [*told, *added]
    return replace(model, summary={**model.summary, "words": words, "suspicions": [s.to_json() for s in looked.found]})


def advised(error: str, spec: TwinSpec, records: Sequence[Record], deadline: float = NO_DEADLINE) -> str:
    """Return the error with what is most likely wrong with the channels, and the mistakes with which there is a solution."""
    seen = all_screened(spec, records)
    network = build_network(spec, table_knots=table_levels(spec, seen))
    problem = build_problem(network, seen, sensor_noise_K(spec, seen))
    looked = suspicions(declared_of(problem), deadline=deadline)
    told = [error, *doubts(spec, seen), *(f"perhaps {s.words}" for s in looked.found), looked.left_out]
    return "; ".join(line for line in told if line)
