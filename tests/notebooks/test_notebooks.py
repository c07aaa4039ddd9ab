"""The notebooks run, and what stands in them is what they print."""

import importlib.util
import json
import re
from pathlib import Path
from types import ModuleType

import pytest

NUMBER = re.compile(r"(?<![\w:-])-?\d+\.\d+(?![\w:-])")
"""Digits that another machine's rounding may change, as little as it may; whole numbers, instants and names are words."""

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"


def builder() -> ModuleType:
    spec = importlib.util.spec_from_file_location("build_notebooks", FOLDER / "build.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.long
@pytest.mark.parametrize("script", sorted(FOLDER.glob("*_*.py")), ids=lambda path: path.stem)
def test_a_notebook_is_what_its_script_prints(script: Path) -> None:
    made = builder().notebook(script.read_text())
    saved = json.loads(script.with_suffix(".ipynb").read_text())
    assert [c["source"] for c in saved["cells"]] == [c["source"] for c in made["cells"]], "run docs/notebooks/build.py"
    texts = [["".join(o["text"] for o in c.get("outputs", ())) for c in book["cells"]] for book in (saved, made)]
    for before, now in zip(*texts, strict=True):
        assert NUMBER.sub("#", before) == NUMBER.sub("#", now)
        told, seen = ([float(x) for x in NUMBER.findall(text)] for text in (before, now))
        assert told == pytest.approx(seen, rel=0.1, abs=0.02)
