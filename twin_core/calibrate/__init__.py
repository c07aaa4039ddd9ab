"""Calibration: fitting a declared network to measured temperatures.

The methods are looked up when asked for, so that reading a model file needs no compiler and no torch.
"""

from collections.abc import Sequence

from twin_core._typing import Progress, no_progress
from twin_core.calibrate.result import CalibratedModel
from twin_core.errors import ModelError
from twin_core.network.spec import TwinSpec
from twin_core.telemetry import Record, cut_at_gaps

METHODS = ("second-order", "neural-ode")
LOSSES = ("squared", "huber")


def calibrate(
    spec: TwinSpec,
    records: Sequence[Record],
    *,
    method: str = "second-order",
    loss: str = "squared",
    progress: Progress = no_progress,
) -> CalibratedModel:
    """Calibrate a declared network against telemetry.

    Parameters
    ----------
    spec
        The declared network: guesses, bounds, known values.
    records
        Segments of telemetry in SI, each with its own initial state; a long gap divides a segment.
    method
        ``second-order``: Levenberg-Marquardt with exact sensitivities. ``neural-ode``: the method of paper A
        (arXiv 2605.28452), Adam on windows of the record; it states no uncertainty of the parameters.
    loss
        ``squared``, or ``huber`` for readings with outliers; the second method knows ``squared`` only.
    progress
        Called with the fraction done and a message.

    Returns
    -------
    CalibratedModel
        With covariance, residual figures and plain words about what the data cannot see.

    Raises
    ------
    TelemetryError, ModelError
        If the telemetry lacks what the model needs, or the balance has no solution.
    """
    if method not in METHODS:
        raise ModelError(f"unknown calibration method '{method}' (known: {', '.join(METHODS)})")
    if loss not in LOSSES:
        raise ModelError(f"unknown loss '{loss}' (known: {', '.join(LOSSES)})")
    records = cut_at_gaps(records, spec.driving_channels)
    from twin_core.calibrate.second_order import fit_trajectories, to_model

    if method == "neural-ode":
        if loss != "squared":
            raise ModelError(f"method '{method}' knows the squared loss only; use second-order with '{loss}'")
        from twin_core.calibrate.neural_ode import fit_neural_ode

        _, calibration = fit_neural_ode(spec, records, progress=progress)
        model = to_model(calibration, (), uncertain=False)
    else:
        calibration = fit_trajectories(spec, records, loss="huber" if loss == "huber" else "squared", progress=progress)
        model = to_model(calibration, ())
    progress(1.0, "calibrated")
    return model


__all__ = ["LOSSES", "METHODS", "CalibratedModel", "calibrate"]
