"""Lists after one flag."""

import pytest

from replay.cli.command import spread


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("--t a b --o c", "--t a --t b --o c"),
        ("--t a --t b c", "--t a --t b --t c"),
        ("--o c --t a", "--o c --t a"),
        ("--t=a b", "--t=a b"),
        ("--t a -- b", "--t a -- b"),
        ("--t - b", "--t - --t b"),
        ("x y --t a", "x y --t a"),
        ("--t", "--t"),
        ("", ""),
    ],
)
def test_spread(given: str, expected: str) -> None:
    assert spread(given.split(), {"--t"}) == expected.split()
