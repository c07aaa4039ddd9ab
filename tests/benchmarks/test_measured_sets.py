"""The benchmark on measured sets: its tables, its cache, and what becomes of a run that raises, dies or hangs."""

import math
import os
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from benchmarks import measured_run, measured_sets
from benchmarks.measured_run import Pair, Result, alone, cached, from_line, measure, supervised, to_line
from benchmarks.measured_splits import DATA, RUNS, SPLITS, Prepared, Split, published
from benchmarks.measured_table import FIGURES, figures_table, in_one_line, main_table, pairs_table, summary
from twin_core.errors import TelemetryError

GOOD = Result(
    "three blocks: 2 h, then 22 h",
    code="abc",
    deadline_s=60.0,
    seconds=12.3,
    peak_MB=300.0,
    verdict="effect_added",
    found="boundary_mix (room)",
    effects=("boundary_mix",),
    n_states=3,
    before_K=0.441,
    after_K=0.2446,
    masked={"frozen": 3},
    parameters={"G:a|b": (1.0, 0.1)},
)
WORSE = replace(
    GOOD, name="halogen lamp: 800 s, then 800 s", before_K=7.0, after_K=7.1, at_deadline=True, failures=("x",)
)
CRASHED = Result("Chandra power supply: flight a, then b", "abc", 60.0, error="LinAlgError: a | b", seconds=3.0)
PAIRED = replace(
    GOOD,
    name="temperature lab: step50_run1, then each other run",
    pairs=(Pair("sine50s_run1", 1.0, 0.5), Pair("step50_run2", 1.0, 1.5), Pair("step50_run3", error="ValueError: no")),
)


def test_one_table_with_every_kind_of_row() -> None:
    table = main_table([GOOD, WORSE, CRASHED], {GOOD.name: "linear fit 0.20"})
    rows = table.splitlines()[2:]
    assert rows[0] == (
        "| three blocks: 2 h, then 22 h | effect_added | boundary_mix (room) | 0.441 | 0.245 | linear fit 0.20 | 12"
        " | 3 frozen masked |"
    )
    assert "**worse after**; the deadline of 60 s ended the search; 1 candidate failed" in rows[1]
    assert "| crashed |" in rows[2] and rows[2].count("|") == rows[0].count("|")
    assert in_one_line(CRASHED).startswith("Chandra")


def test_pairs_mark_what_is_worse() -> None:
    line = pairs_table([GOOD, PAIRED]).splitlines()[2]
    assert line == "| step50_run1 | 1.00 → 0.50 | **1.00 → 1.50** | failed |"
    assert pairs_table([GOOD]) == ""


def test_the_summary_counts() -> None:
    hung = replace(CRASHED, hung=True)
    words = summary([GOOD, WORSE, CRASHED, hung, PAIRED])
    assert words == (
        "5 runs: 2 crashed, 1 hung (60 s over the deadline), 1 worse after; of 3 ordered pairs of runs 1 worse after."
    )


def test_figures_are_met_or_not() -> None:
    rows = {row.split(" | ")[0].strip("| "): row for row in figures_table([GOOD, WORSE, CRASHED, PAIRED]).splitlines()}
    assert rows["three blocks, 2 h"].endswith("| ≤ 0.25 K | 0.245 K | yes |")
    assert rows["three blocks, 2 h: the room named"].endswith("| yes |")
    assert rows["lamp, 800 s"].endswith("| 7.100 K | **no** |")
    assert rows["Chandra power supply"].endswith("| no answer | **no** |")
    assert rows["temperature lab, ordered pairs of runs"].endswith(
        "| 1 of 3 pairs worse, 1 not predicted, 0 runs without an answer | **no** |"
    )
    assert not any("FUNcube" in name for name in rows)


def test_every_figure_is_about_a_split() -> None:
    names = [split.name for split in SPLITS]
    assert len(set(names)) == len(names)
    for figure in FIGURES:
        assert any(name.startswith(figure.names) for name in names), figure.what


@pytest.mark.parametrize("result", [GOOD, CRASHED, PAIRED, replace(GOOD, scored_K=(2.0, 1.0))])
def test_a_result_survives_the_cache(result: Result) -> None:
    read = from_line(to_line(result))
    assert to_line(read) == to_line(result)
    assert isinstance(read.effects, tuple) and all(isinstance(pair, Pair) for pair in read.pairs)


