"""What a person sees: progress on stderr where there is a terminal, results on stdout."""

import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from replay.wording import counted

if TYPE_CHECKING:
    from rich.console import Console

    from twin_core.network.spec import TwinSpec

Progress = Callable[[float, str], None]


@contextmanager
def progress_bar(title: str) -> Iterator[Progress]:
    """Yield a function of fraction and message that draws a bar; it draws nothing where stderr is no terminal."""
    if not sys.stderr.isatty():
        yield lambda fraction, message: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    times = (TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    columns = (SpinnerColumn(), TextColumn("{task.fields[title]}"), BarColumn(), *times)
    with Progress(
        *columns, TextColumn("[dim]{task.fields[note]}"), console=Console(stderr=True), transient=True
    ) as bar:
        task = bar.add_task(title, total=1.0, title=title, note="")
        yield lambda fraction, message: bar.update(task, completed=fraction, note=message)


def notify(notices: Sequence[str]) -> None:
    """Write remarks that are no errors to stderr."""
    for notice in notices:
        print(f"note: {notice}", file=sys.stderr)


def stdout() -> "Console":
    """Return a console for results; it writes plain text where stdout is no terminal."""
    from rich.console import Console

    width = None if sys.stdout.isatty() else 100
    return Console(file=sys.stdout, highlight=False, soft_wrap=width is not None, width=width)


def print_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table whose first column is text and whose others are numbers."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=escape(title), box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
    for position, name in enumerate(header):
        table.add_column(escape(name), justify="left" if position == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*map(escape, row))
    stdout().print(table)


def print_line(text: str) -> None:
    """Print one line of a result."""
    print(text, flush=True)


def sizes(spec: "TwinSpec") -> str:
    """Return how much of everything a specification declares."""
    hidden = sum(1 for node in spec.nodes if not node.sensors)
    declared = (
        f"{counted(len(spec.nodes), 'node')} ({hidden} without a sensor)",
        counted(len(spec.conductors) + len(spec.radiators) + len(spec.radiation), "coupling"),
        counted(len(spec.loads), "load"),
        counted(len(spec.used_channels), "telemetry channel"),
    )
    return ", ".join(declared)


def to_json(data: Any) -> str:
    """Return JSON text; numbers that JSON cannot express become null."""
    return json.dumps(_plain(data), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _plain(data: Any) -> Any:
    if isinstance(data, Mapping):
        return {str(key): _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    if hasattr(data, "tolist"):
        return _plain(data.tolist())
    if isinstance(data, float) and not math.isfinite(data):
        return None
    return data


def short(value: float | None, digits: int = 3) -> str:
    """Return a number with a few significant digits, a dash where there is none."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}g}"
