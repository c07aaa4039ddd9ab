"""Giving room back to the file system, a little at a time."""

from service.store.connection import Connection

PAGES = 512
"""So many free pages are given back to the file system in one write."""


def vacuum(connection: Connection) -> int:
    """Give free pages back to the file system; files of earlier releases keep theirs for later use."""
    mode = connection.execute("PRAGMA auto_vacuum").fetchone()[0]
    free = connection.execute("PRAGMA freelist_count").fetchone()[0]
    if mode != 2 or free == 0:
        return 0
    connection.execute(f"PRAGMA incremental_vacuum({PAGES})").fetchall()
    return min(int(free), PAGES)
