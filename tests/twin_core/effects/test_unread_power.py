"""A power in the telemetry that no load reads: SciPy integrates two blocks, of which it heats one."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from twin_core.closed_loop import close_loop
from twin_core.effects.channel_heat_load import ChannelHeatLoad
from twin_core.network.model import build_network
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

CAPACITY, LOSS, JOINT, WALL_K, NOISE_K, STEP_S, N_TIMES, SHARE = 600.0, (1.2, 0.5), 0.8, 280.0, 0.02, 60.0, 700, 0.6


def declared(*, loads: tuple[str, ...]) -> TwinSpec:
    """Return two blocks of which the first is heated by some of two powers."""
    return load_spec(
        {
            "twin": "t",
            "boundaries": {"wall": {"value_K": WALL_K}},
            "channels": {
                **{f"T_{node}": {"kind": "temperature", "unit": "K", "noise_std": NOISE_K} for node in "ab"},
                **{name: {"kind": "power", "unit": "W"} for name in ("Q", "P")},
            },
            "nodes": [{"id": n, "sensor": f"T_{n}", "capacity_J_per_K": {"guess": 500.0}} for n in "ab"],
            "conductors": [
                {"between": ["a", "wall"], "conductance_W_per_K": {"guess": 1.0}},
                {"between": ["b", "wall"], "conductance_W_per_K": {"guess": 1.0}},
                {"between": ["a", "b"], "conductance_W_per_K": {"guess": 1.0}},
            ],
            "loads": [{"channel": name, "node": "a"} for name in loads],
        }
    )


def places(spec: TwinSpec) -> list[tuple[str, str]]:
    return [(where["node"], where["channel"]) for where in ChannelHeatLoad.places(build_network(spec).layout)]


@pytest.mark.parametrize(
    ("loads", "unread"), [(("Q", "P"), []), (("Q",), ["P"]), ((), ["Q", "P"])], ids=["both read", "one", "none"]
)
def test_a_power_that_no_load_reads_may_heat_any_node(loads: tuple[str, ...], unread: list[str]) -> None:
    assert places(declared(loads=loads)) == [(node, channel) for node in "ab" for channel in unread]


def test_the_load_that_was_not_declared_is_found_in_proportion_to_its_power() -> None:
    """A share of ``P`` heats the second block: nothing periodic, no constant, and no more than that."""
    rng = np.random.default_rng(11)
    time_s = STEP_S * np.arange(N_TIMES)
    powers = [np.repeat(rng.uniform(0.0, 30.0, 1 + N_TIMES // n), n)[:N_TIMES] for n in (40, 23)]

    def rate(t: float, x: np.ndarray) -> list[float]:
        q, p = (power[min(int(t / STEP_S), N_TIMES - 1)] for power in powers)
        joint = JOINT * (x[1] - x[0])
        return [
            (q + LOSS[0] * (WALL_K - x[0]) + joint) / CAPACITY,
            (SHARE * p + LOSS[1] * (WALL_K - x[1]) - joint) / CAPACITY,
        ]

    exact = solve_ivp(rate, (0.0, time_s[-1]), [290.0, 285.0], t_eval=time_s, max_step=STEP_S, rtol=1e-8)
    read = exact.y + NOISE_K * rng.standard_normal(exact.y.shape)
    record = Record(time_s, {"T_a": read[0], "T_b": read[1], "Q": powers[0], "P": powers[1]})
    report = close_loop(declared(loads=("Q",)), [record]).report
    (finding,) = report["findings"]
    assert (finding["effect"], finding["where"]) == ("channel_heat_load", {"node": "b", "channel": "P"})
    knots, values_W = (finding["parameters"][name]["mean"] for name in ("knots", "values_W"))
    assert len(knots) == 1  # in proportion
    assert values_W == pytest.approx([SHARE * knots[0]], abs=0.05)
    assert report["after"]["rmse_K"] == pytest.approx(NOISE_K, rel=0.1)
