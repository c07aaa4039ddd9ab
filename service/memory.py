"""How a process gives memory back to the system: the GNU allocator keeps what was freed unless it is told otherwise."""

import ctypes

_CHOOSE = getattr(ctypes.CDLL(None), "mallopt", None)
_TRIM = getattr(ctypes.CDLL(None), "malloc_trim", None)
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Numbers of its settings, as in its ``malloc.h``. With another allocator nothing here has an effect."""


def keep_freed(apart_bytes: int, kept_bytes: int | None = None) -> None:
    """Let this process give back pieces of ``apart_bytes`` as they are freed, and keep ``kept_bytes`` of smaller ones."""
    if _CHOOSE is None:
        return
    _CHOOSE(_MMAP_THRESHOLD, apart_bytes)
    if kept_bytes is not None:
        _CHOOSE(_TRIM_THRESHOLD, kept_bytes)


def give_back() -> None:
    """Give back what was freed between pieces that are still in use."""
    if _TRIM is not None:
        _TRIM(0)
