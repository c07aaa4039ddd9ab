"""What a correlation leaves of each phase, as SVG pictures: the deviation of every sensor, and residuals over a transient."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from twin_core._typing import Json
from twin_core.report.phrasing import number
from twin_core.report.residual_picture import draw_residuals

WIDTH = 900.0
_LEFT, _RIGHT, _ROW, _FOOT = 190.0, 870.0, 18.0, 24.0
_NEAR = 1.6
"""A limit that lies further out than so many times the largest deviation is told in words instead of drawn."""
_PAD = 1.08
_BINS = 40


def phase_pictures(report: Mapping[str, Any], plots: Mapping[str, Any], criteria: Mapping[str, Any]) -> list[Json]:
    """Return one entry per phase: its name, the picture of its deviations, and ``residuals`` of a transient by sensor.

    Parameters
    ----------
    report
        Of a correlation; its ``phases`` hold the mean deviation of each sensor before and after.
    plots
        ``phases``: name -> ``ends``, what stands under the time axis, and ``sensors``, name -> series in K as
        ``draw_residuals`` takes them; ``limits``: sensor -> noise and limits.
    criteria
        ``bias_K``, the limit of a mean deviation.
    """
    found = []
    for phase in report.get("phases") or []:
        drawn = (plots.get("phases") or {}).get(phase["phase"]) or {}
        residuals = []
        for sensor, series in (drawn.get("sensors") or {}).items():
            limits = (plots.get("limits") or {}).get(sensor) or {}
            first, last = (end if isinstance(end, str) else f"{end:g} s" for end in drawn["ends"])
            picture = draw_residuals(
                series, [True] * len(series["measured"]), _histogram(series), limits, (first, last)
            )
            if picture:
                residuals.append({"name": sensor, "picture": picture})
        picture = draw_deviations(phase, criteria.get("bias_K"))
        found.append({"name": phase["phase"], "steady": phase["steady"], "picture": picture, "residuals": residuals})
    return found


def draw_deviations(phase: Mapping[str, Any], limit_K: float | None) -> str:
    """Return the mean deviation of every sensor in one phase, declared as a ring and correlated as a dot, as ``<svg>``.

    Empty where nothing was read.
    """
    scores = {when: (phase.get(when) or {}).get("per_sensor") or {} for when in ("before", "after")}
    sensors = list(scores["after"])
    means = [row["bias_K"] for table in scores.values() for row in table.values()]
    if not sensors:
        return ""
    largest = max(abs(mean) for mean in means)
    drawn = limit_K is not None and limit_K <= _NEAR * largest
    high = _PAD * max(largest, limit_K if drawn and limit_K is not None else 0.0, 1e-9)
    bottom = _ROW * len(sensors) + 6.0

    def x(value: float) -> float:
        return _LEFT + (1.0 + value / high) / 2.0 * (_RIGHT - _LEFT)

    parts = [f'<path class="zero" d="M{x(0.0):.1f} 0V{bottom:g}"/>']
    if drawn and limit_K is not None:
        parts += [f'<path class="limit" d="M{x(side * limit_K):.1f} 0V{bottom:g}"/>' for side in (-1.0, 1.0)]
    for row, sensor in enumerate(sensors):
        y = _ROW * (row + 0.5) + 3.0
        parts.append(f'<text class="end" x="{_LEFT - 12:g}" y="{y + 4:g}">{escape(sensor)}</text>')
        parts.append(f'<path class="row" d="M{_LEFT:g} {y:g}H{_RIGHT:g}"/>')
        for when, radius in (("before", 5.0), ("after", 4.0)):
            if sensor in scores[when]:
                parts.append(
                    f'<circle class="{when}" cx="{x(scores[when][sensor]["bias_K"]):.1f}" cy="{y:g}" r="{radius:g}"/>'
                )
    for value in (-high / _PAD, 0.0, high / _PAD):
        parts.append(f'<text class="middle" x="{x(value):.1f}" y="{bottom + 16:g}">{number(value, 2)} K</text>')
    if limit_K is not None and not drawn:
        beyond = f"limit ±{number(limit_K, 2)} K, beyond this picture"
        parts.append(f'<text x="0" y="{bottom + 16:g}">{beyond}</text>')
    name = escape(f"Deviations in {phase['phase']}", quote=True)
    box = f"0 0 {WIDTH:g} {bottom + _FOOT:g}"
    return f'<svg class="residuals deviations" viewBox="{box}" role="img" aria-label="{name}">{"".join(parts)}</svg>'


def _histogram(series: Mapping[str, Sequence[float | None]]) -> Json:
    """Return counts of both models' residuals in bins that they share."""
    columns = {name: np.array([np.nan if v is None else v for v in values]) for name, values in series.items()}
    left = {when: columns["measured"] - columns[when] for when in ("before", "after")}
    kept = {when: values[np.isfinite(values)] for when, values in left.items()}
    if not all(values.size for values in kept.values()):
        return {}
    low, high = min(v.min() for v in kept.values()), max(v.max() for v in kept.values())
    edges = np.linspace(low, max(high, low + 1e-9), _BINS + 1)
    return {"edges_K": edges.tolist()} | {when: np.histogram(v, edges)[0].tolist() for when, v in kept.items()}
