"""Tables of the closed loop over the suite: per effect, per group, and the targets with what was measured."""

from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.bands import Row, bands
from benchmarks.loop_cases import GROUPS
from benchmarks.loop_plot import save_plot
from benchmarks.markdown import markdown_table, save_table


def save_tables(rows: Sequence[Row], name: str = "loop") -> None:
    """Save ``benchmarks/tables/NAME.md`` and its plot from the rows of a run."""
    failed = [row for row in rows if "error" in row]
    good = [row for row in rows if "error" not in row]
    parts = [
        "## Targets",
        targets(good),
        save_plot(good, name),
        "## By effect",
        by_effect(good),
        "## Worst cases",
        worst(good),
    ]
    note = "".join(f"\nFailed: {row['task']}: {row['error']}" for row in failed)
    save_table(name, "Closed loop over seeded spacecraft", "\n\n".join(parts), "benchmarks.loop", note)


def _share(rows: Sequence[Row], test: Callable[[Row], bool]) -> str:
    n = sum(bool(test(row)) for row in rows)
    return f"{100 * n / len(rows):.1f} % ({n}/{len(rows)})" if rows else "none run"


def _median(values: Sequence[float], form: str = "{:.2f}") -> str:
    finite = [v for v in values if v is not None and np.isfinite(v)]
    return form.format(float(np.median(finite))) if finite else "none run"


def _quantile(values: Sequence[float], share: float) -> str:
    return f"{np.quantile(values, share):.1f}" if values else "none run"


def _seconds(rows: Sequence[Row]) -> list[float]:
    return [row["seconds"] for row in rows]


def targets(rows: Sequence[Row]) -> str:
    """Return the table of what was to be reached."""
    groups = {name: [r for r in rows if r["group"] == name] for name in GROUPS}
    worlds = {"network truth": "network", "finite elements": "fem", "second finite-element world": "fem2"}
    named = [row for group in worlds.values() for row in groups[group]]
    onsets = [r["onset_error"] for r in named if r["onset_error"] is not None]
    bands = [c for r in named for c in in_band(r)]
    ratios = [r["after_K"] / r["known_K"] for r in named if r["known_K"]]
    table = [
        *(
            [f"right effect and place first, {world}", least, _share(groups[group], lambda r: r["first"])]
            for (world, group), least in zip(worlds.items(), (">= 98 %", ">= 95 %", ">= 95 %"), strict=True)
        ),
        *(
            [f"within the stated alternatives, {world}", ">= 99 %", _share(groups[group], lambda r: r["listed"])]
            for world, group in worlds.items()
        ),
        *(
            [f"an extra name beside the right one, {world}", "0", _share(groups[group], has_extra_name)]
            for world, group in worlds.items()
        ),
        *(
            [f"{group} effects: all right and nothing else", least, _share(groups[group], is_complete)]
            for group, least in (("two", ">= 85 %"), ("three", ">= 70 %"))
        ),
        *(
            [
                f"{group} effects: at least the larger one",
                ">= 97 %",
                _share(groups[group], lambda r: r["own"] is not None),
            ]
            for group in ("two", "three")
        ),
        *(
            [f"{group} effects: a wrong name", "<= 2 %", _share(groups[group], lambda r: r["n_wrong"] > 0)]
            for group in ("two", "three")
        ),
        ["findings on clean records", "<= 1 %", _share(groups["clean"], lambda r: bool(r["findings"]))],
        [
            "findings on healthy finite elements with a misfit",
            "<= 1 %",
            _share(groups["clean_fem2"], lambda r: bool(r["findings"])),
        ],
        ["a wrong name outside the vocabulary", "0", _share(groups["outside"], has_wrong_name)],
        ["held-out error over that with the effect known, median", "<= 1.02", _median(ratios)],
        ["held-out error worse than before", "0", _share(rows, lambda r: r["after_K"] > 1.001 * r["before_K"])],
        ["onset within 2 % of the record", "", _share(onsets, lambda e: e <= 0.02)],  # type: ignore[arg-type]
        ["90 % bands that hold the true parameter", "87 to 93 %", _share(bands, bool)],  # type: ignore[arg-type]
        *(
            [f"seconds per case, {world}, median", most, _median(_seconds(groups[group]), "{:.1f}")]
            for (world, group), most in zip(worlds.items(), ("<= 4", "<= 8", "<= 8"), strict=True)
        ),
        ["seconds per case with one effect, 95 % of the cases", "<= 20", _quantile(_seconds(named), 0.95)],
    ]
    return markdown_table(["measure", "to reach", "measured"], table)


def has_wrong_name(row: Row) -> bool:
    """Return whether an effect of the vocabulary was named: a learned heat flow names nothing."""
    return any(f["effect"] != "learned_heat_flow" for f in row["findings"])


def has_extra_name(row: Row) -> bool:
    """Return whether what is hidden was named and something else too."""
    return row["n_right"] > 0 and row["n_wrong"] > 0


def is_complete(row: Row) -> bool:
    """Return whether everything that is hidden was named and nothing else."""
    return row["n_right"] == row["n_hidden"] and row["n_wrong"] == 0


def in_band(row: Row) -> list[bool]:
    """Return for every true parameter of a found effect whether its 90 % band holds it."""
    return [band.holds for band in bands(row["truth"], row["own"])]


def by_effect(rows: Sequence[Row]) -> str:
    """Return one line per group and effect."""
    keys = dict.fromkeys((row["group"], row["effect"]) for row in rows)
    table = []
    for group, effect in keys:
        own = [row for row in rows if (row["group"], row["effect"]) == (group, effect)]
        table.append(
            [
                group,
                effect or "nothing",
                str(len(own)),
                str(sum(r["first"] for r in own)),
                str(sum(r["listed"] for r in own)),
                str(sum(bool(r["findings"]) for r in own)),
                _median([r["before_K"] for r in own], "{:.3f}"),
                _median([r["after_K"] for r in own], "{:.3f}"),
                _median([r["known_K"] for r in own if r["known_K"] is not None], "{:.3f}"),
                _median([r["seconds"] for r in own], "{:.1f}"),
            ]
        )
    header = [
        "truth",
        "hidden",
        "cases",
        "first",
        "listed",
        "any finding",
        "before, K",
        "after, K",
        "effect known, K",
        "s",
    ]
    return markdown_table(header, table)


def worst(rows: Sequence[Row], n: int = 10) -> str:
    """Return the worst cases with what was said: the missed ones, then those whose held-out error stays furthest above
    the noise."""

    def missed(row: Row) -> bool:
        """Whether it was named wrongly or not at all, or healthy and named."""
        return bool(row["findings"]) if row["n_hidden"] == 0 else row["n_right"] < row["n_hidden"]

    inside = [r for r in rows if r["group"] != "outside"]
    inside.sort(key=lambda r: (not missed(r), -r["after_K"] / r["noise_K"]))
    table = []
    for r in inside[:n]:
        said = "; ".join(f"{f['effect']} {f['where']}" for f in r["findings"]) or r["verdict"]
        errors = [f"{r[key] or float('nan'):.3f}" for key in ("before_K", "after_K", "known_K")]
        table.append([r["task"], str(r["where"]), said, *errors, f"{r['noise_K']:.3f}"])
    return markdown_table(["case", "place", "said", "before, K", "after, K", "effect known, K", "noise, K"], table)
