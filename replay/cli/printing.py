"""``twin print``: a report page as PDF, printed by whatever Chromium or Chrome the machine has."""

import shutil
import subprocess
import tempfile
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
    """Print a page that stands on this machine into a PDF.

    Raises
    ------
    ReplayError
        If there is no browser, no page, or the browser wrote nothing.
    """
    from replay.errors import ReplayError

    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        raise ReplayError(f"{out}: needs Chromium or Chrome; install one, or print {page} from any browser")
    if not page.is_file():
        raise ReplayError(f"{page}: cannot be read (no such file)")
    with tempfile.TemporaryDirectory() as folder:
        flags = ["--headless", "--disable-gpu", "--no-sandbox", "--no-first-run", "--disable-background-networking"]
        flags += [f"--user-data-dir={folder}/profile", "--no-pdf-header-footer", "--force-device-scale-factor=2"]
        flags += ["--virtual-time-budget=4000", f"--print-to-pdf={folder}/page.pdf", page.resolve().as_uri()]
        try:
            run = subprocess.run([browser, *flags], capture_output=True, text=True, timeout=PRINT_TIMEOUT_S)
        except subprocess.TimeoutExpired as error:
            raise ReplayError(f"{out}: {browser} did not finish within {PRINT_TIMEOUT_S:g} s") from error
        printed = Path(folder) / "page.pdf"
        if not printed.is_file():
            said = (run.stderr.strip().splitlines() or ["no message"])[-1]
            raise ReplayError(f"{out}: {browser} wrote no PDF ({said})")
        try:
            shutil.copyfile(printed, out)
        except OSError as error:
            raise ReplayError(f"{out}: cannot be written ({error.strerror or error})") from error
