"""Schema steps of a SQLite file, each applied once and recorded in the transaction that applies it."""

import sqlite3

from service.store.connection import Connection
from service.store.schema import STEPS, statements


def migrate(connection: Connection) -> list[str]:
    """Apply the steps that this database has not seen; return their names.

    Raises
    ------
    sqlite3.DatabaseError
        If the file is not a database, or was written by a newer version of the service.
    """
    connection.execute(
        "CREATE TABLE IF NOT EXISTS migration (name TEXT PRIMARY KEY, at TEXT DEFAULT CURRENT_TIMESTAMP)"
    )
    done = {name for (name,) in connection.execute("SELECT name FROM migration")}
    unknown = done - {name for name, _ in STEPS}
    if unknown:
        raise sqlite3.DatabaseError(f"it was written by a newer version (step '{sorted(unknown)[0]}')")
    applied = []
    for name, script in STEPS:
        if name not in done:
            connection.execute("BEGIN IMMEDIATE")
            for statement in statements(script):  # executescript would commit the transaction they belong to
                connection.execute(statement)
            connection.execute("INSERT INTO migration (name) VALUES (?)", (name,))
            connection.execute("COMMIT")
            applied.append(name)
    return applied
