"""API keys: who has them, what they allow, until when. A file of keys is read again whenever it changes."""

import hashlib
import hmac
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

from service.instants import now_us, parse_instant

log = logging.getLogger("service")

LOOK_EVERY_S = 1.0
HASHED = "sha256:"


class Role(IntEnum):
    """What a key allows; each role includes the ones before it."""

    read = 1
    ingest = 2
    operate = 3


@dataclass(frozen=True)
class Key:
    """A key of somebody; ``digest`` is the SHA-256 of what is sent, ``expires_us`` None where it holds for ever."""

    name: str
    role: Role
    digest: bytes
    expires_us: int | None = None

    @property
    def is_over(self) -> bool:
        """Whether it has expired."""
        return self.expires_us is not None and self.expires_us <= now_us()


def parse_keys(text: str) -> tuple[Key, ...]:
    """Return keys from ``role:key`` pairs separated by commas; they are named after their role and position.

    Raises
    ------
    ValueError
        Naming the position of a malformed pair, never the key.
    """
    keys: list[Key] = []
    for position, pair in enumerate(filter(None, (part.strip() for part in text.split(","))), start=1):
        role, separator, key = pair.partition(":")
        if not separator or role not in Role.__members__ or not key:
            raise ValueError(f"pair {position} must read role:key with role read, ingest or operate")
        made = Key(f"{role}-{position}", Role[role], _digest(key.encode()))
        if any(made.digest == known.digest for known in keys):
            raise ValueError(f"pair {position} repeats the key of an earlier pair")
        keys.append(made)
    return tuple(keys)


def read_key_file(path: Path) -> tuple[Key, ...]:
    """Return keys from a file with a line ``name role key [expires]`` each.

    The key may be written as ``sha256:`` and its hash in hexadecimal digits; ``expires`` is an instant in RFC 3339. Empty lines
    and those that begin with ``#`` are passed over.

    Raises
    ------
    ValueError, OSError
        Naming the line that is malformed, never the key; if the file cannot be read.
    """
    keys: list[Key] = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) not in (3, 4) or words[1] not in Role.__members__:
            raise ValueError(f"line {number} must read: name role key [expires], with role read, ingest or operate")
        name, role, key = words[:3]
        try:
            digest = bytes.fromhex(key.removeprefix(HASHED)) if key.startswith(HASHED) else _digest(key.encode())
            expires_us = parse_instant(words[3], "expires") if len(words) == 4 else None
        except Exception:
            raise ValueError(f"line {number}: the hash or the instant of expiry is malformed") from None
        if any(name == known.name or digest == known.digest for known in keys):
            raise ValueError(f"line {number} repeats the name or the key of an earlier line")
        keys.append(Key(name, Role[role], digest, expires_us))
    return tuple(keys)


class Keys:
    """The keys that hold now: those of the settings, and those of a file, which may change while the service runs."""

    def __init__(self, fixed: Sequence[Key], file: Path | None = None) -> None:
        """Read the file; ValueError or OSError if it cannot be used."""
        self._fixed, self._file = tuple(fixed), file
        self._looked_s, self._stamp = time.monotonic(), _stamp(file)
        self._keys = (*self._fixed, *(() if file is None else read_key_file(file)))

    @property
    def needed(self) -> bool:
        """Whether callers need a key at all."""
        return bool(self._fixed) or self._file is not None

    def find(self, sent: bytes) -> Key | None:
        """Return the key that somebody sent, expired or not; None if nobody has it."""
        self._look()
        digest, found = _digest(sent), None
        for key in self._keys:  # all of them, in constant time
            if hmac.compare_digest(key.digest, digest):
                found = key
        return found

    def _look(self) -> None:
        """Read the file again if it has changed, at most once a second."""
        now_s = time.monotonic()
        if self._file is None or now_s - self._looked_s < LOOK_EVERY_S:
            return
        self._looked_s = now_s
        if _stamp(self._file) != self._stamp:
            self.reload()

    def reload(self) -> None:
        """Read the file again; the keys stay as they are if it cannot be used."""
        if self._file is None:
            return
        self._stamp = _stamp(self._file)
        try:
            keys = read_key_file(self._file)
        except (ValueError, OSError) as error:
            log.error("the file of keys cannot be used; the former keys hold on", extra={"reason": str(error)})
            return
        self._keys = (*self._fixed, *keys)
        log.info("the file of keys was read", extra={"keys": [key.name for key in keys]})


def _digest(key: bytes) -> bytes:
    return hashlib.sha256(key).digest()


def _stamp(file: Path | None) -> tuple[int, int, int] | None:
    try:
        status = None if file is None else file.stat()
    except OSError:
        return None
    return None if status is None else (status.st_mtime_ns, status.st_size, status.st_ino)
