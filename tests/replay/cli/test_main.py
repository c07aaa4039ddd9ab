"""The entry point: help, exit codes, and what an import of the command line drags in."""

import re
import subprocess
import sys
from pathlib import Path

import click
import pytest

from replay.cli import main as module
from replay.cli.main import main, twin
from twin_core import __version__
from twin_core.errors import TwinError

COMMANDS = sorted(twin.commands)


def test_the_commands() -> None:
    assert COMMANDS == [
        *(
            "backup",
            "balance",
            "bridge",
            "calibrate",
            "check",
            "check-effect",
            "close-loop",
            "convert",
            "correlate",
            "demo",
            "export",
            "forecast",
            "import",
            "init",
            "migrate",
            "migrate-store",
        ),
        *("print", "record", "register", "replay", "restore", "serve", "show", "simulate", "worker"),
    ]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_every_command_ends_with_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    printed = capsys.readouterr().out
    assert f"Example:\n    twin {command}" in printed


def test_example_of_every_command_is_understood() -> None:
    for command in twin.commands.values():
        assert command.epilog is not None
        argv = command.epilog.split()[4:]
        command.make_context(str(command.name), argv, resilient_parsing=False)


@pytest.mark.parametrize("argv", [[], ["--help"], ["-h"]])
def test_help(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == 0
    printed = capsys.readouterr().out
    assert all(command in printed for command in COMMANDS)


def test_help_tells_every_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    """Those that the documentation lists, and no others."""
    page = (Path(__file__).parents[3] / "docs" / "cli.md").read_text()
    assert main(["--help"]) == 0
    told = re.findall(r"^ {4}(\d+)  +\S", capsys.readouterr().out, re.MULTILINE)
    assert told == re.findall(r"^\| (\d+) \|", page, re.MULTILINE)
    codes = (module.ANSWER_IS_NO, module.BAD_INPUT, module.INTERNAL, module.INTERRUPTED)
    assert told == ["0", *map(str, codes)]


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"twin {__version__}\n"


def test_heavy_packages_wait_for_a_command() -> None:
    heavy = ["numpy", "pandas", "scipy", "numba", "torch", "skfem", "pydantic", "fastapi", "httpx", "mcap", "rich"]
    code = f"import sys, replay.cli.main; print([m for m in {heavy} if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "[]\n"


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (TwinError("a.csv: row 3:\n  is wrong"), 2, "twin: a.csv: row 3: is wrong\n"),
        (click.UsageError("No such option."), 2, "twin: No such option; see twin --help\n"),
        (KeyboardInterrupt(), 130, "twin: interrupted\n"),
        (ZeroDivisionError("by zero"), 70, "twin: a fault of the program: ZeroDivisionError: by zero;"),
    ],
)
def test_errors_become_one_line(
    error: BaseException,
    code: int,
    line: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(**kwargs: object) -> None:
        raise error

    monkeypatch.setattr(module.twin, "main", fail)
    assert main(["demo"]) == code
    assert capsys.readouterr().err.startswith(line)


def test_traceback_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(**kwargs: object) -> None:
        raise TwinError("wrong")

    monkeypatch.setattr(module.twin, "main", fail)
    with pytest.raises(TwinError):
        main(["--traceback", "demo"])