def test_the_cache_holds_for_one_code_and_one_deadline(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    other, longer = replace(WORSE, code="def"), replace(PAIRED, deadline_s=300.0, seconds=100.0)
    rows = (GOOD, other, longer, replace(GOOD, verdict="unexplained"), CRASHED, replace(WORSE, name="cut"))
    path.write_text("".join(to_line(row) + "\n" for row in rows))
    known = cached(path, "abc", 60.0)
    assert set(known) == {GOOD.name, CRASHED.name, "cut"} and known[GOOD.name].verdict == "unexplained"
    # A search that ended in time needs no more of it; one that was cut might have gone on.
    assert set(cached(path, "abc", 300.0)) == {GOOD.name, CRASHED.name, PAIRED.name}
    assert set(cached(path, "abc", 10.0)) == {CRASHED.name}
    assert cached(path, "xyz", 60.0) == cached(tmp_path / "none", "abc", 60.0) == cached(None, "abc", 60.0) == {}


def _failing(error: Exception) -> Callable[[Path], Prepared]:
    def prepare(folder: Path) -> Prepared:
        raise error

    return prepare


@pytest.mark.parametrize(
    ("error", "words"),
    [(TelemetryError("a.csv: row 1:\n is wrong"), "TelemetryError: a.csv: row 1: is wrong"), (KeyError(), "KeyError")],
)
def test_a_run_that_raises_is_a_row(error: Exception, words: str) -> None:
    result = measure(Split("s", "folder", _failing(error), published("")), Path("nowhere"), "abc", 1.0)
    assert result.error == words and result.crashed and not result.hung and math.isnan(result.after_K)
    assert words in main_table([result], {})


def test_a_run_that_hangs_or_dies_is_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measured_run, "GRACE_S", 0.5)
    begun = time.perf_counter()
    hung = supervised("s", partial(time.sleep, 120.0), "abc", 0.5)  # type: ignore[arg-type]
    assert hung.hung and not hung.crashed and "ended" in hung.error and time.perf_counter() - begun < 60.0
    monkeypatch.setattr(measured_run, "GRACE_S", 60.0)
    died = supervised("s", partial(os._exit, 3), "abc", 1.0)  # type: ignore[arg-type]
    assert died.crashed and "exit 3" in died.error


def test_the_answer_of_another_process() -> None:
    assert alone(partial(math.hypot, 3.0, 4.0), 60.0) == 5.0


def test_only_what_the_cache_lacks_is_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("daisy_heating", "chandra_psmc"):
        (tmp_path / name).mkdir()
    ran: list[str] = []
    compiled: list[object] = []

    def run(name: str, work: object, code: str, deadline_s: float) -> Result:
        ran.append(name)
        return Result(name, code, deadline_s, error="ValueError: no" if "800" in name else "", verdict="unexplained")

    monkeypatch.setattr(measured_run, "supervised", run)
    monkeypatch.setattr(measured_run, "alone", lambda work, limit_s: compiled.append(work))
    arguments = ["--data", str(tmp_path), "--cache", str(tmp_path / "c.jsonl"), "--deadline", "5", "--only", "lamp"]
    measured_sets.main(arguments)
    measured_sets.main(arguments)
    printed = capsys.readouterr().out
    assert compiled == [measured_run._compile]  # once, before the runs that there were
    assert len(ran) == 2 and printed.count("2 runs: 1 crashed") == 2 and "saved" not in printed
    measured_sets.main([*arguments, "--fresh"])
    assert len(ran) == 4
    measured_sets.main([*arguments[:-1], "lamp", "blocks"])
    assert "three blocks: 2 h, then 22 h: left out, its data are not here" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        measured_sets.main([*arguments[:-1], "blocks"])


def test_the_code_is_told_by_its_commit() -> None:
    inside = ["git", "-C", str(measured_run.ROOT), "rev-parse", "--is-inside-work-tree"]
    if subprocess.run(inside, capture_output=True, check=False).returncode:
        assert measured_run.sources() == "unknown"
    else:
        assert measured_run.sources() == measured_run.sources() != "unknown"


@pytest.mark.parametrize("split", SPLITS, ids=lambda split: split.name)
def test_every_split_is_read(split: Split) -> None:
    folder = DATA / split.folder
    if not folder.is_dir():
        pytest.skip("the measured data are not part of the repository")
    prepared = split.prepare(folder)
    assert (prepared.holdout is None) == bool(prepared.held_out)
    assert set(split.scored) <= set(prepared.spec.sensors)
    assert not {record.name for record in prepared.records} & {record.name for record in prepared.held_out}
    assert split.reference(folder)


def test_every_ordered_pair_of_runs_is_there() -> None:
    assert sum(split.every_pair for split in SPLITS) == len(RUNS) == 13
