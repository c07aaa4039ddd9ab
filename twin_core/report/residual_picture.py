"""What each model leaves of a sensor's readings, as an SVG picture: over time, with noise and limits, and as a histogram."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from twin_core._typing import FloatArray
from twin_core.report.phrasing import number

WIDTH, HEIGHT = 900.0, 170.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 62.0, 690.0, 10.0, 146.0
_BARS, _END = 710.0, 880.0
_SIGMAS = 2.0
_NEAR = 1.6
"""A limit that lies further out than so many times the largest residual is told in words instead of drawn."""
_PAD = 1.08


def draw_residuals(
    series: Mapping[str, Sequence[float | None]],
    shown: Sequence[bool],
    histogram: Mapping[str, Any],
    limits: Mapping[str, float],
    ends: tuple[str, str],
) -> str:
    """Return the picture of one sensor as an ``<svg>`` element whose colours come from the page's style sheet.

    Parameters
    ----------
    series
        ``measured``, ``before`` and ``after`` over time, in K.
    shown : (n_times,)
        Which samples belong into the picture.
    histogram
        ``edges_K`` with the counts ``before`` and ``after``; may be empty.
    limits
        ``noise_K`` and the acceptance limit ``q99_abs_K``, as far as they are known.
    ends
        What stands under both ends of the time axis.

    Returns
    -------
    str
        Empty where there is no residual.
    """
    keep = np.asarray(shown, dtype=bool)
    measured = _floats(series["measured"])[keep]
    curves = {when: measured - _floats(series[when])[keep] for when in ("before", "after")}
    sizes = [np.abs(curve[np.isfinite(curve)]) for curve in curves.values()]
    if not all(size.size for size in sizes):
        return ""
    largest = max(float(size.max()) for size in sizes)
    noise, limit = limits.get("noise_K") or 0.0, limits.get("q99_abs_K") or np.inf
    drawn = limit <= _NEAR * largest
    high = _PAD * max(largest, _SIGMAS * noise, limit if drawn else 0.0, 1e-9)

    def y(value: float) -> float:
        return _TOP + (1.0 - value / high) / 2.0 * (_BOTTOM - _TOP)

    parts = [
        f'<rect class="noise" x="{_LEFT:g}" y="{y(_SIGMAS * noise):.1f}" width="{_RIGHT - _LEFT:g}"'
        f' height="{y(-_SIGMAS * noise) - y(_SIGMAS * noise):.1f}"/>',
        f'<path class="zero" d="M{_LEFT:g} {y(0.0):.1f}H{_END:g}"/>',
    ]
    if drawn:
        parts += [f'<path class="limit" d="M{_LEFT:g} {y(side * limit):.1f}H{_END:g}"/>' for side in (-1.0, 1.0)]
    x = _LEFT + np.arange(measured.size) / max(measured.size - 1, 1) * (_RIGHT - _LEFT)
    parts += [f'<path class="{when}" d="{_path(x, curve, y)}"/>' for when, curve in curves.items()]
    parts += _bars(histogram, y)
    ticks = (-high / _PAD, 0.0, high / _PAD)
    parts += [f'<text class="tick" x="{_LEFT - 6:g}" y="{y(t) + 4:.1f}">{number(t, 2)} K</text>' for t in ticks]
    parts.append(f'<text x="{_LEFT:g}" y="{HEIGHT - 6:g}">{escape(ends[0])}</text>')
    parts.append(f'<text class="end" x="{_RIGHT:g}" y="{HEIGHT - 6:g}">{escape(ends[1])}</text>')
    if np.isfinite(limit) and not drawn:
        beyond = f"limit ±{number(limit, 2)} K, beyond this picture"
        parts.append(f'<text class="middle" x="{(_LEFT + _RIGHT) / 2:g}" y="{HEIGHT - 6:g}">{beyond}</text>')
    parts.append(f'<text x="{_BARS:g}" y="{HEIGHT - 6:g}">readings</text>')
    return f'<svg class="residuals" viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img">{"".join(parts)}</svg>'


def _floats(values: Sequence[float | None]) -> FloatArray:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _path(x: FloatArray, curve: FloatArray, y: Any) -> str:
    """Return a line through the finite points, broken where there is none."""
    steps, pen_down = [], False
    for at, value in zip(x.tolist(), curve.tolist(), strict=True):
        if np.isfinite(value):
            steps.append(f"{'L' if pen_down else 'M'}{at:.1f} {y(value):.1f}")
        pen_down = bool(np.isfinite(value))
    return "".join(steps)


def _bars(histogram: Mapping[str, Any], y: Any) -> list[str]:
    """Return both histograms lying on their side, outlined one over the other, on the axis of the residuals."""
    edges = histogram.get("edges_K")
    if not edges:
        return []
    most = max(max(histogram["before"]), max(histogram["after"]), 1)
    parts = []
    for when in ("before", "after"):
        steps = [f"M{_BARS:g} {y(edges[0]):.1f}"]
        for low, high, count in zip(edges, edges[1:], histogram[when], strict=False):
            right = _BARS + count / most * (_END - _BARS)
            steps.append(f"L{right:.1f} {y(low):.1f}V{y(high):.1f}")
        parts.append(f'<path class="bar {when}" d="{"".join(steps)}H{_BARS:g}Z"/>')
    return parts
