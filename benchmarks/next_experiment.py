"""Does the proposed experiment tell? Finite-element spacecraft at rest, whose record leaves open what is missing.

Payloads are held and the bus keeps its temperature, so that a lossy input, a constant heat and a leak to the bus look alike. The
loop names one and lists what it cannot tell from it; the experiment with the largest expected gain is then flown on the same
finite-element truth, with new noise and a new bus, and the loop runs again on both records. For comparison it also runs on
one more record at rest.

``python -m benchmarks.next_experiment [--cases N] [--results FILE] [--processes 1]`` appends one line of JSON per case to
FILE, and saves ``benchmarks/tables/next_experiment.md``.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import softmax

from benchmarks.bands import Row
from benchmarks.markdown import markdown_table, save_table
from twin_core.closed_loop import close_loop
from twin_core.fem.demo import PAYLOADS, demo_scenario
from twin_core.fem.scenario import Scenario, load_scenario
from twin_core.fem.simulate import simulate
from twin_core.network.spec import TwinSpec
from twin_core.report.experiments import entropy_bits
from twin_core.telemetry import Record

RESULTS = Path("build/next_experiment.jsonl")
FIRST_SEED = 4000
HOLDOUT = 0.3
BUS_STD_K = 0.05
POWER_W = {"Q_pz": 60.0, "Q_box": 80.0, "Q_battery": 45.0, "Q_tank": 40.0}
LIMITS_W = {"Q_pz": 120.0, "Q_box": 150.0, "Q_battery": 90.0, "Q_tank": 90.0}
"""At what the payloads are held, and the most that an operator allows."""

LEADS = 0.51
"""The truth leads where it is likelier than all the others together, by more than rounding."""

KINDS = ("input_gain", "constant_heat_load", "leak_to_boundary")


@dataclass(frozen=True)
class RestTask:
    """A spacecraft at rest with one effect."""

    kind: str
    payload: str
    seed: int
    group: str = "rest"

    @property
    def name(self) -> str:
        """Return a name that is unique in the table."""
        return f"{self.kind}:{self.payload}:{self.seed}"

    @property
    def hidden(self) -> dict[str, Any]:
        """What is hidden, by the keys of a scenario."""
        node = PAYLOADS[self.payload]
        rng = np.random.default_rng([self.seed, 9])
        if self.kind == "input_gain":
            return {"channel": self.payload, "g": float(rng.uniform(0.4, 0.7))}
        if self.kind == "constant_heat_load":
            return {"node": node, "Q_W": float(rng.uniform(15.0, 35.0))}
        return {"node": node, "boundary": "bus", "G_W_per_K": float(rng.uniform(1.2, 3.0))}

    def scenario(self, seed: int, moved: Mapping[str, Any] | None = None) -> Scenario:
        """Return the scenario at rest, or with one channel moved over the end of its record as a plan says."""
        body = demo_scenario("none", self.seed)[0].model_dump(mode="json", exclude_none=True) | {"seed": seed}
        for channel, watts in POWER_W.items():
            body["forcings"][channel]["signal"] = {"signal": "constant", "value": watts}
        body["forcings"]["T_bus"]["signal"]["std"] = BUS_STD_K
        if moved is not None and moved["channel"] is not None:
            signal = body["forcings"][moved["channel"]]["signal"]
            rest = POWER_W.get(moved["channel"], signal.get("mean"))
            end_s = float(body["time"]["duration_s"])
            begin_s = end_s - moved["duration_s"]
            value = moved["value"] + (rest if moved["channel"] == "T_bus" else 0.0)
            body["forcings"][moved["channel"]]["signal"] = {
                "signal": "table",
                "time_s": [0.0, begin_s, begin_s + 1.0, end_s],
                "values": [rest, rest, value, value],
            }
        body["hidden"] = [{"effect": self.kind, **self.hidden}]
        return load_scenario(body)

    def spec(self) -> TwinSpec:
        """Return what the operator declares, payloads with their limits."""
        plain = demo_scenario("none", self.seed)[1].model_dump(mode="json", exclude_none=True)
        for channel, most in LIMITS_W.items():
            plain["channels"][channel]["limits"] = {"yellow": [0.0, most]}
        return TwinSpec.model_validate(plain)


def run(task: RestTask) -> Row:
    """Run one case: at rest, then with the experiment, then with one more record at rest."""
    spec, record = task.spec(), simulate(task.scenario(task.seed)).record
    before = close_loop(spec, [record], holdout=HOLDOUT).report
    row: Row = {"task": task.name, "group": task.group, "kind": task.kind, "before": standing(task, before)}
    found = next((f for f in before["findings"] if f["alternatives"] and f["experiments"]), None)
    if found is None:
        return row
    best = found["experiments"][0]
    row |= {"experiment": best["experiment"], "gain_bits": best["expected_gain_bits"]}
    n_train = int((1.0 - HOLDOUT) * record.time_s.size)
    parts = record.take(np.arange(n_train)), record.take(np.arange(n_train, record.time_s.size))
    for name, moved in (("after", best["plan"]), ("again", None)):
        flown = simulate(task.scenario(task.seed + 50_000, moved)).record
        report = close_loop(spec, [parts[0], later(flown, record)], holdout_records=[parts[1]], burn_in_s=5400.0).report
        row[name] = standing(task, report)
    return row


def later(record: Record, than: Record) -> Record:
    """Return a record shifted to begin a day after another one ended."""
    by_s = float(than.time_s[-1] - record.time_s[0]) + 86_400.0
    return Record(record.time_s + by_s, record.values, record.epoch_ns, f"{record.name}-flown")


def standing(task: RestTask, report: Mapping[str, Any]) -> dict[str, Any]:
    """Return whether the truth leads, its probability among what is listed, and the entropy of that, in bits."""
    wanted = {k: v for k, v in task.hidden.items() if k in ("channel", "node", "boundary")}
    for finding in report["findings"]:
        options = [finding, *finding["alternatives"]]
        evidence = [finding["evidence"]["log_bayes_factor"], *(a["log_bayes_factor"] for a in finding["alternatives"])]
        weights = softmax(evidence)
        is_truth = [o["effect"] == task.kind and o["where"] == wanted for o in options]
        if any(is_truth):
            share = float(weights[is_truth].sum())
            return {"leads": share > LEADS, "share": share, "bits": abs(entropy_bits(weights)), "options": len(options)}
    first = report["findings"][0]["effect"] if report["findings"] else report["verdict"]
    return {"leads": False, "share": 0.0, "bits": None, "options": 0, "instead": first}


def tasks_of(n_cases: int) -> list[RestTask]:
    """Return the cases: every kind at every payload in turn, each on a spacecraft of its own."""
    places = [(kind, payload) for payload in POWER_W for kind in KINDS]
    return [RestTask(*places[i % len(places)], FIRST_SEED + i) for i in range(n_cases)]


def table(rows: Sequence[Row]) -> str:
    """Return one row per case and the sums."""
    good = [row for row in rows if "error" not in row]
    lines = [
        [
            row["task"],
            _told(row["before"]),
            row.get("experiment", "none needed"),
            f"{row['gain_bits']:.2f}" if "gain_bits" in row else "-",
            _told(row["after"]) if "after" in row else "-",
            _told(row["again"]) if "again" in row else "-",
        ]
        for row in good
    ]
    open_ = [row for row in good if "after" in row]
    leads = {state: sum(row[state]["leads"] for row in open_) for state in ("before", "after", "again")}
    sums = [
        f"{len(open_)} of {len(good)} records leave open what is missing. The truth leads in {leads['before']} of these before,"
        f" in {leads['after']} after the experiment, in {leads['again']} after one more record at rest."
    ]
    header = ["hidden", "at rest", "experiment", "expected gain, bits", "after it", "after one more at rest"]
    failed = [f"Failed: {row['task']}: {row['error']}" for row in rows if "error" in row]
    return "\n\n".join([markdown_table(header, lines).strip(), *sums, *failed]) + "\n"


def _told(state: Mapping[str, Any]) -> str:
    if not state["options"]:
        return f"not listed ({state['instead']})"
    word = "leads" if state["leads"] else "listed"
    return f"{word}, {100 * state['share']:.0f} % of {state['options']}, {state['bits']:.2f} bits"


def line(row: Row) -> str:
    """Return a row in one line."""
    return f"{row['task']}: {_told(row['before'])} -> {_told(row['after']) if 'after' in row else 'no experiment'}"


def main() -> None:
    """Run the benchmark from the command line."""
    from benchmarks.loop import run_all  # its plots need the benchmarks' extra

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=12)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--processes", type=int, default=1)
    given = parser.parse_args()
    run_all(tasks_of(given.cases), given.results, given.processes, run, line)
    rows = [json.loads(text) for text in given.results.read_text(encoding="utf-8").splitlines()]
    text = table(rows)
    note = "`listed`: among the finding and its alternatives. Shares and bits are of the options that the report lists."
    save_table("next_experiment", "The experiment that would tell", text, "benchmarks.next_experiment", note)
    print(text)


if __name__ == "__main__":
    main()
