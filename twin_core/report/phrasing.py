"""The verdict in words and numbers with units, for people."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from twin_core._typing import Json
from twin_core.discover.policy import ALTERNATIVE_NATS

_UNITS = {
    "_J_per_K": "J/K",
    "_W_per_K": "W/K",
    "_K_per_s": "K/s",
    "_per_K": "1/K",
    "_per_s": "1/s",
    "_m2": "m²",
    "_W": "W",
    "_K": "K",
    "_J": "J",
    "_s": "s",
    "time": "s",
}
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
DECISIVE, STRONG = 5.0, 3.0
"""Log Bayes factors after Kass and Raftery, "Bayes factors", JASA 90 (1995): 5 is very strong, 3 strong."""
MOST_NAMED = 3
"""Alternatives that a sentence names; the report lists all."""


def headline(report: Mapping[str, Any]) -> str:
    """Return the verdict as one sentence."""
    findings = report.get("findings") or []
    verdict = report.get("verdict")
    if verdict == "correlated":
        return _correlated(report.get("phases") or [])
    resting = report.get("resting_sensors") or []
    if resting and len(resting) == len((report.get("before") or {}).get("per_sensor") or {}):
        named = f"{', '.join(resting[:3])}{', ...' if len(resting) > 3 else ''}"
        return f"No sensor ever changes ({named}): stuck or at rest, they tell nothing of the model; check them first."
    if verdict == "effect_added" and findings:
        more = len(findings) - 1
        others = f"; {more} more effect{'s were' if more > 1 else ' was'} found" if more else ""
        return f"{sentence(findings[0], capital=True)}{others}."
    if resting and verdict == "unexplained":
        names = (
            f"Sensors {', '.join(resting)} never change" if len(resting) > 1 else f"Sensor {resting[0]} never changes"
        )
        return (
            f"{names}: stuck or at rest. No missing effect is looked for; take out of the specification what is stuck."
        )
    if (report.get("search") or {}).get("complete") is False:
        if verdict == "unexplained":
            return "Something is missing from the model; the deadline ended the search before an effect explained it."
        return "No missing effect was found before the deadline ended the search; not all was looked at."
    if verdict == "unexplained":
        return "Something is missing from the model, and no known effect explains it."
    return "The declared model suffices: the data supports no missing effect."


def _correlated(phases: Sequence[Mapping[str, Any]]) -> str:
    """Return in which phases a correlated model meets the criteria."""
    missed = []
    for phase in phases:
        rows = (phase.get("after") or {}).get("per_sensor") or {}
        if sensors := [name for name, row in rows.items() if not row.get("met")]:
            missed.append(f"{phase['phase']} ({', '.join(sensors[:3])}{', ...' if len(sensors) > 3 else ''})")
    if not missed:
        return f"The correlated model meets the criteria in {'every phase' if len(phases) > 1 else 'its phase'}."
    return f"The correlated model does not meet the criteria in {' and '.join(missed)}."


def sentence(finding: Mapping[str, Any], *, capital: bool = False) -> str:
    """Return a finding as a sentence without full stop: ``a conductor between mx and battery was missing``.

    It is the effect's own; a report that carries none is told by the name of the effect and its place.
    """
    told = finding.get("sentence")
    if not told:
        told = f"{in_words(finding['effect'])} {place(finding.get('where') or {})}".strip() + " was missing"
    return told[:1].upper() + told[1:] if capital and told.split()[0] not in _names(finding) else str(told)


def _names(finding: Mapping[str, Any]) -> set[str]:
    """Return the names of a finding's place."""
    places = (finding.get("where") or {}).values()
    return {str(name) for value in places for name in ((value,) if isinstance(value, str) else value)}


def gain(before_K: float | None, after_K: float | None) -> str:
    """Return how the error changed: a factor where it fell a lot, a percentage otherwise."""
    if not before_K or after_K is None or not math.isfinite(before_K) or not math.isfinite(after_K):
        return ""
    if after_K > 0 and before_K / after_K >= 2.0:
        return f"{number(before_K / after_K, 2)} times smaller"
    change = (after_K - before_K) / before_K
    if abs(change) < 0.005:
        return "unchanged"
    return f"{abs(change):.0%} {'smaller' if change < 0 else 'larger'}"


def strength(log_bayes_factor: float | None) -> str:
    """Return how strong evidence is, in the words of Kass and Raftery."""
    if log_bayes_factor is None or not math.isfinite(log_bayes_factor):
        return ""
    if log_bayes_factor >= DECISIVE:
        return "very strong"
    if log_bayes_factor >= STRONG:
        return "strong"
    return "positive" if log_bayes_factor >= 1.0 else "weak"


def in_words(effect: str) -> str:
    """Return the name of an effect as words."""
    return effect.replace("_", " ")


def effect_in_words(effect: Mapping[str, Any]) -> str:
    """Return an effect and its place: ``radiation to sink from box to bus``."""
    return f"{in_words(str(effect.get('effect')))} {place(effect.get('where') or {})}".strip()


