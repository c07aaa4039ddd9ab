"""One server per database file, enforced by a lock that the operating system drops when the process ends."""

import fcntl
import os
from pathlib import Path

from twin_core.errors import TwinError


class StoreError(TwinError):
    """The store cannot be opened."""


class FileLock:
    """An exclusive lock on ``<database>.lock``."""

    def __init__(self, database: Path) -> None:
        """Take the lock; StoreError if another process holds it."""
        self._path = database.with_name(database.name + ".lock")
        try:
            self._file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o600)
        except OSError as error:
            raise StoreError(f"{database}: cannot be opened ({error.strerror}); check TWIN_DATABASE_URL") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._file)
            raise StoreError(f"{database}: another server uses this database; stop it or choose another file") from None

    def release(self) -> None:
        """Let go; the lock file stays, so that no two processes can lock different files of one name."""
        os.close(self._file)
