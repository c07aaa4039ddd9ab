"""Compilation that counts against no deadline."""

import subprocess
import sys
from typing import Any, NoReturn

import numpy as np
import pytest

from tests.helpers import conductive_spec, record_of
from twin_core import closed_loop, compiled
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


LOOP = """
import sys
from numba.core.dispatcher import Dispatcher
from benchmarks.network_cases import network_case
from twin_core import compiled, side_by_side
from twin_core.closed_loop import close_loop

def known():
    modules = [module for name, module in sys.modules.items() if name.startswith("twin_core.")]
    loops = {value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}
    return {(str(loop), signature) for loop in loops for signature in loop.signatures}

side_by_side.n_cores = lambda: 1
compiled.compile_ahead()
before = known()
case = network_case("leak_to_boundary", 1, n_orbits=3, dt_s=300.0)
report = close_loop(case.spec, [case.record]).report
assert before and report["missing_heat"] and report["findings"]
print(sorted({name for name, _ in known() - before}))
"""


@pytest.mark.slow
def test_what_follows_a_search_is_compiled_ahead_too() -> None:
    """The heat was smoothed by loops that a fit does not use: the first report came ten seconds after its deadline."""
    run = subprocess.run([sys.executable, "-c", LOOP], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


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
