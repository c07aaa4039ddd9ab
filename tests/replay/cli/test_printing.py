"""``twin print`` with a stand-in for the browser: what is printed, what is refused, and what is left running."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from replay.cli import printing
from replay.cli.main import main
from twin_core.report.html import render

PAGE = render({"twin": "sat", "verdict": "unexplained", "before": {}, "after": {}}, {})
SLEEPS = "sleep 600"
PRINTS = 'for a in "$@"; do case $a in --print-to-pdf=*) printf "%%PDF-1.4" > "${a#*=}";; esac; done'


def browser(folder: Path, script: str) -> None:
    """Leave a program named chromium that notes its own process and goes on as told."""
    path = folder / "chromium"
    path.write_text(f'#!/bin/sh\necho $$ > "{folder}/started"\n{script}\n')
    path.chmod(0o755)


def is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    (tmp_path / "page.html").write_text(PAGE, encoding="utf-8")
    return tmp_path


def test_a_page_is_printed(desk: Path) -> None:
    browser(desk, PRINTS)
    assert main(["print", f"{desk}/page.html"]) == 0
    assert (desk / "page.pdf").read_bytes() == b"%PDF-1.4"


@pytest.mark.parametrize("content", [b"<p>x", b"\xff\xfe\x00PDF", b"", b"<!doctype html><title>mine</title>"])
def test_what_is_no_report_page_never_reaches_the_browser(
    desk: Path, capsys: pytest.CaptureFixture[str], content: bytes
) -> None:
    browser(desk, PRINTS)
    (desk / "x.html").write_bytes(content)
    assert main(["print", f"{desk}/x.html", "--out", f"{desk}/x.pdf"]) == 2
    assert f"{desk}/x.html: is no report page of this tool" in capsys.readouterr().err
    assert not (desk / "started").exists() and not (desk / "x.pdf").exists()


def test_a_browser_that_writes_nothing_is_told_without_its_chatter(
    desk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    browser(desk, "echo '[1:ERROR:headless.cc(1)] chatter' >&2; exit 1")
    assert main(["print", f"{desk}/page.html"]) == 2
    told = capsys.readouterr().err
    assert "wrote no PDF; print" in told and "chatter" not in told


def test_a_browser_that_hangs_is_ended(
    desk: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    browser(desk, SLEEPS)
    monkeypatch.setattr(printing, "PRINT_TIMEOUT_S", 1.0)
    assert main(["print", f"{desk}/page.html"]) == 2
    assert "did not finish within 1 s" in capsys.readouterr().err
    assert not is_running(int((desk / "started").read_text()))


def test_a_browser_does_not_outlive_who_started_it(desk: Path) -> None:
    browser(desk, SLEEPS)
    twin = subprocess.Popen([sys.executable, "-m", "replay.cli.main", "print", f"{desk}/page.html"])
    while not (desk / "started").exists() or not (desk / "started").read_text():
        assert twin.poll() is None
        time.sleep(0.05)
    twin.send_signal(signal.SIGTERM)
    assert twin.wait(60) == 130
    assert not is_running(int((desk / "started").read_text()))


def test_a_termination_while_the_browser_starts_leaves_none_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine a browser ran before its process was known, and outlived a termination that came then."""
    started: list[subprocess.Popen[bytes]] = []
    before = signal.getsignal(signal.SIGINT)  # ignored where a shell runs the tests in the background

    class Slow(subprocess.Popen[bytes]):
        def __init__(self, *command: object, **options: object) -> None:
            super().__init__(*command, **options)  # type: ignore[call-overload]
            started.append(self)
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(subprocess, "Popen", Slow)
    with pytest.raises(KeyboardInterrupt):
        printing._ended(["sleep", "600"], 60.0)
    assert started[0].poll() is not None
    assert signal.getsignal(signal.SIGINT) is before
