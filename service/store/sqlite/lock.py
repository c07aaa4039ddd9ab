"""One server per database file, enforced by locks that the operating system drops when the process ends."""

import fcntl
import os
from pathlib import Path

from service.store.errors import StoreError

_held: set[tuple[int, int]] = set()
"""Device and inode of each database of this process: closing one a second time would drop SQLite's own locks on it."""


class FileLock:
    """Exclusive locks on ``<database>.lock`` and on the file itself, whatever names lead there.

    The first one stands for the place and holds when another file is put there; the second one stands for the file and
    holds when another link leads to it.
    """

    def __init__(self, database: Path, name: str = "TWIN_DATABASE_URL") -> None:
        """Take the locks; StoreError if another server holds one of them. ``name`` is that of what named the file."""
        self._database, self._name = database, name
        place = database.resolve()
        self._place = self._lock(place.with_name(place.name + ".lock"), 0o600)
        try:
            self._file = self._lock_file(place)
        except BaseException:
            os.close(self._place)
            raise

    def _lock_file(self, place: Path) -> int:
        found = place.stat() if place.exists() else None
        if found is not None and (found.st_dev, found.st_ino) in _held:
            raise self._taken()
        file = self._lock(place, 0o600)  # SQLite makes its journals as the file is
        status = os.fstat(file)
        self._identity = (status.st_dev, status.st_ino)
        _held.add(self._identity)
        return file

    def _lock(self, path: Path, mode: int) -> int:
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, mode)
        except OSError as error:
            reason = f"cannot be opened ({error.strerror}); check {self._name}"
            raise StoreError(f"{self._database}: {reason}") from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(file)
            raise self._taken() from None
        return file

    def _taken(self) -> StoreError:
        return StoreError(f"{self._database}: another server uses this database; stop it or choose another file")

    def release(self) -> None:
        """Let go; the lock file stays, so that no two processes can lock different files of one name."""
        _held.discard(self._identity)
        os.close(self._file)
        os.close(self._place)
