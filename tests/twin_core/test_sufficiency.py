"""The anytime-valid test: its expectation by enumeration, its growth by hand, its maxima and discoveries by integration."""

from itertools import combinations

import numpy as np
import pytest
from scipy.integrate import quad

from twin_core.anomaly import adjusted, discoveries
from twin_core.anomaly.sufficiency import CUT, LARGEST, LEAVING, TOLERANCE, follow_evidence, sizes

N_STEPS = 12
SPREAD = {
    "sensors": {"T": {"n": 0, "mean": 0.0, "log": 0.0, "shares": [1.0 / sizes().size] * sizes().size}},
    "most": 0.0,
}
"""A start in which every alternative has its part of the wealth already, so that a few steps count for something."""


def every_path(low: float, high: float, chance: float, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the wealth at the end of every path of a two-valued law, and the path's probability, (2^N_STEPS,) each."""
    ups = (np.arange(2**N_STEPS)[:, None] >> np.arange(N_STEPS)) & 1
    paths = np.where(ups == 1, high, low)
    wealth = np.exp([follow_evidence(SPREAD, ["T"], path[:, None], tolerance)[1][-1] for path in paths])
    weight = np.prod(np.where(ups == 1, chance, 1.0 - chance), axis=1)
    return wealth, weight


@pytest.mark.parametrize(("low", "high"), [(-1.0, 1.0), (-0.5, 2.5), (-40.0, 1.0)])
def test_without_tolerance_the_expectation_over_all_paths_is_one(low: float, high: float) -> None:
    cut = max(low, -CUT)
    wealth, weight = every_path(low, high, -cut / (high - cut), 0.0)
    assert weight @ wealth == pytest.approx(1.0, abs=1e-12)
    assert wealth.std() > 0.1


@pytest.mark.parametrize("mean", [-TOLERANCE, 0.0, 0.1, TOLERANCE])
def test_within_the_tolerance_the_expectation_is_at_most_one(mean: float) -> None:
    wealth, weight = every_path(-1.0, 1.0, 0.5 * (1.0 + mean), TOLERANCE)
    assert weight @ wealth < 1.0 + 1e-12


def test_a_law_that_looks_back_gains_nothing_within_the_tolerance() -> None:
    """The mean of each step depends on the step before: every path is weighed by its own chances."""
    ups = (np.arange(2**N_STEPS)[:, None] >> np.arange(N_STEPS)) & 1
    paths = 2.0 * ups - 1.0
    wealth = np.exp([follow_evidence(SPREAD, ["T"], path[:, None])[1][-1] for path in paths])
    before = np.hstack([np.zeros((paths.shape[0], 1)), paths[:, :-1]])
    weight = np.prod(0.5 * (1.0 + TOLERANCE * before * paths), axis=1)
    assert weight.sum() == pytest.approx(1.0)
    assert weight @ wealth < 1.0 + 1e-12


def test_a_gross_bias_multiplies_the_wealth_by_what_the_largest_alternative_says() -> None:
    _, log = follow_evidence(None, ["T"], np.full((400, 1), 100.0))
    factor = (1.0 - LEAVING) * (1.0 + LARGEST * (CUT - TOLERANCE) / (CUT + TOLERANCE))
    # What the largest alternative gives back reaches it again but for a little.
    assert np.log(factor) < (log[-1] - log[200]) / 199 < np.log(factor / (1.0 - LEAVING))


def test_every_alternative_can_lose_and_never_all() -> None:
    worst = 1.0 - np.abs(sizes()) * (CUT + TOLERANCE)
    assert (worst[1:] < 1.0).all() and worst.min() == pytest.approx(1.0 - LARGEST)


def test_stretches_give_what_the_whole_gives() -> None:
    rng = np.random.default_rng(0)
    scaled = rng.normal(0.8, 1.0, (300, 2))
    scaled[rng.random((300, 2)) < 0.2] = np.nan
    state, whole = follow_evidence(None, ["a", "b"], scaled)
    carried, parts = None, []
    for part in np.split(scaled, [1, 2, 150, 150, 299]):
        carried, log = follow_evidence(carried, ["a", "b"], part)
        parts.append(log)
    np.testing.assert_allclose(np.concatenate(parts), whole, rtol=1e-12)
    assert carried is not None and carried["most"] == pytest.approx(state["most"]) == pytest.approx(whole.max())


def test_the_e_process_of_several_sensors_is_the_mean_of_theirs() -> None:
    scaled = np.random.default_rng(1).normal(0.6, 1.0, (200, 3))
    _, together = follow_evidence(None, ["a", "b", "c"], scaled)
    alone = [follow_evidence(None, ["a"], scaled[:, [k]])[1] for k in range(3)]
    np.testing.assert_allclose(np.exp(together), np.exp(alone).mean(axis=0), rtol=1e-9)


@pytest.mark.statistical
@pytest.mark.parametrize("law", ["normal", "heavy", "steps"])
def test_whoever_looks_at_every_sample_is_wrong_as_seldom_as_promised(law: str) -> None:
    rng = np.random.default_rng(2)
    draws = {
        "normal": lambda: rng.normal(size=(500, 400)),
        "heavy": lambda: rng.standard_t(2.2, size=(500, 400)),
        "steps": lambda: 2.0 * np.round(rng.normal(size=(500, 400)) / 2.0),
    }[law]()
    names = [str(k) for k in range(400)]
    state, _ = follow_evidence(None, names, draws, 0.0)  # no tolerance to hide behind; the highest of each at the end
    tops = [follow_evidence(None, ["T"], draws[:, [k]], 0.0)[0]["most"] for k in range(400)]
    # 5 % are allowed; 400 draws with exactly that rate exceed 32 once in a hundred times.
    assert sum(top > np.log(20.0) for top in tops) <= 32
    assert state["most"] < max(tops)


def test_the_adjuster_integrates_to_one() -> None:
    """An increasing A makes e-values of maxima if the integral of A(M) / M^2 from 1 is one; here u = log M."""
    near, _ = quad(lambda u: adjusted(u) * np.exp(-u), 0.0, 50.0, limit=200)
    far, _ = quad(lambda u: 1.0 / u**2, 50.0, np.inf)  # A(M) / M there, but for 1e-20
    assert near + far == pytest.approx(1.0, abs=1e-9)
    assert np.all(np.diff([adjusted(u) for u in np.linspace(0.0, 30.0, 400)]) > 0.0)
    assert adjusted(-3.0) == 0.5 and np.isfinite(adjusted(1e4))


def test_discoveries_are_the_largest_set_whose_least_member_pays_for_it() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        values = np.exp(rng.normal(2.0, 2.0, 7))
        best: tuple[int, ...] = ()
        for k in range(1, 8):
            for chosen in combinations(range(7), k):
                if min(values[list(chosen)]) >= 7 / (k * 0.2) and k > len(best):
                    best = chosen
        assert discoveries(values.tolist(), 0.2).sum() == len(best)
        assert set(best) <= set(np.flatnonzero(discoveries(values.tolist(), 0.2)).tolist())
    assert discoveries([], 0.1).size == 0
