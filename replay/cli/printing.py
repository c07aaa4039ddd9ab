"""``twin print``: a report page as PDF, printed by whatever Chromium or Chrome the machine has."""

import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import click

from replay.cli.command import FILE, Command

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "microsoft-edge")
PRINT_TIMEOUT_S = 120.0


@click.command("print", cls=Command, short_help="Print a report page as PDF.", example="twin print loop/report.html")
@click.argument("page", type=FILE)
@click.option("--out", type=FILE, help="PDF to write.  [default: the page's name with .pdf]")
def print_page(page: Path, out: Path | None) -> None:
    """Print a page that twin close-loop or twin demo left, on A4, with a headless Chromium or Chrome.

    Any browser prints the same from its menu.
    """
    from replay.cli.console import print_line

    target = page.with_suffix(".pdf") if out is None else out
    as_pdf(page, target)
    print_line(f"wrote {target}")


def as_pdf(page: Path, out: Path) -> None:
    """Print a report page that stands on this machine into a PDF.

    Raises
    ------
    ReplayError
        If there is no browser, no report page, or the browser wrote nothing in time.
    """
    from replay.errors import ReplayError
    from twin_core.report.html import is_report

    try:
        text = page.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise ReplayError(f"{page}: cannot be read ({error.strerror or error})") from error
    if not is_report(text):
        raise ReplayError(
            f"{page}: is no report page of this tool; name the report.html that twin close-loop, correlate or demo left"
        )
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        raise ReplayError(f"{out}: needs Chromium or Chrome; install one, or print {page} from any browser")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        printed = Path(folder) / "page.pdf"
        flags = ["--headless", "--disable-gpu", "--no-sandbox", "--no-first-run", "--disable-background-networking"]
        flags += [f"--user-data-dir={folder}/profile", "--no-pdf-header-footer", "--force-device-scale-factor=2"]
        flags += ["--virtual-time-budget=4000", f"--print-to-pdf={printed}", page.resolve().as_uri()]
        if not _ended([browser, *flags], PRINT_TIMEOUT_S):
            raise ReplayError(
                f"{out}: {browser} did not finish within {PRINT_TIMEOUT_S:g} s; print {page} from any browser's menu"
            )
        if not printed.is_file():
            raise ReplayError(f"{out}: {browser} wrote no PDF; print {page} from any browser's menu")
        try:
            shutil.copyfile(printed, out)
        except OSError as error:
            raise ReplayError(f"{out}: cannot be written ({error.strerror or error})") from error


def _ended(command: Sequence[str], limit_s: float) -> bool:
    """Run a command and return whether it ended by itself in time; neither it nor what it started outlives the call.

    A termination of this process interrupts the wait as Ctrl-C does. One that comes before the command is known would leave it
    behind, and counts as soon as it is.
    """
    process: subprocess.Popen[bytes] | None = None
    arrived: list[int] = []

    def interrupt(number: int, _: object) -> None:
        arrived.append(number)
        if process is not None:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        if arrived:
            raise KeyboardInterrupt
        process.wait(limit_s)
    except subprocess.TimeoutExpired:
        return False
    finally:
        if process is not None:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        for number, handler in before.items():
            signal.signal(number, handler)
    return True
