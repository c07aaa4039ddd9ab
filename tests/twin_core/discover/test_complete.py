"""What an effect that was found may also have: a heat that came on, and that went off again."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.helpers import conductive_spec, record_of
from twin_core.closed_loop import close_loop
from twin_core.network.spec_io import load_spec

CAPACITY_J_PER_K, STRAP_W_PER_K, LEAK_W_PER_K, NOISE_K = np.array([4.0e3, 9.0e3]), 2.0, 0.7, 0.05
BEGUN_S, ENDED_S, HEAT_W = 15_030.0, 30_090.0, 9.0


@pytest.mark.parametrize("ended_s", [pytest.param(ENDED_S, marks=pytest.mark.long), np.inf], ids=["ends", "stays"])
def test_a_load_that_ended_is_told_with_its_end_and_no_other_has_one(ended_s: float) -> None:
    """SciPy integrates the truth, one constant heat after the other; the last 30 % are held out."""
    time_s = np.arange(0.0, 72_000.0, 60.0)
    power_W = 20.0 + 12.0 * np.sign(np.sin(2.0 * np.pi * time_s / 7_000.0))

    def rates(t: float, x: np.ndarray) -> np.ndarray:
        strap = STRAP_W_PER_K * (x[1] - x[0])
        load = HEAT_W if BEGUN_S <= t < ended_s else 0.0
        declared = power_W[min(int(t / 60.0), time_s.size - 1)]
        return np.array([strap + declared, -strap + LEAK_W_PER_K * (280.0 - x[1]) + load]) / CAPACITY_J_PER_K

    truth = solve_ivp(rates, (0.0, time_s[-1]), [310.0, 305.0], t_eval=time_s, max_step=30.0, rtol=1e-8).y
    read = truth + np.random.default_rng(5).normal(0.0, NOISE_K, truth.shape)
    spec = load_spec(
        conductive_spec(
            2,
            [(0, 1)],
            channels={"Q": {"kind": "power", "unit": "W"}},
            boundaries={"room": {"value_K": 280.0}},
            loads=[{"channel": "Q", "node": "n0"}],
        )
        | {
            "conductors": [
                {"between": ["n0", "n1"], "conductance_W_per_K": {"guess": 1.0}},
                {"between": ["n1", "room"], "conductance_W_per_K": {"guess": 1.0}},
            ]
        }
    )
    report = close_loop(spec, [record_of(time_s, T0=read[0], T1=read[1], Q=power_W)], holdout=0.3).report
    (finding,) = report["findings"]
    assert (finding["effect"], finding["where"]) == ("heat_load_step", {"node": "n1"})
    told = finding["parameters"]
    assert told["Q_W"]["mean"] == pytest.approx(HEAT_W, abs=max(4.0 * told["Q_W"]["std"], 0.02))
    assert told["time"]["mean"] == pytest.approx(BEGUN_S, abs=60.0)
    assert ("stop" in told) == np.isfinite(ended_s)
    if "stop" in told:
        assert told["stop"]["mean"] == pytest.approx(ended_s, abs=60.0)
    assert report["after"]["rmse_K"] < 1.1 * NOISE_K
