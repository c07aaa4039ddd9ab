"""What the closed loop did on measured sets, as tables: every split, every pair of runs, the figures to reach, a summary."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from benchmarks.markdown import markdown_table
from benchmarks.measured_run import GRACE_S, Pair, Result
from benchmarks.measured_splits import HOMES, RUNS

MANY_MB = 2000.0
HEADER = ("set", "verdict", "found", "before, K", "after, K", "others, K", "seconds", "notes")


def _cell(text: str) -> str:
    return text.replace("|", "/").replace("\n", " ")


def notes(result: Result) -> str:
    """Return what a reader of a result should know beside its numbers."""
    told = []
    if result.is_worse:
        told.append("**worse after**")
    if result.scored_K is not None:
        told.append(f"scored sensors {result.scored_K[0]:.2f} → {result.scored_K[1]:.2f}")
    if result.pairs:
        worse, failed = (
            sum(map(bool, each)) for each in zip(*((p.is_worse, p.error) for p in result.pairs), strict=True)
        )
        told += [f"**worse after in {worse} of {len(result.pairs)} runs**"] if worse else []
        told += [f"**{failed} runs cannot be predicted**"] if failed else []
    if result.at_deadline:
        told.append(f"the deadline of {result.deadline_s:.0f} s ended the search")
    if result.failures:
        n = len(result.failures)
        told.append(f"{n} candidate{'s' * (n > 1)} failed")
    told += [f"{samples} {reason} masked" for reason, samples in (result.masked or {}).items()]
    if result.peak_MB > MANY_MB:
        told.append(f"{result.peak_MB / 1000.0:.1f} GB")
    return "; ".join(told)


def row(result: Result, others: str) -> list[str]:
    """Return the row of a result; one that failed shows its error."""
    seconds = f"{result.seconds:.0f}" if math.isfinite(result.seconds) else ""
    if result.error:
        how = "hung" if result.hung else "crashed"
        return [result.name, how, "", "", "", others, seconds, _cell(f"**{how}**: {result.error}")]
    numbers = [f"{result.before_K:.3f}", f"{result.after_K:.3f}"]
    return [result.name, result.verdict, _cell(result.found), *numbers, others, seconds, _cell(notes(result))]


def in_one_line(result: Result) -> str:
    """Return a result in one line, for those who wait."""
    return " | ".join(cell for cell in row(result, "") if cell)


def main_table(results: Sequence[Result], others: Mapping[str, str]) -> str:
    """Return the table of every split; ``others`` are the references by the splits' names."""
    return markdown_table(HEADER, [row(result, others.get(result.name, "")) for result in results])


def pairs_table(results: Sequence[Result]) -> str:
    """Return the held-out error of every ordered pair of runs, the trained one in its row; empty without such results."""
    rows = [result for result in results if result.pairs]
    if not rows:
        return ""
    runs = sorted({pair.run for result in rows for pair in result.pairs})
    table = []
    for result in rows:
        of = {pair.run: pair for pair in result.pairs}
        name = result.name.split(": ", 1)[-1].split(", then", 1)[0]
        table.append([name, *(_pair_cell(of[run]) if run in of else "" for run in runs)])
    return markdown_table(["trained on", *runs], table)


def _pair_cell(pair: Pair) -> str:
    if pair.error:
        return "failed"
    words = f"{pair.before_K:.2f} → {pair.after_K:.2f}"
    return f"**{words}**" if pair.is_worse else words


@dataclass(frozen=True)
class Figure:
    """A figure to reach.

    Attributes
    ----------
    what, to_reach
        In words.
    names
        The splits that it is about, by the beginning of their names.
    measured
        Returns from their results what was measured, in words, and whether that is enough; None where a reader must judge.
    """

    what: str
    to_reach: str
    names: tuple[str, ...]
    measured: Callable[[Sequence[Result]], tuple[str, bool | None]]


def _at_most(limit: float, value: Callable[[Result], float], unit: str = "K") -> Callable[..., tuple[str, bool | None]]:
    """Return a measure: the least that any of the results reaches."""

    def measured(results: Sequence[Result]) -> tuple[str, bool | None]:
        best = min(map(value, results))
        return f"{best:.{3 if unit == 'K' else 0}f} {unit}", best <= limit

    return measured


