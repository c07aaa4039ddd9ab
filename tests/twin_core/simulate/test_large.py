"""Networks of many nodes: BLAS and the compiled loops give the same derivatives, whatever couples and drives the nodes."""

from unittest.mock import patch

import numpy as np
import pytest

import twin_core.simulate.large as large_module
import twin_core.simulate.response as response_module
from tests.twin_core.network.test_declared_terms import START_K, data, record
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.response import sensitivities
from twin_core.simulate.rollout import rollout


@pytest.mark.parametrize(
    ("with_start", "sparse", "most"), [(False, 0.0, 10**9), (True, np.inf, 10**9), (True, np.inf, 40)]
)
def test_both_ways_agree(with_start: bool, sparse: float, most: int) -> None:
    network = build_network(load_spec(data()))
    forcing = build_forcing(network, record(), 25.0)
    parameters, start = network.parameters, np.array(list(START_K.values()))
    path = rollout(network, parameters.values, start, forcing)
    n = parameters.free.size
    columns = np.concatenate([np.zeros((4, n)), np.eye(4)], axis=1) if with_start else np.zeros((4, n))

    def found() -> np.ndarray:
        blocks = sensitivities(network, parameters.values, forcing, path, columns, np.array([2, 0]))
        return np.concatenate([block for _, block in blocks])

    small = found()
    with (
        patch.object(response_module, "MANY", 1),
        patch.object(large_module, "SPARSE", sparse),
        patch.multiple(response_module, MOST_VALUES=most, LEAST_STEPS=7),
    ):
        large = found()
    np.testing.assert_allclose(large, small, atol=1e-9 * np.abs(small).max())
