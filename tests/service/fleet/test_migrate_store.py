"""``twin migrate-store`` keeps away from databases that somebody works on, and names what its user typed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from replay.cli.main import main
from tests.service.fakes import FakeWorkbench
from tests.service.fleet.load import LOGGED, WORKER, fleet, prepare
from tests.service.harness import AppClient, until
from tests.service.server import FAKE

pytestmark = pytest.mark.fleet
Capture = pytest.CaptureFixture[str]


def moved(source: str, target: Path | str) -> int:
    return main(["migrate-store", source, str(target)])


@pytest.mark.parametrize(("command", "assimilate"), [(FAKE, "true"), (FAKE, "false"), (LOGGED + WORKER, "true")])
def test_what_somebody_works_on_stays(
    tmp_path: Path, postgres: str, capsys: Capture, command: str, assimilate: str
) -> None:
    """Services that follow twins, services that only take samples in, and workers that have nothing to do."""
    prepare(postgres, 1, is_watched=False)
    target = f"sqlite:///{tmp_path / 'copy.sqlite3'}"
    with fleet(tmp_path, [postgres], [command], assimilate=assimilate) as (at_work,):
        assert moved(postgres, target) == 2
        told = capsys.readouterr().err
        assert "FROM" in told and "is at work on it" in told and "TWIN_DATABASE_URL" not in told
        at_work.stop()
    assert moved(postgres, target) == 0


def test_nothing_is_written_where_a_service_runs(
    tmp_path: Path, postgres: str, make_client: Callable[..., Any], capsys: Capture
) -> None:
    source = f"sqlite:///{tmp_path / 'source.sqlite3'}"
    make_client(workbench=FakeWorkbench, database_url=source).close()
    client: AppClient = make_client(workbench=FakeWorkbench, database_url=postgres)
    assert moved(source, postgres) == 2
    assert "TO postgresql://twin@127.0.0.1:" in (told := capsys.readouterr().err) and "is at work on it" in told
    client.close()
    assert moved(source, postgres) == 0


def test_who_was_killed_is_waited_for_no_longer_than_a_lease(tmp_path: Path, postgres: str) -> None:
    with fleet(tmp_path, [postgres]) as (service,):
        service.kill()
    target = iter(range(1000))
    assert until(lambda: moved(postgres, f"sqlite:///{tmp_path / f'copy{next(target)}.sqlite3'}") == 0)


@pytest.mark.parametrize(
    ("source", "shown"),
    [
        ("postgresql://twin:hunter2@127.0.0.1:1/none", "FROM postgresql://twin@127.0.0.1:1/none: the database cannot"),
        ("postgresql://127.0.0.1:1/none?user=twin&password=hunter2", "FROM postgresql://127.0.0.1:1/none: "),
        ("postgresql://twin:hunter2/x@127.0.0.1:1/none", "FROM: "),
        ("postgresql://twin:ab@hunter2#x@127.0.0.1:1/none", "FROM: "),
        ("postgresql://twin:1/hunter2@127.0.0.1:1/none", "FROM: "),
        ("mysql://twin:hunter2@db/none", "FROM: must be sqlite:///FILE"),
        ("sqlite:////nowhere/hunter2-not.sqlite3", "there is no such file"),
    ],
)
def test_errors_name_what_was_typed(tmp_path: Path, capsys: Capture, source: str, shown: str) -> None:
    assert moved(source, f"sqlite:///{tmp_path / 'copy.sqlite3'}") == 2
    told = capsys.readouterr().err
    assert shown in told and "TWIN_DATABASE_URL" not in told and told.count("\n") == 1
    assert "hunter2" not in told or source.startswith("sqlite")


def test_a_target_that_cannot_be_used_is_named(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "a.sqlite3").touch()
    assert moved(f"sqlite:///{tmp_path / 'a.sqlite3'}", "sqlite:////nowhere/b.sqlite3") == 2
    assert "check TO" in capsys.readouterr().err
    assert moved(f"sqlite:///{tmp_path / 'a.sqlite3'}", "elsewhere") == 2
    assert "TO: must be sqlite:///FILE" in capsys.readouterr().err
