"""Compilation that counts against no deadline."""

from typing import Any, NoReturn

import numpy as np
import pytest

from tests.helpers import conductive_spec, record_of
from twin_core import closed_loop
from twin_core.calibrate import compiled
from twin_core.errors import NoSolutionError, TwinError
from twin_core.network.spec_io import load_spec


def test_a_deadline_begins_after_compilation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a minute of it would leave nothing of a short deadline."""
    now_s, seen = [1000.0], []

    def compiles() -> None:
        now_s[0] += 500.0

    def fits(*given: Any, deadline: float, **options: Any) -> NoReturn:
        seen.append(deadline)
        raise TwinError("that is all")

    monkeypatch.setattr(compiled, "compile_ahead", compiles)
    monkeypatch.setattr(closed_loop, "fit_network", fits)
    monkeypatch.setattr(compiled.time, "monotonic", lambda: now_s[0])
    record = record_of(60.0 * np.arange(50), T0=290.0, T1=280.0)
    with pytest.raises(TwinError, match="that is all"):
        closed_loop.close_loop(load_spec(conductive_spec(2, [(0, 1)])), [record], deadline_s=10.0)
    assert seen == [1510.0]
    assert compiled.deadline_after(None) == float("inf")


def test_a_fit_that_fails_is_no_reason_to_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[object] = []

    def fails(*given: object) -> NoReturn:
        tried.append(given)
        raise NoSolutionError("calibration failed")

    monkeypatch.setattr(compiled, "fit_network", fails)
    compiled.compile_ahead.cache_clear()
    compiled.compile_ahead()
    compiled.compile_ahead.cache_clear()
    assert len(tried) == 1
