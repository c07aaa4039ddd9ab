"""One command of the command line: list options without repeated flags, and an example at the end of its help."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import click

FILE = click.Path(path_type=Path)
"""The type of every file and folder; what is wrong with one is said by whoever reads it."""


class Command(click.Command):
    """A command whose list options take several values after one flag: ``--telemetry a.csv b.csv``."""

    def __init__(self, *args: Any, example: str, **kwargs: Any) -> None:
        """Keep the example that ``--help`` shows."""
        kwargs["epilog"] = f"\b\nExample:\n  {example}"
        super().__init__(*args, **kwargs)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments, after giving each value of a list its own flag."""
        lists = {name for p in self.params if isinstance(p, click.Option) and p.multiple for name in p.opts}
        return super().parse_args(ctx, spread(args, lists))


def spread(args: Sequence[str], lists: Collection[str]) -> list[str]:
    """Return the arguments with the flag of each list repeated before each of its values.

    Examples
    --------
    >>> spread(["--telemetry", "a", "b", "--out", "c"], {"--telemetry"})
    ['--telemetry', 'a', '--telemetry', 'b', '--out', 'c']
    """
    result: list[str] = []
    flag, values = "", 0
    for position, arg in enumerate(args):
        if arg == "--":
            return [*result, *args[position:]]
        if arg.startswith("-") and len(arg) > 1:
            flag, values = (arg if arg in lists else ""), 0
        elif flag:
            values += 1
            if values > 1:
                result.append(flag)
        result.append(arg)
    return result
