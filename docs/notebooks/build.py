"""Write the notebooks of this folder with their outputs: ``python docs/notebooks/build.py``.

Each is a script beside it, ``*.py``, whose cells begin with ``# %%`` (``# %% [markdown]`` for text).
"""

import ast
import contextlib
import io
import json
import re
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent


def cells_of(script: str) -> list[tuple[str, str]]:
    """Return kind (``markdown`` or ``code``) and source of each cell."""
    found = []
    for head, body in re.findall(r"^# %%(.*)\n((?:(?!# %%).*\n?)*)", script, re.MULTILINE):
        if "markdown" in head:
            found.append(("markdown", re.sub("^# ?", "", body.strip(), flags=re.MULTILINE)))
        else:
            found.append(("code", body.strip()))
    return found


def run(source: str, names: dict[str, Any]) -> list[str]:
    """Run a cell; return what it printed, and its last expression as text."""
    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, "cell", "exec"), names)
        value = eval(compile(ast.Expression(last.value), "cell", "eval"), names) if last is not None else None
    return [text for text in (printed.getvalue().rstrip(), "" if value is None else repr(value)) if text]


def notebook(script: str) -> dict[str, Any]:
    """Return a script as a notebook (nbformat 4.5), each cell run in order."""
    names: dict[str, Any] = {"__name__": "__main__"}
    cells: list[dict[str, Any]] = []
    for number, (kind, source) in enumerate(cells_of(script), start=1):
        cell: dict[str, Any] = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}, "source": source}
        if kind == "code":
            outputs = [{"output_type": "stream", "name": "stdout", "text": text + "\n"} for text in run(source, names)]
            cell |= {"execution_count": number, "outputs": outputs}
        cells.append(cell)
    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    return {"cells": cells, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}


if __name__ == "__main__":
    for script in sorted(HERE.glob("*_*.py")):
        made = notebook(script.read_text())
        script.with_suffix(".ipynb").write_text(json.dumps(made, indent=1, ensure_ascii=False) + "\n")
        print(script.with_suffix(".ipynb").name)
