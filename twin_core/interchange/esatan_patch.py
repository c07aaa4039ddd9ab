"""Calibrated couplings and heats back into the ESATAN-TMS deck that they came from, as a patch."""

import difflib
import re
from collections.abc import Mapping

from twin_core.interchange.imported import number

_COUPLING = re.compile(r"\b(G[LRF])(\s*\(\s*(\d+)\s*,\s*(\d+)\s*\)\s*=\s*)([^;#]+?)(\s*;)", re.IGNORECASE)
SAME = 1e-9
"""Factors nearer to one than this change nothing."""


def patched(
    text: str, declared: Mapping[str, float], calibrated: Mapping[str, float]
) -> tuple[str, list[str], list[str]]:
    """Return a deck with its couplings at their calibrated values.

    Each expression is multiplied by the factor of its coupling, so that parallel ones keep their shares and arithmetic over
    locals stays readable.

    Parameters
    ----------
    text
        The deck.
    declared, calibrated
        Parameter name (``G:n1|n2``, ``R:n1|n99``) -> value that the deck gives, and value now.

    Returns
    -------
    str, list of str, list of str
        The new deck, the couplings that were changed, and those that have changed but stand in no statement of their own (in
        a loop, or from view factors).
    """
    factors = {
        name: number(calibrated[name] / value)
        for name, value in declared.items()
        if name[:2] in ("G:", "R:") and name in calibrated and abs(calibrated[name] / value - 1.0) > SAME
    }
    done: list[str] = []

    def replaced(match: re.Match[str]) -> str:
        kind, first, second = match[1].upper(), f"n{int(match[3])}", f"n{int(match[4])}"
        names = {
            "GL": (f"G:{first}|{second}", f"G:{second}|{first}"),
            "GR": (f"R:{first}|{second}", f"R:{second}|{first}"),
            "GF": (f"G:{first}>{second}",),
        }[kind]
        name = next((n for n in names if n in factors), None)
        if name is None:
            return match[0]
        done.append(name)
        return f"{match[1]}{match[2]}{factors[name]:.9g} * ({match[5].strip()}){match[6]}"

    lines = [
        _COUPLING.sub(replaced, line) if not line.lstrip().startswith("#") else line
        for line in text.splitlines(keepends=True)
    ]
    return "".join(lines), list(dict.fromkeys(done)), [name for name in factors if name not in done]


def as_patch(before: str, after: str, name: str) -> str:
    """Return the difference between two decks as ``patch -p0`` takes it."""
    return "".join(
        difflib.unified_diff(
            before.splitlines(keepends=True), after.splitlines(keepends=True), fromfile=name, tofile=name
        )
    )
