"""Open MCT with the plug-in, served beside a service."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.service.browser import BINARY

ROOT = Path(__file__).resolve().parents[2]
PLUGIN = ROOT / "replay" / "bridges" / "openmct"
DIST = ROOT / ".venv" / "openmct" / "node_modules" / "openmct" / "dist"
NODE = shutil.which("node")
MISSING = (
    "no Chromium here"
    if BINARY is None
    else "no Node.js here"
    if NODE is None
    else f"no Open MCT here: npm install --prefix {DIST.parents[2].relative_to(ROOT)} openmct"
    if not DIST.exists()
    else None
)
"""Why tests with Open MCT are skipped; None: they are not."""


@contextmanager
def served(service: str, folder: Path, key: str | None = None) -> Iterator[str]:
    """Yield the address of Open MCT with the plug-in, which passes on to a service."""
    assert NODE is not None
    environment = dict(os.environ) | ({} if key is None else {"TWIN_API_KEY": key})
    command = [NODE, str(PLUGIN / "serve.js"), "--service", service, "--port", "0", "--openmct", str(DIST)]
    with (folder / "openmct.log").open("w") as log:
        process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=log, text=True)
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        assert line.startswith("listening on "), (folder / "openmct.log").read_text()
        yield line.removeprefix("listening on ").strip()
    finally:
        process.terminate()
        process.wait(20)
        process.stdout.close()
