"""Copy the saved tables into the README, between their markers: its numbers are those that were printed."""

import re
from itertools import dropwhile, takewhile
from pathlib import Path

from benchmarks.markdown import TABLES

README = TABLES.parents[1] / "README.md"


def table_of(name: str) -> str:
    """Return the first table of a saved page."""
    lines = (TABLES / f"{name}.md").read_text().splitlines()
    from_first = dropwhile(lambda line: not line.startswith("|"), lines)
    return "\n".join(takewhile(lambda line: line.startswith("|"), from_first))


def refresh(readme: Path = README) -> None:
    """Replace what stands between ``<!-- name -->`` and ``<!-- /name -->`` by the table of that name."""
    text = readme.read_text()
    for name in re.findall(r"<!-- /(\w+) -->", text):
        block = f"<!-- {name} -->\n{table_of(name)}\n<!-- /{name} -->"
        text = re.sub(rf"<!-- {name} -->.*?<!-- /{name} -->", lambda _, block=block: block, text, flags=re.DOTALL)
    readme.write_text(text)


if __name__ == "__main__":
    refresh()
