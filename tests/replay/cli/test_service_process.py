"""The service as a process: it comes up on a port of its own and is gone afterwards, whatever happens."""

import urllib.request
from pathlib import Path

import pytest

from replay.cli.service_process import ServiceFailed, running_service


def is_up(url: str) -> bool:
    try:
        with urllib.request.urlopen(f"{url}/healthz", timeout=5) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False


@pytest.mark.e2e
def test_two_at_once_and_none_afterwards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TWIN_API_KEYS", "read:from-outside")  # must not reach the private service
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    with running_service(tmp_path / "a") as first, running_service(tmp_path / "b") as second:
        assert first != second and is_up(first) and is_up(second)
    assert not is_up(first) and not is_up(second)
    assert (tmp_path / "a" / "twin.sqlite3").exists()


@pytest.mark.e2e
def test_gone_after_an_exception(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), running_service(tmp_path) as url:
        raise KeyboardInterrupt
    assert not is_up(url)


def test_failure_to_start_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "twin.sqlite3").mkdir()  # a folder where the database should be
    with pytest.raises(ServiceFailed, match="the service did not start: "), running_service(tmp_path):
        pytest.fail("started on a folder")
