"""Tables of measurements: markdown, with the date, the commit and the command that printed them."""

import platform
import shlex
import subprocess
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

TABLES = Path(__file__).resolve().parent / "tables"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return rows of text as a markdown table."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)]) + "\n"


def commit() -> str:
    """Return the short commit that is measured, marked where the tree differs from it in more than saved tables."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(TABLES.parents[1]), *words]
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!benchmarks/tables")
    return (git("rev-parse", "--short", "HEAD") or "unknown commit") + ("-dirty" if changed else "")


def save_table(name: str, title: str, table: str, module: str, note: str = "") -> Path:
    """Save a table under ``benchmarks/tables`` with where it comes from; return its path."""
    today = datetime.now(UTC).strftime("%Y-%m-%d")
    command = shlex.join(["python", "-m", module, *sys.argv[1:]])
    source = f"`{command}`, {today}, commit {commit()}, Python {platform.python_version()}, two cores."
    path = TABLES / f"{name}.md"
    TABLES.mkdir(exist_ok=True)
    path.write_text("\n\n".join(part for part in (f"# {title}", source, table.strip(), note) if part) + "\n")
    print(f"saved {path.relative_to(TABLES.parents[1])}")
    return path
