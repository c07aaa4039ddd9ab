"""Durations on the command line: seconds, or a number with a unit."""

import re
from typing import Any

import click

SECONDS = {"s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}


class Duration(click.ParamType):
    """``90``, ``90s``, ``30min``, ``1.5h``, ``1d``, ``2w`` or ``1d12h``: seconds, not negative."""

    name = "duration"

    def __init__(self, *, positive: bool = False) -> None:
        """Refuse nothing but what is no duration; where ``positive``, none too."""
        self.positive = positive

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return seconds; a usage error says how to write them."""
        seconds = value if isinstance(value, int | float) else self._parsed(str(value).strip().lower())
        if seconds is None:
            self.fail(f"'{value}' is no duration; write seconds, or 30min, 6h, 1d, 1d12h", param, ctx)
        if self.positive and not 0.0 < seconds < float("inf"):
            self.fail(f"'{value}' is no positive number of seconds", param, ctx)
        return float(seconds)

    @staticmethod
    def _parsed(text: str) -> float | None:
        if re.fullmatch(r"(\d+(\.\d+)?(s|min|m|h|d|w))+", text):
            parts = re.findall(r"(\d+(?:\.\d+)?)(s|min|m|h|d|w)", text)
            return sum(float(number) * SECONDS[unit] for number, unit in parts)
        try:
            return float(text)
        except ValueError:
            return None


DURATION = Duration()
POSITIVE_DURATION = Duration(positive=True)
