"""The report page: one file that needs nothing but a browser."""

import json
import math
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from twin_core import __version__
from twin_core._typing import FloatArray, Json
from twin_core.discover import phrasing
from twin_core.discover.network_picture import draw_network

if TYPE_CHECKING:
    from jinja2 import Template

_FOLDER = Path(__file__).parent / "templates"
_BINS = 40


def render(report: Mapping[str, Any], plots: Mapping[str, Any]) -> str:
    """Return the page of a closed loop.

    Parameters
    ----------
    report
        The content of ``report.json``; optional members may be missing.
    plots
        What is drawn, as ``ClosedLoop.plots``; empty members leave their section out.

    Returns
    -------
    str
        An HTML document with styles, scripts and data inside. Every text of the report is escaped.
    """
    return _template().render(
        report=report,
        plots=plots,
        version=__version__,
        headline=phrasing.headline(report),
        gain=phrasing.gain(_rmse(report, "before"), _rmse(report, "after")),
        fell=_fell(report),
        sensors=_sensors(report),
        evidence=_evidence(report),
        picture=draw_network(plots.get("network") or {}),
        quality_strip=plots.get("quality_strip") or "",
        criteria=plots.get("criteria") or report.get("criteria") or {},
        data=_for_script(_chart_data(plots)),
        **{name: _asset(name) for name in ("style", "script", "uplot_style", "uplot_script")},
    )


@cache
def _template() -> "Template":
    from jinja2 import Environment, FileSystemLoader

    environment = Environment(
        loader=FileSystemLoader(_FOLDER),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    for function in (
        phrasing.in_words,
        phrasing.number,
        phrasing.parameters,
        phrasing.place,
        phrasing.sentence,
        phrasing.strength,
    ):
        environment.filters[function.__name__] = function
    return environment.get_template("report.html")


@cache
def _asset(name: str) -> str:
    files = {
        "style": "report.css",
        "script": "report.js",
        "uplot_style": "uplot/uPlot.min.css",
        "uplot_script": "uplot/uPlot.iife.min.js",
    }
    return (_FOLDER / files[name]).read_text(encoding="utf-8")


def _rmse(report: Mapping[str, Any], when: str) -> float | None:
    return (report.get(when) or {}).get("rmse_K")


def _fell(report: Mapping[str, Any]) -> bool:
    before, after = _rmse(report, "before"), _rmse(report, "after")
    return before is not None and after is not None and after < before


def _sensors(report: Mapping[str, Any]) -> list[Json]:
    """Return one row per sensor with its scores before and after, the worst first."""
    before = (report.get("before") or {}).get("per_sensor") or {}
    after = (report.get("after") or {}).get("per_sensor") or {}
    names = sorted({*before, *after}, key=lambda name: -((before.get(name) or {}).get("rmse_K") or 0.0))
    return [{"name": name, "before": before.get(name) or {}, "after": after.get(name) or {}} for name in names]


def _evidence(report: Mapping[str, Any]) -> list[Json]:
    """Return the rows of the evidence table: findings, each followed by its alternatives, then what was refused."""
    rows = []
    for finding in report.get("findings") or []:
        rows.append({"role": "added", **_row(finding, finding.get("evidence") or {})})
        rows += [{"role": "alternative", **_row(a, a)} for a in finding.get("alternatives") or []]
    for option in report.get("not_supported") or []:
        evidence = option.get("evidence") or {}
        effect = " + ".join(map(phrasing.label_in_words, option.get("effects") or []))
        rows.append({"role": "not supported", "effect": effect, "where": "", **_figures(evidence)})
    return rows


def _row(effect: Mapping[str, Any], evidence: Mapping[str, Any]) -> Json:
    name = phrasing.in_words(str(effect.get("effect")))
    return {"effect": name, "where": phrasing.place(effect.get("where") or {}), **_figures(evidence)}


def _figures(evidence: Mapping[str, Any]) -> Json:
    return {"log_bayes_factor": evidence.get("log_bayes_factor"), "p_value": evidence.get("p_value")}


def _chart_data(plots: Mapping[str, Any]) -> Json:
    """Return what the page's script draws."""
    heat = [{**item, "by_temperature": _by_temperature(item)} for item in plots.get("missing_heat") or []]
    return {
        "dated": bool(plots.get("dated")),
        "time": plots.get("time") or [],
        "holdout_start": plots.get("holdout_start"),
        "sensors": plots.get("sensors") or {},
        "missing_heat": heat,
    }


def _by_temperature(item: Mapping[str, Any]) -> Json:
    """Return missing heat over temperature: sorted points, and the mean with its band in bins of equal counts."""
    temperature_K, heat_W, std_W = (_floats(item, key) for key in ("temperature_K", "mean_W", "std_W"))
    effect_W = _floats(item, "effect_W") if item.get("effect_W") else np.full(heat_W.shape, np.nan)
    order = np.argsort(temperature_K, kind="stable")
    order = order[np.isfinite(temperature_K[order]) & np.isfinite(heat_W[order])]
    bins = [part for part in np.array_split(order, min(_BINS, max(order.size // 4, 1))) if part.size]
    centre = [float(temperature_K[part].mean()) for part in bins]
    mean = [float(heat_W[part].mean()) for part in bins]
    # Inside a bin neighbouring samples share one smooth error, so the band does not shrink with their number.
    spread = [float(np.sqrt(np.mean(std_W[part] ** 2))) for part in bins]
    effect = [float(effect_W[part].mean()) for part in bins]
    if law := item.get("law"):
        # The regression's own curve, where there is one; the effect's heat moves onto its temperatures.
        at, mean, spread = (list(_floats(law, key)) for key in ("temperature_K", "mean_W", "std_W"))
        effect, centre = list(np.interp(at, centre, effect)), at
    return {
        "points": [_nullable(temperature_K[order]), _nullable(heat_W[order])],
        "bins": [_nullable(np.array(column)) for column in (centre, mean, spread, effect)],
    }


def _floats(item: Mapping[str, Any], key: str) -> FloatArray:
    values = item.get(key) or [None] * len(item.get("time") or [])
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _nullable(values: FloatArray) -> list[float | None]:
    return [float(f"{value:.6g}") if math.isfinite(value) else None for value in values.tolist()]


def _for_script(data: Json) -> str:
    """Return JSON that may stand inside a script element: no text in it can end the element."""
    text = json.dumps(_finite(data), separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _finite(data: Any) -> Any:
    if isinstance(data, Mapping):
        return {str(key): _finite(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_finite(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data