def ambiguities(finding: Mapping[str, Any], name: Callable[[Mapping[str, Any]], str] = effect_in_words) -> list[str]:
    """Return what cannot be told from a finding and why, as sentences without full stop.

    Parameters
    ----------
    finding
        Of a report.
    name
        How an alternative is called.
    """
    own = (finding.get("evidence") or {}).get("log_bayes_factor")
    close: list[str] = []
    coarse: list[str] = []
    for other in finding.get("alternatives") or []:
        factor = other.get("log_bayes_factor")
        behind = 0.0 if own is None or factor is None else own - factor
        (close if behind < ALTERNATIVE_NATS else coarse).append(name(other))
    said = [f"The readings hardly tell it from {_first(close)}"] if close else []
    if coarse:
        explain = "this explains" if len(coarse) == 1 else "these explain"
        said.append(f"The declared network is too coarse to tell it from {_first(coarse)}: {explain} nearly as much")
    return said


def _first(names: Sequence[str]) -> str:
    """Return the first names of a list, joined, and how many others there are."""
    shown, more = names[:MOST_NAMED], len(names) - MOST_NAMED
    if more > 0:
        return f"{', '.join(shown)} and {more} other{'s' if more > 1 else ''}"
    return " or ".join(filter(None, (", ".join(shown[:-1]), shown[-1])))


def label_in_words(label: str) -> str:
    """Return a label such as ``input_gain(Q_box)`` as words; the names in brackets stay as they are."""
    name, bracket, rest = label.partition("(")
    return f"{in_words(name)} {bracket}{rest}".strip()


def place(where: Mapping[str, Any]) -> str:
    """Return where an effect acts: ``from px to space``, ``between px and box``, ``at tank by channel pitch``."""
    rest = dict(where)
    parts = []
    if "nodes" in rest:
        parts.append(f"between {' and '.join(map(str, rest.pop('nodes')))}")
    target = rest.pop("sink", None) or rest.pop("boundary", None)
    if "node" in rest:
        node = rest.pop("node")
        parts.append(f"at {node}" if target is None else f"from {node} to {target}")
    elif target is not None:
        parts.append(f"at {target}")
    if "channel" in rest:
        parts.append(f"{'by' if parts else 'of'} channel {rest.pop('channel')}")
    return " ".join([*parts, *(f"of {key} {value}" for key, value in rest.items())])


def number(value: Any, digits: int = 3) -> str:
    """Return a number with a few significant digits; a dash where there is none."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    rounded = float(f"{value:.{digits - 1}e}")
    decimals = digits - 1 - math.floor(math.log10(abs(rounded)))
    if decimals > 6 or decimals < -4:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·10{str(int(exponent)).translate(_RAISED)}".replace("-", "−")
    return f"{rounded:.{max(decimals, 0)}f}".replace("-", "−")


def kelvin(value: Any) -> str:
    """Return a deviation in K to the millikelvin, so that a column of them can be compared; a dash where there is none."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return "–"
    return f"{round(value, 3) + 0.0:.3f}".replace("-", "−")


def instant(value: Any) -> str:
    """Return an instant in the telemetry's own form: a date as it is, seconds with their unit."""
    return f"{value:.12g} s" if isinstance(value, int | float) else str(value)


def unit(plain: str) -> str:
    """Return a unit as it is printed: ``m²`` for ``m2``."""
    return plain.replace("m2", "m²").replace("^2", "²")


def with_spread(mean: Any, std: Any) -> str:
    """Return ``mean ± std``, both cut where the spread makes further digits meaningless; a date stays as it is."""
    if isinstance(mean, str):
        return f"{mean} ± {number(std, 2)}" if std else mean
    if not isinstance(mean, int | float):
        return "–"
    if not isinstance(std, int | float) or not math.isfinite(std) or std <= 0:
        return number(mean, 4)
    decimals = 1 - math.floor(math.log10(std))
    if decimals > 8 or decimals < -6:
        return f"{number(mean, 4)} ± {number(std, 2)}"
    return f"{round(mean, decimals):.{max(decimals, 0)}f} ± {round(std, decimals):.{max(decimals, 0)}f}".replace(
        "-", "−"
    )


def parameters(finding: Mapping[str, Any]) -> list[Json]:
    """Return the parameters of a finding as symbol, text and unit; a table becomes one row per entry."""
    rows = []
    for name, value in (finding.get("parameters") or {}).items():
        suffix = next((end for end in _UNITS if name.endswith(end)), "")
        mean, std = value.get("mean"), value.get("std")
        symbol, unit = name.removesuffix(suffix) or name, _UNITS.get(suffix, "")
        unit = "" if isinstance(mean, str) and not std else unit
        if isinstance(mean, list):
            stds = std if isinstance(std, list) else [None] * len(mean)
            text = "; ".join(with_spread(m, s) for m, s in zip(mean, stds, strict=False))
        elif value.get("unbounded_above"):
            text = f"{number(mean)} or more, unbounded above"
        else:
            text = with_spread(mean, std)
        rows.append({"symbol": symbol, "text": text, "unit": unit})
    return rows
