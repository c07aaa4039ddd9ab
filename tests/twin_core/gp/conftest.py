"""The dense oracle as a fixture, so that test files need no package around them."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def dense() -> ModuleType:
    """Return the module with the dense joint Gaussian."""
    path = Path(__file__).with_name("dense.py")
    spec = importlib.util.spec_from_file_location("gp_dense_oracle", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
