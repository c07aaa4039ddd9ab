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
from twin_core.report import phrasing
from twin_core.report.network_picture import draw_flows, draw_network
from twin_core.report.phase_pictures import phase_pictures
from twin_core.report.residual_picture import draw_residuals
from twin_core.units import format_instant

if TYPE_CHECKING:
    from jinja2 import Template

_FOLDER = Path(__file__).parent / "templates"
_TITLE = "thermal model correlation"
_BINS = 40
_MOST_FLOWS = 60


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
        title=_TITLE,
        headline=phrasing.headline(report),
        gain=phrasing.gain(_rmse(report, "before"), _rmse(report, "after")),
        fell=_fell(report),
        sensors=_sensors(report),
        ensemble=report.get("ensemble") or {},
        parameters=[row for row in _parameters(report) if row["said"] != "known"],
        known=[row for row in _parameters(report) if row["said"] == "known"],
        sensitivity=_sensitivity(report),
        residuals=_residuals(plots),
        flows=_flows(report),
        phases=phase_pictures(report, plots, plots.get("criteria") or {}),
        document=report.get("document") or {},
        provenance=report.get("provenance") or {},
        evidence=_evidence(report),
        picture=draw_network(plots.get("network") or {}),
        quality_strip=plots.get("quality_strip") or "",
        criteria=plots.get("criteria") or {},
        data=_for_script(_chart_data(plots)),
        **{name: _asset(name) for name in ("style", "script", "uplot_style", "uplot_script")},
    )


def is_report(page: str) -> bool:
    """Return whether a text is a page that :func:`render` wrote."""
    return page.lstrip().startswith("<!doctype html>") and f" – {_TITLE}</title>" in page


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
        phrasing.ambiguities,
        phrasing.in_words,
        phrasing.instant,
        phrasing.kelvin,
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


def _parameters(report: Mapping[str, Any]) -> list[Json]:
    """Return the rows of the table of parameters, in words."""
    rows = []
    for row in report.get("parameters") or []:
        corrected = row.get("corrected") or {}
        if corrected.get("std") is None and row.get("identified") is None:
            said, kind = "known", ""
        else:
            said, kind = ("identified", "met") if row.get("identified") else ("not identified", "missed")
        texts = {
            k: phrasing.with_spread(v.get("mean"), v.get("std"))
            for k in ("calibrated", "corrected")
            if (v := row.get(k))
        }
        declared = phrasing.number(row.get("declared"), 4)
        rows.append(
            {
                "name": row["name"],
                "unit": phrasing.unit(row.get("unit") or ""),
                "declared": declared,
                "said": said,
                "kind": kind,
            }
            | texts
        )
    return rows


def _sensitivity(report: Mapping[str, Any]) -> Json:
    """Return the sensitivity matrix with each cell's share of the largest of its sensor, in per cent of full colour."""
    matrix = report.get("sensitivity") or {}
    if not matrix.get("rows"):
        return {}
    largest = np.max([row["rms_K"] for row in matrix["rows"]], axis=0)
    return {
        "sensors": matrix["sensors"],
        "rows": [
            row
            | {
                "cells": [
                    {"value": value, "share": round(60.0 * value / most) if most > 0 else 0}
                    for value, most in zip(row["rms_K"], largest.tolist(), strict=True)
                ]
            }
            for row in matrix["rows"]
        ],
    }


def _residuals(plots: Mapping[str, Any]) -> list[Json]:
    """Return the picture of each sensor's residuals over the hold-out."""
    time, start = plots.get("time") or [], plots.get("holdout_start")
    if not time or start is None or not math.isfinite(start):
        return []
    shown = [t >= start for t in time]
    kept = [t for t, show in zip(time, shown, strict=True) if show]
    ends = tuple(_told(t, bool(plots.get("dated"))) for t in (kept[0], kept[-1])) if kept else ("", "")
    rows = []
    for name, series in (plots.get("sensors") or {}).items():
        limits = (plots.get("limits") or {}).get(name) or {}
        histogram = (plots.get("histograms") or {}).get(name) or {}
        picture = draw_residuals(series, shown, histogram, limits, (ends[0], ends[1]))
        if picture:
            rows.append({"name": name, "noise_K": limits.get("noise_K"), "picture": picture})
    return rows


