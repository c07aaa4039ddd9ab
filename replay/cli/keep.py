"""``twin backup``, ``twin restore`` and ``twin migrate``: whole copies of the service's database."""

import re
from pathlib import Path

import click

from replay.cli.command import FILE, Command

DATABASE = click.option("--database", type=FILE, help="The service's file.  [default: as TWIN_DATABASE_URL says]")
AS_JSON = click.option("--json", "as_json", is_flag=True, help="Print the outcome as JSON.")


@click.command(
    cls=Command, short_help="Copy the service's database while it runs.", example="twin backup twin-copy.sqlite3"
)
@click.argument("file", type=FILE)
@DATABASE
@AS_JSON
def backup(file: Path, database: Path | None, as_json: bool) -> None:
    """Write a consistent copy of the service's database to FILE, also while it serves, and check it by reading all of it."""
    from service.store.sqlite.copies import backup as copy

    contents = copy(_file(database), file)
    _say({"file": str(file), **vars(contents)}, f"{file}: {contents.words}, checked", as_json)


@click.command(cls=Command, short_help="Put a backup in place.", example="twin restore twin-copy.sqlite3")
@click.argument("file", type=FILE)
@DATABASE
@AS_JSON
def restore(file: Path, database: Path | None, as_json: bool) -> None:
    """Check the backup FILE and put it in the place of the service's database; the service must not run.

    The former database stays beside it under another name.
    """
    from service.store.sqlite.copies import restore as put

    target = _file(database)
    contents, former = put(file, target)
    kept = f"; the former one is {former}" if former else ""
    outcome = {"file": str(target), "former": None if former is None else str(former), **vars(contents)}
    _say(outcome, f"{target}: {contents.words}, checked{kept}", as_json)


@click.command(cls=Command, short_help="Bring the database up to date.", example="twin migrate --rehearse")
@click.option("--rehearse", is_flag=True, help="Try it on a copy and leave the database as it is.")
@DATABASE
@AS_JSON
def migrate(rehearse: bool, database: Path | None, as_json: bool) -> None:
    """Apply the schema steps that the service would apply at its start; --rehearse tries them on a copy, also while it serves."""
    import tempfile

    from service.store.database import Database
    from service.store.sqlite import copies

    path = _file(database)
    folder = path.resolve().parent
    with tempfile.TemporaryDirectory(prefix="twin-", dir=folder) as name:  # where there is room for a copy
        made = copies.rehearse(path, Path(name))
    if not rehearse:
        Database(path).close()
    words = ", ".join(made.steps) if made.steps else "nothing to do"
    tried = " (on a copy)" if rehearse else ""
    _say(
        {"steps": list(made.steps), "elapsed_s": made.elapsed_s, "rehearsed": rehearse},
        f"{path}: {words}{tried}, {made.elapsed_s:.1f} s; {made.after.words}, checked",
        as_json,
    )


@click.command(
    "migrate-store",
    cls=Command,
    short_help="Move everything to another database.",
    example="twin migrate-store sqlite:///thermal-twin.sqlite3 postgresql://twin@db/twin",
)
@click.argument("source", metavar="FROM")
@click.argument("target", metavar="TO")
@AS_JSON
def migrate_store(source: str, target: str, as_json: bool) -> None:
    """Copy the database FROM to the empty database TO, both given as for TWIN_DATABASE_URL, and compare checksums.

    The service must not run. FROM stays as it is. A password is best kept in PGPASSWORD or ~/.pgpass.
    """
    from replay.cli.console import print_line
    from service.settings import SettingsError, read_settings
    from service.store.transfer import transfer

    places, names = [], [_named("FROM", source), _named("TO", target)]
    for url, name in zip((source, target), names, strict=True):
        try:
            places.append(read_settings(host="127.0.0.1", database_url=url).database)
        except SettingsError as error:
            raise SettingsError(str(error).replace("TWIN_DATABASE_URL", name)) from None
    moved = transfer(places[0], places[1], (names[0], names[1]))
    if not as_json:
        for one in moved:
            print_line(f"{one.table:18}{one.rows:>12,} rows  {one.sha256[:16]}")
    rows = sum(one.rows for one in moved)
    _say({"tables": [vars(one) for one in moved]}, f"{rows:,} rows, checksums agree", as_json)


SHOWN = re.compile(
    r"postgresql://(?:(?P<user>[\w.-]*)(?::[^@/?#]*)?@)?(?P<place>[\w.,-]*(?::\d+)?/[\w.-]*)(?:\?[^@]*)?"
)
"""A URL of which is sure what in it is the password: it is shown without that, and without what follows a question mark."""


def _named(argument: str, url: str) -> str:
    """Return what errors call a database: the argument, and as much of the URL as is surely no secret."""
    if not url.startswith("postgresql:"):
        return argument
    found = SHOWN.fullmatch(url)
    if found is None:
        return argument
    user = f"{found['user']}@" if found["user"] else ""
    return f"{argument} postgresql://{user}{found['place']}"


def _file(database: Path | None) -> Path:
    from service.settings import read_settings

    return database or read_settings(host="127.0.0.1").database_path


def _say(outcome: dict[str, object], line: str, as_json: bool) -> None:
    from replay.cli.console import print_line, to_json

    print_line(to_json(outcome).rstrip() if as_json else line)
