"""The notebooks run, and what stands in them is what they print."""

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"


def builder() -> ModuleType:
    spec = importlib.util.spec_from_file_location("build_notebooks", FOLDER / "build.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize("script", sorted(FOLDER.glob("*_*.py")), ids=lambda path: path.stem)
def test_a_notebook_is_what_its_script_prints(script: Path) -> None:
    made = builder().notebook(script.read_text())
    saved = json.loads(script.with_suffix(".ipynb").read_text())
    assert [c["source"] for c in saved["cells"]] == [c["source"] for c in made["cells"]], "run docs/notebooks/build.py"
    assert all(
        c["outputs"] == m["outputs"] for c, m in zip(saved["cells"], made["cells"], strict=True) if "outputs" in c
    )
