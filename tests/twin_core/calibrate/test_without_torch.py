"""The neural-ODE method without its extra: one line that says what to install."""

import sys

import numpy as np
import pytest

from tests.helpers import conductive_spec, record_of
from twin_core.calibrate import calibrate
from twin_core.errors import ModelError
from twin_core.network.spec_io import load_spec


@pytest.mark.parametrize("missing", ["torch", "torchdiffeq"])
def test_a_missing_extra_is_named(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [n for n in sys.modules if n.split(".")[0] == missing] + ["twin_core.calibrate.neural_ode"]:
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, missing, None)
    time_s = np.arange(0.0, 600.0, 10.0)
    record = record_of(time_s, T0=290.0 + time_s / 100.0, T1=280.0)
    with pytest.raises(ModelError, match=rf"needs {missing}, .*pip install torch torchdiffeq"):
        calibrate(load_spec(conductive_spec(2, [(0, 1)])), [record], method="neural-ode")
