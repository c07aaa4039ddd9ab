"""One closed loop on one measured split, in a process of its own that is ended where it takes too long."""

import contextlib
import hashlib
import json
import math
import os
import resource
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from functools import partial
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measured_splits import ROOT, SPLITS, Prepared, Split
from benchmarks.network_cases import network_case
from twin_core.closed_loop import ClosedLoop, close_loop
from twin_core.holdout import predict, split_burn_in
from twin_core.network.screened import screened, segments
from twin_core.telemetry import Record

GRACE_S = 60.0
"""A run that goes on so long after its deadline hangs, and is ended."""
READY_S = 300.0
"""A process that has not imported what it needs by then, on however busy a machine, is not counted on."""
COMPILING_S = 600.0
WORSE = 1.001
"""The held-out error is worse than before beyond this factor."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
SOURCES = ("twin_core", "examples", "benchmarks/measured_splits.py", "benchmarks/measured_run.py")
"""What a result depends on."""


@dataclass(frozen=True)
class Pair:
    """The held-out error of one record of the hold-out; NaN with an ``error`` where it cannot be predicted."""

    run: str
    before_K: float = math.nan
    after_K: float = math.nan
    error: str = ""

    @property
    def is_worse(self) -> bool:
        """Whether the corrected model predicts it worse than the declared one."""
        return self.after_K > WORSE * self.before_K


@dataclass(frozen=True)
class Result:
    """What came of one split.

    Attributes
    ----------
    name, code, deadline_s
        The split, the state of the sources, and the deadline of the search: a result is that of all three.
    error
        Why there is no answer, in one line; empty where there is one.
    hung
        Whether it was ended because it took too long.
    seconds, peak_MB
        Wall time of the closed loop, and the largest resident memory of one of its processes.
    verdict, found, effects, n_states
        The report's verdict; findings in words; their names; nodes, hidden masses and lagging sensors.
    before_K, after_K
        Held-out rmse of all sensors.
    scored_K
        The same of the split's ``scored`` sensors alone, before and after; None where it has none.
    at_deadline
        Whether the deadline ended the search.
    failures
        Candidates whose arithmetic failed, in words.
    masked
        Samples that were no readings, by reason: the most of any channel.
    parameters
        Declared parameters of the corrected model: mean and standard deviation.
    pairs
        Each record of the hold-out on its own, where the split asks for it.
    """

    name: str
    code: str
    deadline_s: float
    error: str = ""
    hung: bool = False
    seconds: float = math.nan
    peak_MB: float = math.nan
    verdict: str = ""
    found: str = ""
    effects: tuple[str, ...] = ()
    n_states: int = 0
    before_K: float = math.nan
    after_K: float = math.nan
    scored_K: tuple[float, float] | None = None
    at_deadline: bool = False
    failures: tuple[str, ...] = ()
    masked: Mapping[str, int] | None = None
    parameters: Mapping[str, tuple[float, float]] | None = None
    pairs: tuple[Pair, ...] = ()

    @property
    def is_worse(self) -> bool:
        """Whether the corrected model predicts the hold-out worse than the declared one, or not at all."""
        return self.verdict != "" and not self.after_K <= WORSE * self.before_K

    def holds_for(self, deadline_s: float) -> bool:
        """Whether a run with this deadline would have come to the same: a search that ended in time needs no more."""
        in_time = not self.hung and not self.at_deadline and self.seconds <= min(self.deadline_s, deadline_s)
        return self.deadline_s == deadline_s or in_time

    @property
    def crashed(self) -> bool:
        """Whether it ended with an error of its own."""
        return bool(self.error) and not self.hung


def to_line(result: Result) -> str:
    """Return a result as one line of JSON."""
    return json.dumps(asdict(result))


def from_line(line: str) -> Result:
    """Read what :func:`to_line` wrote."""
    row = json.loads(line)
    lists = {key: tuple(row[key]) for key in ("effects", "failures")}
    scored = None if row["scored_K"] is None else tuple(row["scored_K"])
    return Result(**row | lists | {"scored_K": scored, "pairs": tuple(Pair(**pair) for pair in row["pairs"])})


def sources() -> str:
    """Return the commit that last changed what results depend on, and a digest of what differs from it."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(ROOT), *words, "--", *SOURCES]
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()

    changed = git("diff", "HEAD")
    digest = f"-{hashlib.sha256(changed.encode()).hexdigest()[:8]}" if changed else ""
    return (git("log", "-1", "--format=%h") or "unknown") + digest


