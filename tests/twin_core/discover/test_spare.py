"""What readings do not pay for is taken from an effect: a block by SciPy whose periodic load has a mean, or none."""

import numpy as np
import pytest

from tests.twin_core.discover.test_wald import TIME_S, N, trials
from twin_core.discover.evidence import weigh
from twin_core.discover.spare import without_spare
from twin_core.effects import REGISTRY

PERIOD_S = 1900.0


@pytest.mark.parametrize(("mean_W", "is_kept"), [(0.0, False), (4.0, True)], ids=["no mean", "a mean"])
def test_a_mean_is_kept_where_readings_pay_for_it(mean_W: float, is_kept: bool) -> None:
    start = {"Q_W": 0.1, "A_W": 0.1, "B_W": 1.5, "P_s": PERIOD_S}
    effect = REGISTRY["periodic_heat_load"]({"node": "block"}, start, {"origin_s": 0.0, "dated": False})
    simple, rich = trials(effect, mean_W + 2.0 * np.cos(2.0 * np.pi * TIME_S / PERIOD_S), 3000.0)
    found = without_spare(simple, rich)
    (kept,) = found.present_effects
    assert (found is rich) == is_kept
    assert kept.held == (() if is_kept else ("Q_W",))
    assert kept.values["Q_W"] == pytest.approx(mean_W, abs=1.0 if is_kept else 0.0)
    assert kept.values["B_W"] == pytest.approx(2.0, abs=0.3)
    if not is_kept:
        assert -0.5 * np.log(N) <= weigh(found, rich, 1).log_bayes_factor <= 0.0


def test_an_effect_of_the_simpler_trial_is_left_as_it_is() -> None:
    start = {"Q_W": 0.1, "A_W": 0.1, "B_W": 1.5, "P_s": PERIOD_S}
    effect = REGISTRY["periodic_heat_load"]({"node": "block"}, start, {"origin_s": 0.0, "dated": False})
    _, rich = trials(effect, 2.0 * np.cos(2.0 * np.pi * TIME_S / PERIOD_S), 3000.0)
    assert without_spare(rich, rich) is rich
