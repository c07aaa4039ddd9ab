"""The option ``--effects`` of every command that looks for effects or reads a model that may hold them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from replay.cli.command import FILE

F = TypeVar("F", bound=Callable[..., Any])


def effects_option(function: F) -> F:
    """Give a command ``--effects FILE.py...``; the effects are known before the command begins."""
    return click.option(
        "--effects",
        multiple=True,
        metavar="FILE.py...",
        type=FILE,
        envvar="TWIN_EFFECTS",
        expose_value=False,
        callback=_load,
        help="Plug-ins with effects of your own.  [default: TWIN_EFFECTS]",
    )(function)


def _load(context: click.Context, option: click.Parameter, files: tuple[Path, ...]) -> None:
    if files and not context.resilient_parsing:
        from twin_core.effects import load_effects

        load_effects(files)
