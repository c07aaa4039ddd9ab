"""Fixtures of the deciding rooms."""

from typing import Any

import pytest

from twin_core import side_by_side
from twin_core.discover import coarseness, revision
from twin_core.discover.evidence import Validation
from twin_core.discover.trial import Trial


@pytest.fixture
def one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """All work is done in this process, where a test can count it."""
    monkeypatch.setattr(side_by_side, "n_cores", lambda: 1)


@pytest.fixture
def foreseen(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a stub foretells is what it says."""

    def told(simple: Trial, rich: Any) -> Validation:
        return Validation(rich.foresight, 1.0, rich.foresight, 0.1, 1.0)

    monkeypatch.setattr(coarseness, "validate", told)
    monkeypatch.setattr(revision, "validate", told)