def _after_K(result: Result) -> float:
    return result.after_K


def _named(effects: Sequence[str], *, wanted: bool) -> Callable[[Sequence[Result]], tuple[str, bool | None]]:
    """Return a measure: whether any of the effects is found in every result, or in none."""

    def measured(results: Sequence[Result]) -> tuple[str, bool | None]:
        found = [any(effect in result.effects for effect in effects) for result in results]
        return "; ".join(result.found for result in results), all(found) if wanted else not any(found)

    return measured


def _none_worse(results: Sequence[Result]) -> tuple[str, bool | None]:
    worse = sum(result.is_worse for result in results)
    failed = sum(bool(result.error) for result in results)
    return f"{worse} of {len(results)} worse, {failed} without an answer", not worse and not failed


def _no_pair_worse(results: Sequence[Result]) -> tuple[str, bool | None]:
    pairs = [pair for result in results for pair in result.pairs]
    worse, failed = sum(pair.is_worse for pair in pairs), sum(bool(pair.error) for pair in pairs)
    lost = sum(bool(result.error) for result in results)
    words = f"{worse} of {len(pairs)} pairs worse, {failed} not predicted, {lost} runs without an answer"
    return words, not worse and not failed and not lost


def _states(results: Sequence[Result]) -> tuple[str, bool | None]:
    """Return how many states each home has, beside the published number."""
    published = {f"Dutch home {i}": states for i, (_, states) in HOMES.items()}
    told, reached = [], []
    for result in results:
        home = result.name.split(":")[0]
        told.append(f"{result.n_states} of {published[home]}")
        reached.append(result.n_states >= published[home])
    return ", ".join(told), any(reached)


def _told_apart(results: Sequence[Result]) -> tuple[str, bool | None]:
    """Return by how many deviations black and silver coupons differ, at most, in what they absorb and lose."""
    told = []
    for place in ("chassis", "panel"):
        apart = 0.0
        for name in ("gain:orbit.sun_mean|{}", "gain:orbit.albedo_mean|{}", "G:{}|space"):
            pair = [(results[0].parameters or {}).get(name.format(f"{c}_{place}")) for c in ("black", "silver")]
            if pair[0] is not None and pair[1] is not None:
                (black, black_std), (silver, silver_std) = pair[0], pair[1]
                apart = max(apart, abs(black - silver) / math.hypot(black_std, silver_std))
        told.append((place, apart))
    words = ", ".join(f"on the {place} by {apart:.1f} deviations" for place, apart in told)
    return words, all(apart >= 2.0 for _, apart in told)


FROZEN = {"FUNcube": 227, "Dutch home 3": 10}
"""Frozen readings that are there: rows that the ground station held; an indoor sensor that reads 18.88 degC eleven times from
2021-11-04T11:00 on, with the heater's 41.1 beside it, and moves by 0.05 from sample to sample before and after."""


def _frozen(results: Sequence[Result]) -> tuple[str, bool | None]:
    """Return how many frozen rows were masked where there are some, and how many elsewhere, where there are none."""
    counts = {r.name: (r.masked or {}).get("frozen", 0) for r in results}
    there = {place: [n for name, n in counts.items() if name.startswith(place)] for place in FROZEN}
    elsewhere = sum(n for name, n in counts.items() if not name.startswith(tuple(FROZEN)))
    told = [f"{place}: {found[0]} of {FROZEN[place]}" for place, found in there.items() if found]
    right = all(abs(n - FROZEN[place]) <= 2 for place, found in there.items() for n in found)
    return f"{', '.join(told)}; elsewhere {elsewhere}", right and elsewhere == 0


