"""The dense oracle of the filter's tests, for the latent force."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def dense() -> ModuleType:
    """Return the module with the dense joint Gaussian."""
    path = Path(__file__).parents[1] / "gp" / "dense.py"
    spec = importlib.util.spec_from_file_location("gp_dense_oracle", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
