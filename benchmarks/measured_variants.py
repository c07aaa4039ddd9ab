"""Measured telemetry as others would bring it: windows, gaps, lost sensors, wrong guesses and missing parts, drawn at random.

``python -m benchmarks.measured_variants [--data DIR] [--first-seed N] [--count N] [--deadline S] [--processes N]`` closes the
loop on variants of the measured sets, each in a process of its own, and saves ``benchmarks/tables/measured_variants.md``. Nobody
knows what is missing there. What is asked is an answer, or one line on what is wrong with what was brought, and that the
corrected model predicts no worse than the declared one.
"""

import argparse
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.markdown import markdown_table, save_table
from benchmarks.measured_run import THREADS, Result, compile_all, measure, sources, supervised
from benchmarks.measured_sets import present
from benchmarks.measured_splits import DATA, ONE_OF_EACH, SPLITS, Prepared, Split
from twin_core.errors import ModelError, NoSolutionError, SpecError, TelemetryError, TwinError
from twin_core.network.model import build_network
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import dump_spec, load_spec
from twin_core.telemetry import Record

SETS = (
    "three blocks: 12 h, then 12 h",
    "three blocks, one film coefficient: 12 h, then 12 h",
    "temperature lab: a sine and a step, then all 11 others",
    *ONE_OF_EACH,
)
TITLE = "Measured telemetry as others would bring it"
FIRST_SEED, COUNT, DEADLINE_S = 1, 22, 120.0
SHORTEST_SHARE, FEWEST = 0.4, 150
"""Shortest window as a share of the record, and readings below which no record is thinned."""
GUESS_DECADES = 0.8
"""Guesses are off by up to so many decades either way."""
HELD_BACK = (0.2, 0.6)
REFUSALS = tuple(kind.__name__ for kind in (TelemetryError, ModelError, NoSolutionError, SpecError))
"""Errors that say in one line what is wrong with what was brought."""


@dataclass
class Brought:
    """What somebody brings: a declaration as plain data, and a record."""

    spec: dict[str, Any]
    record: Record


def a_window(rng: np.random.Generator, own: Brought) -> str:
    """Keep a part of the record."""
    n = own.record.time_s.size
    length = int(rng.uniform(SHORTEST_SHARE, 1.0) * n)
    start = int(rng.integers(n - length + 1))
    own.record = own.record.take(np.arange(start, start + length))
    return f"{length} of {n} samples"


def every_kth(rng: np.random.Generator, own: Brought) -> str:
    """Keep every second, third or fifth sample."""
    k = int(rng.choice([2, 3, 5]))
    if own.record.time_s.size // k < FEWEST:
        return ""
    own.record = own.record.take(np.arange(0, own.record.time_s.size, k))
    return f"one sample in {k}"


def holes(rng: np.random.Generator, own: Brought) -> str:
    """Lose one reading in twenty."""
    temperatures = [c for c, row in own.spec["channels"].items() if row["kind"] == "temperature"]
    lost = {
        channel: np.where(rng.random(column.size) < 0.05, np.nan, column)
        for channel, column in own.record.values.items()
        if channel in temperatures
    }
    own.record = replace(own.record, values={**own.record.values, **lost})
    return "5 % of readings missing"


