"""What faults of a fleet have cost: the tests of ``tests/service/fleet``, their losses counted and told in a table.

``python -m benchmarks.fleet_faults`` writes ``benchmarks/tables/fleet_faults.md``; it ends with 1 where a count is not zero.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.markdown import markdown_table, save_table

SAMPLES = ("acknowledged", "refused, sent again", "lost", "twice", "wrong", "owned twice")
HEAD = ["fault, under load", *SAMPLES, "jobs lost", "jobs done twice"]
NOTE = (
    "Samples and jobs of runs on PostgreSQL; each one refused was sent again until it was acknowledged. Twice: stored twice, "
    "and numbers of the stream given twice. Wrong: values or residuals that are not those of a service to which nothing "
    "happened, by a simple filter that stands in for the twin's, and answers other than 200, 503 and 507. Owned twice: slots "
    "whose epochs in the log of tenures overlap, and "
    "turns of two writers of a twin's state in one epoch, as noted by a trigger of the database. Of "
    "jobs, acknowledged counts those queued; done twice are models beyond one of each."
)


def main() -> int:
    """Run the faults and write the table."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "faults.jsonl"
        command = [sys.executable, "-m", "pytest", "-q", "-m", "fleet", "tests/service/fleet", "-rs"]
        done = subprocess.run(command, env=os.environ | {"FLEET_FAULTS": str(report), "TWIN_TEST_STORE": "postgres"})
        found = [json.loads(line) for line in report.read_text().splitlines()]
    rows = [[f"{value:,}" if isinstance(value, int) else value for value in one.values()] for one in found]
    save_table("fleet_faults", "Faults of a fleet", markdown_table(HEAD, rows), "benchmarks.fleet_faults", NOTE)
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
