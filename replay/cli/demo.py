"""``twin demo``: the whole promise, from orbit to verdict, through a real service."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import click

from replay.cli.command import FILE, Command


@click.command(
    cls=Command,
    short_help="From orbit to verdict, all of it.",
    example="twin demo --effect radiation_to_sink --seed 3 --out demo-out",
)
@click.option("--out", default="demo-out", show_default=True, type=FILE, help="Folder for report and recording.")
@click.option("--serve", is_flag=True, help="Leave the service and its dashboard running until interrupted.")
@click.option("--effect", default="random", show_default=True, help="What to hide: an effect's name, random or none.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="Draws everything random.")
@click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON.")
def demo(out: Path, serve: bool, effect: str, seed: int, as_json: bool) -> int:
    """Hide an effect in simulated orbits and let the twin find it over HTTP.

    Exits with 0 only if the effect was found and the held-out error fell.
    """
    from replay.cli.console import print_line, to_json
    from replay.cli.demo_run import StepFailed, print_outcome, run_demo

    if out.exists() and not out.is_dir():
        raise click.UsageError(f"--out {out} is a file; name a folder")
    try:
        with _terminable() as asked, run_demo(effect, seed, out) as outcome:
            if as_json:
                print_line(to_json(outcome.to_json()).rstrip())
            else:
                print_outcome(outcome, out)
            if serve:
                print_line(f"dashboard: {outcome.url} (Ctrl-C ends it)")
                _wait()
                asked.clear()
    except StepFailed as error:
        click.echo(f"twin: {error}", err=True)
        return 1
    return 0 if outcome.success else 1


@contextmanager
def _terminable() -> Iterator[list[int]]:
    """Let SIGTERM end the block as Ctrl-C does, so that everything started is cleaned up; yield the signals heard.

    A library may lose the interruption (one that arrives in a finaliser is only printed): the end of the block heeds it.
    """
    asked: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, interrupt) for number in numbers]
    try:
        yield asked
        if asked:
            raise KeyboardInterrupt
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def _wait() -> None:
    """Return when interrupted."""
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        return