BOUNDARY_EFFECTS = ("boundary_offset", "boundary_lag", "boundary_mix")
BLOCKS, LAB, HOUSE = "three blocks: 2 h", "temperature lab: same session", "FlexHouse, one node"
HOME = "Dutch home"
PAIRS_OF_RUNS = tuple(f"temperature lab: {run}, then each" for run in RUNS)
SEVERAL_RUNS = tuple(f"temperature lab: {words}" for words in ("same", "two", "a fast", "a sine", "first", "second"))
FIGURES = (
    Figure("three blocks, 2 h", "≤ 0.25 K", (BLOCKS,), _at_most(0.25, _after_K)),
    Figure("three blocks, 2 h: the room named", "an effect at it", (BLOCKS,), _named(BOUNDARY_EFFECTS, wanted=True)),
    Figure("temperature lab, same session", "≤ 0.20 K", (LAB,), _at_most(0.20, _after_K)),
    Figure("temperature lab, splits into several runs", "none worse after", SEVERAL_RUNS, _none_worse),
    Figure("temperature lab, ordered pairs of runs", "none worse after", PAIRS_OF_RUNS, _no_pair_worse),
    Figure("lamp, 800 s", "≤ 3.0 K", ("halogen lamp: 800",), _at_most(3.0, _after_K)),
    Figure("Chandra power supply", "≤ 2.8 K", ("Chandra",), _at_most(2.8, _after_K)),
    Figure("Chandra power supply, the loop", "≤ 60 s", ("Chandra",), _at_most(60.0, lambda r: r.seconds, "s")),
    Figure(
        "FUNcube-1, solar panels", "≤ 2.2 K", ("FUNcube",), _at_most(2.2, lambda r: (r.scored_K or (0.0, math.inf))[1])
    ),
    Figure("FUNcube-1, black and silver told apart", "2 deviations", ("FUNcube",), _told_apart),
    Figure(
        "FUNcube-1, T⁴", "not claimed", ("FUNcube",), _named(("radiation_to_sink", "radiative_exchange"), wanted=False)
    ),
    Figure("frozen rows", "those that are there, ± 2; elsewhere 0", ("",), _frozen),
    Figure("FlexHouse, declared as one node", "≤ 0.73 K", (HOUSE,), _at_most(0.73, _after_K)),
    Figure("FlexHouse, declared with its envelope", "≤ 0.73 K", ("FlexHouse, room",), _at_most(0.73, _after_K)),
    Figure("every set", "none worse after", ("",), _none_worse),
    Figure("FlexHouse, hidden masses", "named", (HOUSE,), _named(("hidden_mass",), wanted=True)),
    Figure("three homes", "never worse after", (HOME,), _none_worse),
    Figure("three homes, number of states", "the published one in one", (HOME,), _states),
    Figure(
        "three homes, findings",
        "nothing invented",
        (HOME,),
        lambda results: ("; ".join(result.found for result in results), None),
    ),
)


def figures_table(results: Sequence[Result]) -> str:
    """Return what was to be reached beside what was measured; figures of splits that were not run are left out."""
    table = []
    for figure in FIGURES:
        concerned = [result for result in results if result.name.startswith(figure.names)]
        answered = [result for result in concerned if not result.error]
        if not concerned or (figure.measured is _frozen and not any(r.name.startswith("FUNcube") for r in answered)):
            continue
        counts_failures = figure.measured in (_none_worse, _no_pair_worse)
        if answered or counts_failures:
            words, met = figure.measured(concerned if counts_failures else answered)
        else:
            words, met = "no answer", False
        table.append([figure.what, figure.to_reach, _cell(words), {True: "yes", False: "**no**", None: ""}[met]])
    return markdown_table(["figure", "to reach", "measured", "met"], table)


def summary(results: Sequence[Result]) -> str:
    """Return how many runs there were, and how many crashed, hung or ended worse."""
    pairs = [pair for result in results for pair in result.pairs]
    counts = {
        "crashed": sum(result.crashed for result in results) + sum(bool(pair.error) for pair in pairs),
        f"hung ({GRACE_S:.0f} s over the deadline)": sum(result.hung for result in results),
        "worse after": sum(result.is_worse for result in results),
    }
    told = ", ".join(f"{n} {what}" for what, n in counts.items())
    of_pairs = f"; of {len(pairs)} ordered pairs of runs {sum(p.is_worse for p in pairs)} worse after" if pairs else ""
    return f"{len(results)} runs: {told}{of_pairs}."