def _told(time_s: float, dated: bool) -> str:
    return f"{format_instant(round(time_s) * 10**9)}" if dated else f"{time_s:g} s"


def _flows(report: Mapping[str, Any]) -> list[Json]:
    """Return each phase of the heat-flow map with its picture, and its flows from the largest down."""
    found = []
    for phase in report.get("heat_flows") or []:
        rows = [_flow(link["kind"], link["ends"][0], link["ends"][1], link["heat_W"]) for link in phase["links"]]
        rows += [_flow("load", load["channel"], load["node"], load["heat_W"]) for load in phase["loads"]]
        rows += [_flow("heater", "heater", heater["node"], heater["heat_W"]) for heater in phase["heaters"]]
        for effect in phase["effects"]:
            rows += _flows_of(phrasing.in_words(effect["effect"]), effect["heat_W"])
        rows.sort(key=lambda row: -row["heat_W"])
        hidden = max(len(rows) - _MOST_FLOWS, 0) + phase.get("links_left_out", 0)
        told = {key: phase[key] for key in ("phase", "start", "stop")}
        found.append(told | {"rows": rows[:_MOST_FLOWS], "hidden": hidden, "picture": draw_flows(phase)})
    return found


def _flows_of(effect: str, heat_W: Mapping[str, float]) -> list[Json]:
    """Return what an effect brings to each node; one flow where one node gets what another one gives."""
    if len(heat_W) == 2:
        (source, lost_W), (target, gained_W) = heat_W.items()
        if math.isclose(lost_W, -gained_W):
            return [_flow(f"found: {effect}", source, target, gained_W)]
    return [_flow("found", effect, node, heat) for node, heat in heat_W.items()]


def _flow(kind: str, source: str, target: str, heat_W: float) -> Json:
    """Return one flow in the direction in which its heat goes."""
    if heat_W < 0.0:
        source, target = target, source
    return {"kind": kind, "source": source, "target": target, "heat_W": abs(heat_W)}


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
    # What flows through a coupling that was found is no function of the temperature of one of its ends.
    coupled = {end for item in plots.get("driven_heat") or [] for end in (item["node"], item["other"])}
    heat = [
        {**item, "by_temperature": None if item["node"] in coupled else _by_temperature(item)}
        for item in plots.get("missing_heat") or []
    ]
    driven = [
        {"node": item["node"], "unit": item["unit"], "axis": item["axis"]}
        | {"over": _binned(*(_floats(item, key) for key in ("x", "heat_W", "std_W", "effect_W")))}
        for item in plots.get("driven_heat") or []
    ]
    return {
        "dated": bool(plots.get("dated")),
        "time": plots.get("time") or [],
        "holdout_start": plots.get("holdout_start"),
        "sensors": plots.get("sensors") or {},
        "missing_heat": heat,
        "driven_heat": driven,
    }


def _by_temperature(item: Mapping[str, Any]) -> Json:
    """Return missing heat over temperature; the regression's own curve, where there is one, instead of means."""
    names = ("temperature_K", "mean_W", "std_W", "effect_W")
    found = _binned(*(_floats(item, key) for key in names))
    if law := item.get("law"):
        centre, _, _, effect = found["bins"]
        at, mean, spread = (_floats(law, key) for key in ("temperature_K", "mean_W", "std_W"))
        moved = np.interp(at, centre, np.array([np.nan if e is None else e for e in effect]))
        found["bins"] = [_nullable(column) for column in (at, mean, spread, moved)]
    return found


def _binned(x: FloatArray, heat_W: FloatArray, std_W: FloatArray, effect_W: FloatArray) -> Json:
    """Return heat over what drives it: sorted points, and the means with their bands in bins of equal counts."""
    order = np.argsort(x, kind="stable")
    order = order[np.isfinite(x[order]) & np.isfinite(heat_W[order])]
    bins = [part for part in np.array_split(order, min(_BINS, max(order.size // 4, 1))) if part.size]
    # Inside a bin neighbouring samples share one smooth error, so the band does not shrink with their number.
    spread = np.array([np.sqrt(np.mean(std_W[part] ** 2)) for part in bins])
    centre, mean, effect = (np.array([column[part].mean() for part in bins]) for column in (x, heat_W, effect_W))
    return {
        "points": [_nullable(x[order]), _nullable(heat_W[order])],
        "bins": [_nullable(column) for column in (centre, mean, spread, effect)],
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
