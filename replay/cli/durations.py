"""Durations on the command line: seconds, or a number with a unit."""

import re
from typing import Any

import click

SECONDS = {"s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}


class Duration(click.ParamType):
    """``90``, ``90s``, ``30min``, ``1.5h``, ``1d``, ``2w`` or ``1d12h``: seconds, not negative."""

    name = "duration"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return seconds; a usage error says how to write them."""
        if isinstance(value, int | float):
            return float(value)
        text = str(value).strip().lower()
        try:
            return float(text)
        except ValueError:
            pass
        if not re.fullmatch(r"(\d+(\.\d+)?(s|min|m|h|d|w))+", text):
            self.fail(f"'{value}' is no duration; write seconds, or 30min, 6h, 1d, 1d12h", param, ctx)
        parts = re.findall(r"(\d+(?:\.\d+)?)(s|min|m|h|d|w)", text)
        return sum(float(number) * SECONDS[unit] for number, unit in parts)


DURATION = Duration()
