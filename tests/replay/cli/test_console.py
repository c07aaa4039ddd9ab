"""JSON for machines, short numbers for people, and silence where nobody looks."""

import json

import numpy as np
import pytest

from replay.cli.console import print_table, progress_bar, short, to_json


def test_json_has_only_what_json_knows() -> None:
    data = {"a": np.float64(1.5), "b": [np.nan, np.inf, None], "c": np.arange(3), "d": ("x", True), 5: np.int64(2)}
    assert json.loads(to_json(data)) == {"a": 1.5, "b": [None, None, None], "c": [0, 1, 2], "d": ["x", True], "5": 2}


@pytest.mark.parametrize(("value", "text"), [(1234.5, "1.23e+03"), (0.04816, "0.0482"), (None, "-"), (np.nan, "-")])
def test_short(value: float | None, text: str) -> None:
    assert short(value) == text


def test_progress_is_silent_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar("working") as progress:
        progress(0.5, "half way")
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err == ""


def test_names_are_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    print_table("[bold]t", ["[red]name"], [["[x]y"]])
    printed = capsys.readouterr().out
    assert "[bold]t" in printed and "[red]name" in printed and "[x]y" in printed
