"""Figures of merit of a fit: error, correlation, bias, whiteness."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from twin_core._typing import FloatArray


def rmse(residual: FloatArray) -> float | None:
    """Return the root mean square of the finite residuals; None where there are none."""
    finite = residual[np.isfinite(residual)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else None


def pearson(measured: FloatArray, predicted: FloatArray) -> float | None:
    """Return the Pearson correlation coefficient (paper A, eq. 14); None where a series is constant or too short."""
    valid = np.isfinite(measured) & np.isfinite(predicted)
    if valid.sum() < 3:
        return None
    x, y = measured[valid] - measured[valid].mean(), predicted[valid] - predicted[valid].mean()
    scale = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / scale if scale > 0 else None


def whiteness(residual: FloatArray) -> float | None:
    """Return the lag-one autocorrelation of a residual series: 0 for white noise, 1 for a slow misfit."""
    before, after = residual[:-1], residual[1:]
    valid = np.isfinite(before) & np.isfinite(after)
    if valid.sum() < 8:
        return None
    centre = float(np.nanmean(residual))
    power = float(np.nanmean((residual - centre) ** 2))
    return float(np.mean((before[valid] - centre) * (after[valid] - centre))) / power if power > 0 else None


def spread_of(deviation_K: FloatArray) -> dict[str, float]:
    """Return how finite deviations (measured minus modelled) spread: mean, standard deviation, largest, quantiles, in K."""
    q01, q50, q99 = np.quantile(deviation_K, (0.01, 0.5, 0.99))
    return {
        "bias_K": float(deviation_K.mean()),
        "std_K": float(deviation_K.std()),
        "max_abs_K": float(np.abs(deviation_K).max()),
        "q01_K": float(q01),
        "q50_K": float(q50),
        "q99_K": float(q99),
        "q99_abs_K": float(np.quantile(np.abs(deviation_K), 0.99)),
    }


def score(sensors: Sequence[str], measured: Sequence[FloatArray], predicted: Sequence[FloatArray]) -> dict[str, Any]:
    """Return overall and per-sensor errors of one or several segments.

    Parameters
    ----------
    sensors
        Names, (n_sensors,).
    measured, predicted
        Per segment (n_samples, n_sensors), NaN where missing.

    Returns
    -------
    dict
        ``rmse_K``, ``pcc`` and ``per_sensor`` with ``rmse_K``, ``pcc`` and the figures of :func:`spread_of` each.
    """
    all_measured = np.concatenate(list(measured))
    all_predicted = np.concatenate(list(predicted))
    residual = all_measured - all_predicted
    per_sensor = {}
    for i, sensor in enumerate(sensors):
        finite = residual[:, i][np.isfinite(residual[:, i])]
        if finite.size:
            per_sensor[sensor] = {
                "rmse_K": rmse(finite),
                "pcc": pearson(all_measured[:, i], all_predicted[:, i]),
                **spread_of(finite),
            }
    pooled = pearson(all_measured.ravel(), all_predicted.ravel())
    each = [row["pcc"] for row in per_sensor.values() if row["pcc"] is not None]
    return {
        "rmse_K": rmse(residual.ravel()),
        "pcc": float(np.mean(each)) if each else pooled,
        "per_sensor": per_sensor,
    }


def residual_whiteness(residuals: Sequence[FloatArray]) -> float | None:
    """Return the mean lag-one autocorrelation over sensors and segments; None if nothing is long enough."""
    values = [whiteness(r[:, i]) for r in residuals for i in range(r.shape[1])]
    finite = [v for v in values if v is not None]
    return float(np.mean(finite)) if finite else None
