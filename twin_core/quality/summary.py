"""What was masked, as a report tells it: counts per channel and reason, and a strip to look at."""

from collections.abc import Sequence
from html import escape

from twin_core._typing import Json
from twin_core.telemetry import Record

COLOURS = {"frozen": "#4f7cac", "held": "#9aa5b1", "rail": "#8e6c8a", "sentinel": "#c0504d", "spike": "#e0a030"}
"""Of each reason, in the strip."""

MOST_SPANS = 20
"""Of one channel and reason that are listed one by one."""

_WIDTH, _ROW, _LABEL = 900.0, 18.0, 190.0


def quality_json(records: Sequence[Record]) -> list[Json]:
    """Return samples and spans that were masked, per channel and reason, in the order of their first appearance.

    ``first`` lists the first spans of each with ``start`` and ``stop``, their first and last sample.

    Parameters
    ----------
    records
        Screened telemetry, the hold-out included.
    """
    counted: dict[tuple[str, str], Json] = {}
    for record in records:
        for flaw in record.flaws or ():
            row = {"channel": flaw.channel, "reason": flaw.reason, "samples": 0, "spans": 0, "first": []}
            entry = counted.setdefault((flaw.channel, flaw.reason), row)
            entry["samples"] += flaw.samples
            entry["spans"] += 1
            if len(entry["first"]) < MOST_SPANS:
                start, stop = record.present(flaw.start_s), record.present(flaw.stop_s)
                entry["first"].append({"start": start, "stop": stop, "samples": flaw.samples})
    return list(counted.values())


def quality_strip(records: Sequence[Record]) -> str:
    """Return an SVG with a time axis per channel that lost samples, coloured by reason; empty where none did.

    The records follow one another along the axis in the order given.
    """
    channels = list(dict.fromkeys(flaw.channel for record in records for flaw in record.flaws or ()))
    if not channels:
        return ""
    total_s = sum(_extent_s(record) for record in records)
    marks, offset_s = [], 0.0
    for record in records:
        for flaw in record.flaws or ():
            start = _LABEL + (offset_s + flaw.start_s - record.time_s[0]) / total_s * (_WIDTH - _LABEL)
            width = max((flaw.stop_s - flaw.start_s) / total_s * (_WIDTH - _LABEL), 1.5)
            top = channels.index(flaw.channel) * _ROW + 3.0
            told = f"{flaw.channel}: {flaw.samples} {flaw.reason} from {record.present(flaw.start_s)}"
            marks.append(
                f'<rect x="{start:.1f}" y="{top:.1f}" width="{width:.1f}" height="{_ROW - 6.0:.1f}"'
                f' fill="{COLOURS[flaw.reason]}"><title>{escape(told)}</title></rect>'
            )
        offset_s += _extent_s(record)
    rows = [
        f'<text x="{_LABEL - 8.0:.0f}" y="{(row + 0.7) * _ROW:.1f}" text-anchor="end">{escape(channel)}</text>'
        f'<line x1="{_LABEL:.0f}" x2="{_WIDTH:.0f}" y1="{(row + 0.5) * _ROW:.1f}" y2="{(row + 0.5) * _ROW:.1f}"/>'
        for row, channel in enumerate(channels)
    ]
    reasons = dict.fromkeys(flaw.reason for record in records for flaw in record.flaws or ())
    bottom = len(channels) * _ROW
    legend = [
        f'<rect x="{_LABEL + 110.0 * k:.0f}" y="{bottom + 8.0:.0f}" width="12" height="12" fill="{COLOURS[reason]}"/>'
        f'<text x="{_LABEL + 110.0 * k + 18.0:.0f}" y="{bottom + 18.0:.0f}">{reason}</text>'
        for k, reason in enumerate(reasons)
    ]
    return (
        f'<svg class="quality" viewBox="0 0 {_WIDTH:.0f} {bottom + 28.0:.0f}" role="img"'
        ' aria-label="Masked samples of each channel over time">' + "".join([*rows, *marks, *legend]) + "</svg>"
    )


def _extent_s(record: Record) -> float:
    return max(float(record.time_s[-1] - record.time_s[0]), 1e-9)
