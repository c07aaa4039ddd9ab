"""Numbers with their nouns, in both packages alike; and no message leaves the plural to its reader."""

import ast
import re
from collections.abc import Callable

import pytest

from replay import wording as of_replay
from tests.test_architecture import modules
from twin_core import wording as of_core


@pytest.mark.parametrize("counted", [of_core.counted, of_replay.counted])
def test_one_is_singular(counted: Callable[..., str]) -> None:
    assert [counted(n, "row") for n in (0, 1, 2)] == ["0 rows", "1 row", "2 rows"]
    assert [counted(n, "row repeats", "rows repeat") for n in (1, 2)] == ["1 row repeats", "2 rows repeat"]


def test_no_message_says_both_at_once() -> None:
    for module, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert not re.search(r"\(s\)(?!\w)", node.value), f"{module}, line {node.lineno}: {node.value}"