def cached(path: Path | None, code: str, deadline_s: float) -> dict[str, Result]:
    """Return the results in a file of JSON lines that hold for this code and deadline, by name; the last one counts."""
    if path is None or not path.exists():
        return {}
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    results = [from_line(line) for line in lines]
    return {r.name: r for r in results if r.code == code and r.holds_for(deadline_s)}


def _one_line(error: BaseException) -> str:
    words = " ".join(str(error).split())
    return f"{type(error).__name__}: {words}" if words else type(error).__name__


def in_words(findings: Iterable[Mapping[str, Any]]) -> str:
    """Return what was found, with what the data cannot tell it from."""
    told = []
    for row in findings:
        where = ", ".join("-".join(v) if isinstance(v, list) else str(v) for v in row["where"].values())
        others = sorted({other["effect"] for other in row["alternatives"]} - {row["effect"]})
        told.append(f"{row['effect']} ({where})" + (f", or {', '.join(others)}" if others else ""))
    return "; ".join(told) or "none"


def _rmse_K(errors: Sequence[np.ndarray[Any, Any]]) -> float:
    return float(np.sqrt(np.nanmean(np.concatenate([part.ravel() for part in errors]) ** 2)))


def _pair(loop: ClosedLoop, prepared: Prepared, record: Record) -> Pair:
    """Return the held-out errors of one record of the hold-out."""
    try:
        parts = segments(prepared.spec, [screened(prepared.spec, record)])
        held = [split_burn_in(part, prepared.burn_in_s) for part in parts]
        errors = [
            _rmse_K([done.measured_K - done.predicted_K for done in (predict(model, h) for h in held)])
            for model in (loop.before_model, loop.model)
        ]
    except Exception as error:
        return Pair(record.name, error=_one_line(error))
    return Pair(record.name, *errors)


def _scored(report: Mapping[str, Any], sensors: Sequence[str]) -> tuple[float, float] | None:
    if not sensors:
        return None
    before, after = (
        math.sqrt(sum(report[part]["per_sensor"][s]["rmse_K"] ** 2 for s in sensors) / len(sensors))
        for part in ("before", "after")
    )
    return before, after


def result_of(split: Split, prepared: Prepared, loop: ClosedLoop, blank: Result) -> Result:
    """Return the result of a closed loop, filled into one that has none."""
    report = loop.report
    effects = tuple(row["effect"] for row in report["findings"])
    masked: dict[str, int] = {}
    for row in report["quality"]:
        masked[row["reason"]] = max(masked.get(row["reason"], 0), int(row["samples"]))
    return replace(
        blank,
        verdict=report["verdict"],
        found=in_words(report["findings"]),
        effects=effects,
        n_states=len(prepared.spec.nodes) + sum(effect in ("hidden_mass", "sensor_lag") for effect in effects),
        before_K=float(report["before"]["rmse_K"]),
        after_K=float(report["after"]["rmse_K"]),
        scored_K=_scored(report, split.scored),
        at_deadline=any("the deadline ended the search" in notice for notice in report["notices"]),
        failures=tuple(report.get("failures", ())),
        masked=masked,
        parameters={row["name"]: (row["mean"], row["std"]) for row in loop.model.summary["parameters"]},
        pairs=tuple(_pair(loop, prepared, record) for record in prepared.held_out) if split.every_pair else (),
    )


