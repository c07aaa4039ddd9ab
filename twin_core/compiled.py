"""Deadlines, which begin to count once what a closed loop needs is compiled; as a command, compilation after an installation."""

import time
from contextlib import suppress
from functools import cache

import numpy as np

from twin_core.calibrate.containment import NO_DEADLINE, NUMERICAL_FAILURES
from twin_core.calibrate.second_order import fit_network
from twin_core.calibrate.summary import to_model
from twin_core.discover.judge import Search
from twin_core.discover.trial import Trial
from twin_core.errors import ModelError
from twin_core.missing_heat.smoothed import smooth_missing_heat
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

N_SAMPLES = 40


def deadline_after(seconds: float | None) -> float:
    """Return when so many seconds are over, on the clock of ``time.monotonic``, counted from after compilation; None: never."""
    if seconds is None:
        return NO_DEADLINE
    compile_ahead()
    return time.monotonic() + seconds


@cache
def compile_ahead() -> None:
    """Fit a body that cools, and smooth its heat, once per process: that compiles all loops after an installation, or loads them.

    Half a minute of compilation within a search's deadline would leave guesses in the place of a fit.
    """
    spec = load_spec(
        {
            "twin": "body",
            "boundaries": {"room": {"value_K": 290.0}},
            "channels": {"T": {"kind": "temperature", "unit": "K"}},
            "nodes": [{"id": "body", "sensor": "T", "capacity_J_per_K": {"guess": 100.0}}],
            "conductors": [{"between": ["body", "room"], "conductance_W_per_K": {"guess": 1.0}}],
        }
    )
    time_s = np.linspace(0.0, 400.0, N_SAMPLES)
    noise_K = 0.1 * np.random.default_rng(0).standard_normal(N_SAMPLES)
    read_K = 290.0 + 20.0 * np.exp(-time_s / 80.0) + noise_K
    with suppress(ModelError, *NUMERICAL_FAILURES):  # what fails here fails with its reason where it matters
        fit, calibration = fit_network(spec, [Record(time_s, {"T": read_K})])
        to_model(calibration, ())
        base = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
        smooth_missing_heat(Search(base, base))


if __name__ == "__main__":
    compile_ahead()
