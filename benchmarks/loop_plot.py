"""The closed loop over its suite at a glance: errors, where the bands lie about the truth, and seconds."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import norm

from benchmarks.bands import Z90, Row, bands
from benchmarks.markdown import TABLES

COLOURS = {
    "network": "tab:blue",
    "fem": "tab:orange",
    "fem2": "tab:brown",
    "two": "tab:purple",
    "three": "tab:pink",
    "clean": "tab:green",
    "clean_fem2": "tab:olive",
    "outside": "tab:red",
}


def save_plot(rows: Sequence[Row], name: str) -> str:
    """Save ``benchmarks/tables/NAME.svg`` from the rows of a run; return its place in a table's text."""
    figure = Figure((11.0, 3.8), layout="constrained")
    errors, spread, seconds = figure.subplots(1, 3)
    for group, colour in COLOURS.items():
        own = [row for row in rows if row["group"] == group]
        if not own:
            continue
        before, after = (np.array([row[key] / row["noise_K"] for row in own]) for key in ("before_K", "after_K"))
        errors.loglog(before, after, "o", color=colour, alpha=0.5, markersize=4, label=group)
        taken = np.sort([row["seconds"] for row in own])
        seconds.semilogx(taken, np.arange(1, taken.size + 1) / taken.size, color=colour, label=group)
    low, high = errors.get_xlim()
    errors.loglog([low, high], [low, high], "k:", linewidth=0.8)
    errors.set(xlabel="held-out error before, of the noise", ylabel="after")
    seconds.set(xlabel="seconds of a case", ylabel="share of the cases")
    z = [
        band.z for row in rows if row["group"] in ("network", "fem", "fem2") for band in bands(row["truth"], row["own"])
    ]
    at = np.linspace(-5.0, 5.0, 201)
    spread.hist(np.clip(z, -5.0, 5.0), bins=np.linspace(-5.0, 5.0, 41), density=True, color="tab:blue", alpha=0.5)
    spread.plot(at, norm.pdf(at), "k", linewidth=0.8)
    for edge in (-Z90, Z90):
        spread.axvline(edge, color="k", linestyle=":", linewidth=0.8)
    spread.set(xlabel="(estimate - truth) / standard deviation", ylabel="density", yticks=[])
    errors.legend()
    figure.savefig(TABLES / f"{name}.svg", metadata={"Date": None})
    return f"![Errors, parameters about the truth, seconds]({name}.svg)"