def measure(split: Split, data: Path, code: str, deadline_s: float) -> Result:
    """Close the loop on a split; where that fails the result holds the error."""
    blank = Result(split.name, code, deadline_s)
    begun = time.perf_counter()
    try:
        prepared = split.prepare(data / split.folder)
        loop = close_loop(
            prepared.spec,
            prepared.records,
            holdout=prepared.holdout,
            holdout_records=prepared.held_out or None,
            burn_in_s=prepared.burn_in_s,
            deadline_s=deadline_s,
        )
        blank = replace(blank, seconds=time.perf_counter() - begun)
        result = result_of(split, prepared, loop, blank)
    except Exception as error:
        result = replace(blank, seconds=time.perf_counter() - begun, error=_one_line(error))
    peaks = [resource.getrusage(whose).ru_maxrss for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return replace(result, peak_MB=max(peaks) / 1024.0)


def _compile() -> None:
    """Close a loop on a small case, so that no run that is measured has to compile the loops of the product."""
    case = network_case("leak_to_boundary", 1, n_orbits=3, dt_s=300.0)
    close_loop(case.spec, [case.record])


def _measure_named(name: str, data: Path, code: str, deadline_s: float) -> Result:
    return measure(next(split for split in SPLITS if split.name == name), data, code, deadline_s)


def _answer(pipe: Connection, work: Callable[[], Any]) -> None:
    def follow() -> None:
        parent = parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
    pipe.send(None)  # what is needed is imported: from here on the time counts
    pipe.send(work())


def alone(work: Callable[[], Any], limit_s: float) -> Any:
    """Run ``work``, which must be picklable, in a fresh process and return what it returns.

    Raises
    ------
    TimeoutError
        If it takes longer than ``limit_s``, imports not counted; the process is ended.
    RuntimeError
        If the process ends without an answer.
    """
    context = get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    child = context.Process(target=_answer, args=(theirs, work), daemon=True)
    child.start()
    theirs.close()
    try:
        for seconds in (READY_S, limit_s):
            if not ours.poll(seconds):
                raise TimeoutError(f"no answer after {seconds:.0f} s: ended")
            answer = ours.recv()
        return answer
    except EOFError:
        child.join()
        raise RuntimeError(f"the process ended without an answer (exit {child.exitcode})") from None
    finally:
        child.kill()
        child.join()
        ours.close()


def supervised(name: str, work: Callable[[], Result], code: str, deadline_s: float) -> Result:
    """Return what ``work`` returns from a process of its own; one that hangs or dies is a result too."""
    begun = time.perf_counter()
    try:
        return alone(work, deadline_s + GRACE_S)
    except (TimeoutError, RuntimeError) as error:
        hung = isinstance(error, TimeoutError)
        seconds = time.perf_counter() - begun
        words = str(error) if hung else _one_line(error)
        return Result(name, code, deadline_s, error=words, hung=hung, seconds=seconds)


def compile_all() -> None:
    """Compile the loops of the product in a process of its own, where they are not compiled yet."""
    with contextlib.suppress(TimeoutError, RuntimeError):
        alone(_compile, COMPILING_S)


def measure_all(
    splits: Sequence[Split], data: Path, *, deadline_s: float, cache: Path | None, fresh: bool, n_processes: int
) -> Iterator[Result]:
    """Yield a result for every split as it comes, first those of the cache; new ones are added to it.

    Parameters
    ----------
    splits, data
        What to run, and the folder of the measured sets.
    deadline_s
        Seconds for each search.
    cache
        File of JSON lines; None for none.
    fresh
        Whether to leave what the cache holds aside.
    n_processes
        How many run at a time, each with one thread for its linear algebra.
    """
    os.environ.update(dict.fromkeys(THREADS, "1"))  # the processes that are started below inherit it
    code = sources()
    known = {} if fresh else cached(cache, code, deadline_s)
    yield from (known[split.name] for split in splits if split.name in known)
    todo = [split for split in splits if split.name not in known]
    if todo:
        compile_all()
    with ThreadPoolExecutor(n_processes) as pool:
        running = [
            pool.submit(supervised, s.name, partial(_measure_named, s.name, data, code, deadline_s), code, deadline_s)
            for s in todo
        ]
        for future in as_completed(running):
            result = future.result()
            if cache is not None:
                cache.parent.mkdir(parents=True, exist_ok=True)
                with cache.open("a", encoding="utf-8") as file:
                    file.write(to_line(result) + "\n")
            yield result