def a_gap(rng: np.random.Generator, own: Brought) -> str:
    """Lose a tenth of the record within it."""
    n = own.record.time_s.size
    start = int(rng.uniform(0.2, 0.7) * n)
    own.record = own.record.take(np.r_[0:start, start + n // 10 : n])
    return "a gap of a tenth"


def wrong_guesses(rng: np.random.Generator, own: Brought) -> str:
    """Put every guess of the declaration off."""
    guessed = list(_with_guesses(own.spec))
    for row in guessed:
        row["guess"] = float(row["guess"] * 10.0 ** rng.uniform(-GUESS_DECADES, GUESS_DECADES))
    return "guesses off" if guessed else ""


def _with_guesses(item: Any) -> Iterator[dict[str, Any]]:
    """Yield every mapping within a declaration that holds a guess."""
    for inner in item.values() if isinstance(item, dict) else item if isinstance(item, list) else ():
        yield from _with_guesses(inner)
    if isinstance(item, dict) and "guess" in item:
        yield item


def without_a_load(rng: np.random.Generator, own: Brought) -> str:
    """Leave a load out; its channel stays as an auxiliary one, or goes."""
    loads = own.spec["loads"]
    if len(loads) < 2:
        return ""
    gone = loads.pop(int(rng.integers(len(loads))))
    if all(load["channel"] != gone["channel"] for load in loads):
        own.spec["channels"].pop(gone["channel"], None)
        if rng.random() < 0.5:
            own.spec["channels"][gone["channel"]] = {"kind": "auxiliary"}
    return f"no load {gone['channel']} at {gone['node']}"


def without_a_sensor(rng: np.random.Generator, own: Brought) -> str:
    """Lose a sensor."""
    sensed = [node for node in own.spec["nodes"] if "sensor" in node]
    if len(sensed) < 2:
        return ""
    node = sensed[int(rng.integers(len(sensed)))]
    own.spec["channels"].pop(node.pop("sensor"))
    return f"no sensor at {node['id']}"


def without_a_conductor(rng: np.random.Generator, own: Brought) -> str:
    """Leave a conductor out."""
    conductors = own.spec["conductors"]
    if len(conductors) < 3:
        return ""
    return "no conductor " + "-".join(conductors.pop(int(rng.integers(len(conductors))))["between"])


def an_unknown_boundary(rng: np.random.Generator, own: Brought) -> str:
    """Do not measure a boundary: its mean is guessed."""
    measured = [name for name, row in own.spec.get("boundaries", {}).items() if "channel" in row]
    if not measured:
        return ""
    name = str(rng.choice(measured))
    channel = own.spec["boundaries"][name]["channel"]
    own.spec["boundaries"][name] = {"guess_K": float(np.nanmean(own.record.channel(channel)))}
    own.spec["channels"].pop(channel)
    return f"{name} not measured"


def free_gains(rng: np.random.Generator, own: Brought) -> str:
    """Give every power that is taken as recorded a gain to be calibrated."""
    trusted = [load for load in own.spec["loads"] if "gain" not in load and "table" not in load]
    for load in trusted:
        load["gain"] = {"guess": 1.0}
    return "gains free" if trusted else ""


CHANGES: tuple[tuple[float, Callable[[np.random.Generator, Brought], str]], ...] = (
    (1.0, a_window),
    (0.4, every_kth),
    (0.3, holes),
    (0.25, a_gap),
    (0.6, wrong_guesses),
    (0.35, without_a_load),
    (0.3, without_a_sensor),
    (0.3, without_a_conductor),
    (0.2, an_unknown_boundary),
    (0.3, free_gains),
)
"""How often each is drawn; each says what it did, or nothing where it could not."""


def set_of(seed: int) -> Split:
    """Return the split of which a seed draws a variant."""
    name = SETS[seed % len(SETS)]
    return next(split for split in SPLITS if split.name == name)


def variant(seed: int, split: Split, data: Path) -> tuple[str, Prepared]:
    """Return the set with what was changed, in words, and what a closed loop is given.

    A change that would leave no declaration is left out.
    """
    rng = np.random.default_rng(seed)
    prepared = split.prepare(data / split.folder)
    records = [*prepared.records, *prepared.held_out]
    own = Brought(dump_spec(prepared.spec), records[int(rng.integers(len(records)))])
    told = [Path(own.record.name).stem]
    for share, change in CHANGES:
        if rng.random() < share:
            other = deepcopy(own)
            words = change(rng, other)
            if words and _declared(other.spec) is not None:
                own = other
                told.append(words)
    spec = _declared(own.spec)
    assert spec is not None, "a declaration of the sets is one"
    given = Prepared(spec, [own.record], holdout=float(rng.uniform(*HELD_BACK)))
    return f"{split.folder}: {', '.join(told)}", given


def _declared(spec: dict[str, Any]) -> TwinSpec | None:
    """Return the declaration, None where it is none."""
    try:
        declared = load_spec(deepcopy(spec))
        build_network(declared)
    except TwinError:
        return None
    return declared


def _measure(seed: int, data: Path, code: str, deadline_s: float) -> Result:
    name, prepared = variant(seed, set_of(seed), data)
    own = Split(name, "", lambda folder: prepared, lambda folder: "")
    return measure(own, data, code, deadline_s)


def in_one_line(seed: int, result: Result) -> str:
    """Return what came of a variant."""
    errors = result.error or f"{result.verdict}: {result.found} | {result.before_K:.3f} -> {result.after_K:.3f}"
    return f"{seed} {result.name} | {errors} | {result.seconds:.0f} s{' WORSE' if result.is_worse else ''}"


def table(results: dict[int, Result]) -> str:
    """Return how many variants came to what, and each of them, as markdown."""
    told = list(results.values())
    refused = [r for r in told if r.error.startswith(REFUSALS)]
    counts = [
        ["crashed", sum(r.crashed for r in told) - len(refused)],
        ["hung", sum(r.hung for r in told)],
        ["refused in one line", len(refused)],
        ["a finding", sum(r.verdict == "effect_added" for r in told)],
        ["worse after", sum(r.is_worse for r in told)],
    ]
    rows = [
        [
            str(seed),
            r.name,
            r.error or f"{r.verdict}: {r.found}" + (" (at the deadline)" if r.at_deadline else ""),
            *(
                ["", ""]
                if r.error
                else [f"{r.before_K:.3f}", f"**{r.after_K:.3f}**" if r.is_worse else f"{r.after_K:.3f}"]
            ),
            f"{r.seconds:.0f}",
        ]
        for seed, r in sorted(results.items())
    ]
    summary = markdown_table(["what came of it", "variants"], [[what, f"{n} of {len(told)}"] for what, n in counts])
    return summary + "\n" + markdown_table(["seed", "what was brought", "found", "before, K", "after, K", "s"], rows)


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the measured sets")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--count", type=int, default=COUNT, help="variants, one seed each")
    parser.add_argument("--deadline", type=float, default=DEADLINE_S, metavar="S", help="seconds for each search")
    parser.add_argument("--processes", type=int, default=1, metavar="N", help="searches at a time")
    given = parser.parse_args(words)
    os.environ.update(dict.fromkeys(THREADS, "1"))  # the processes that are started below inherit it
    there = present([split for split in SPLITS if split.name in SETS], given.data)
    seeds = [s for s in range(given.first_seed, given.first_seed + given.count) if set_of(s) in there]
    if not seeds:
        return
    code, results = sources(), dict[int, Result]()
    compile_all()
    with ThreadPoolExecutor(given.processes) as pool:
        running = {
            pool.submit(
                supervised,
                f"seed {seed}",
                partial(_measure, seed, given.data, code, given.deadline),
                code,
                given.deadline,
            ): seed
            for seed in seeds
        }
        for future in as_completed(running):
            seed = running[future]
            results[seed] = future.result()
            print(in_one_line(seed, results[seed]), flush=True)
    if (given.first_seed, given.count) == (FIRST_SEED, COUNT):
        save_table("measured_variants", TITLE, table(results), "benchmarks.measured_variants")
    else:
        print(table(results))


if __name__ == "__main__":
    main()
