"""Files that appear whole or not at all."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from twin_core.errors import TwinError


@contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that takes its place when the block ends without an exception.

    Parameters
    ----------
    path
        The file to make or replace; its folder must exist.

    Raises
    ------
    TwinError
        If the folder does not exist or cannot be written to, or ``path`` is a folder.
    """
    target = Path(path)
    if target.is_dir():
        raise TwinError(f"{target}: is a folder; name a file")
    try:
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=target.suffix)
    except OSError as error:
        raise TwinError(f"{target}: cannot be written ({error.strerror}); choose a folder that exists") from error
    os.close(handle)
    partial = Path(name)
    try:
        yield partial
        os.chmod(partial, 0o666 & ~_umask())  # mkstemp makes files that only their owner may read
        os.replace(partial, target)
    except OSError as error:
        raise TwinError(f"{target}: cannot be written ({error.strerror or error})") from error
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: Path | str, text: str) -> None:
    """Write a text file whole or not at all; TwinError as in ``replacing``."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def make_folder(path: Path | str) -> None:
    """Make a folder and its parents unless it exists; TwinError if that cannot be."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TwinError(f"{path}: the folder cannot be made ({error.strerror}); choose another") from error


def _umask() -> int:
    """Return the process's file mode mask, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
