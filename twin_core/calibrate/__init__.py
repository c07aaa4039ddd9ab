"""Calibration: fitting a declared network to measured temperatures.

The methods are looked up when asked for, so that reading a model file needs no compiler and no torch.
"""

from collections.abc import Mapping, Sequence

from threadpoolctl import threadpool_limits

from twin_core._typing import Progress, no_progress
from twin_core.calibrate.result import CalibratedModel
from twin_core.errors import ModelError
from twin_core.network.screened import segments
from twin_core.network.spec import TwinSpec
from twin_core.telemetry import Record

METHODS = ("second-order", "neural-ode")
LOSSES = ("squared", "huber")


def calibrate(
    spec: TwinSpec,
    records: Sequence[Record],
    *,
    method: str = "second-order",
    loss: str = "squared",
    deadline: float = float("inf"),
    training: Mapping[str, float] | None = None,
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
    deadline
        On the clock of ``time.monotonic``: the second-order search ends there with the best so far; the summary's
        ``status`` is then ``deadline``. It holds for that method alone.
    training
        How ``neural-ode`` trains: ``learning_rate``, ``window_s``, ``max_iterations`` and ``patience``, as far as they are not
        to be the paper's.
    progress
        Called with the fraction done and a message.

    Returns
    -------
    CalibratedModel
        With covariance, residual figures and plain words about what the data cannot see.

    Raises
    ------
    TelemetryError, ModelError
        If the telemetry lacks what the model needs.
    NoSolutionError
        If the heat balance has no solution from any start.
    """
    if method not in METHODS:
        raise ModelError(f"unknown calibration method '{method}' (known: {', '.join(METHODS)})")
    if loss not in LOSSES:
        raise ModelError(f"unknown loss '{loss}' (known: {', '.join(LOSSES)})")
    if training and method != "neural-ode":
        raise ModelError(f"{next(iter(training))} belongs to method 'neural-ode'")
    records = segments(spec, records)
    if method == "neural-ode":
        model = _by_neural_ode(spec, records, loss, dict(training or {}), progress)
    else:
        from twin_core.calibrate.explained import calibrate_and_explain

        with threadpool_limits(1):  # threads within so small products wait for each other longer than they compute
            model = calibrate_and_explain(spec, records, "huber" if loss == "huber" else "squared", deadline, progress)
    progress(1.0, "calibrated")
    return model


def _by_neural_ode(
    spec: TwinSpec, records: Sequence[Record], loss: str, training: dict[str, float], progress: Progress
) -> CalibratedModel:
    """Calibrate by the method of paper A."""
    if loss != "squared":
        raise ModelError(f"method 'neural-ode' knows the squared loss only; use second-order with '{loss}'")
    try:
        from twin_core.calibrate.neural_ode import fit_neural_ode, recipe_of
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "torchdiffeq"):
            raise
        raise ModelError(
            f"method 'neural-ode' needs {error.name}, which is not installed: pip install torch torchdiffeq "
            "(README: how to get the small build)"
        ) from error
    from twin_core.calibrate.summary import to_model

    trained, calibration = fit_neural_ode(spec, records, recipe_of(training), progress=progress)
    return to_model(calibration, (), trained.notices, uncertain=False)


__all__ = ["LOSSES", "METHODS", "CalibratedModel", "calibrate"]
