"""Trials and their evidence: errors on left-out blocks against true refits, and what evidence pays for."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import logsumexp
from scipy.stats import chi2

from tests.analytic import laplacian, linear_states
from tests.helpers import conductive_spec, record_of
from tests.twin_core.discover.stubs import stub
from twin_core._typing import FloatArray
from twin_core.calibrate.optimise import Optimum, minimise
from twin_core.calibrate.problem import Problem
from twin_core.calibrate.second_order import fit_network
from twin_core.calibrate.undeclared.fit import fit_with_undeclared_heat
from twin_core.discover import evidence as evidence_module
from twin_core.discover import trial as trial_module
from twin_core.discover.evidence import validate, weigh
from twin_core.discover.left_out import N_BLOCKS, blocked_errors
from twin_core.discover.policy import FORESIGHT
from twin_core.discover.trial import Trial, converged, try_effects
from twin_core.effects import REGISTRY
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec
from twin_core.telemetry import Record

NOISE_K = 0.1


def spec() -> TwinSpec:
    power = {"kind": "power", "unit": "W"}
    data = conductive_spec(2, [(0, 1)], channels={"Q": power}, loads=[{"channel": "Q", "node": "n0"}])
    for sensor in ("T0", "T1"):
        data["channels"][sensor]["noise_std"] = NOISE_K
    return load_spec(data)


def record(missing_W: float, from_sample: int = 0) -> Record:
    rng = np.random.default_rng(0)
    time_s, heat = 60.0 * np.arange(200), np.repeat(rng.choice([0.0, 40.0, 90.0], 20), 10)
    capacity = np.array([4.0e3, 7.0e3])
    rates = -laplacian(2, [(0, 1)], [2.5]) / capacity[:, None]
    missing = np.where(np.arange(200) < from_sample, 0.0, missing_W)
    drive = np.stack([heat, missing], axis=1) / capacity
    read = linear_states(rates, drive, np.array([290.0, 288.0]), time_s) + rng.normal(0.0, NOISE_K, (200, 2))
    return record_of(time_s, Q=heat, T0=read[:, 0], T1=read[:, 1])


def declared(missing_W: float, from_sample: int = 0) -> Trial:
    fit, calibration = fit_network(spec(), [record(missing_W, from_sample)])
    return Trial((), fit, calibration.max_step_s, (calibration.optimum,))


def test_an_effect_that_starts_far_too_large_ends_no_less_likely_than_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """At no amplitude the richer model is the simpler one; a few passes that only shrink the amplitude do not get there."""
    base = declared(0.0)
    vast = REGISTRY["radiative_exchange"]({"nodes": ("n0", "n1")}, {"R_m2": 10.0})
    assert try_effects(base, [vast]).fit.log_posterior > base.fit.log_posterior - 3.0
    monkeypatch.setattr(trial_module, "START_LOSS_NATS", np.inf)
    assert try_effects(base, [vast]).fit.log_posterior < base.fit.log_posterior - 30.0


def test_an_effect_that_leaves_no_heat_balance_where_it_starts_starts_smaller() -> None:
    """A load may be larger than what a node can lose: a start without a trajectory is no reason to refuse the effect."""
    data = conductive_spec(1, [], boundaries={"space": {"value_K": 3.0}})
    data["radiators"] = [{"node": "n0", "sink": "space", "area_m2": 0.1, "emissivity": 0.9}]
    data["nodes"][0]["capacity_J_per_K"] = {"value": 4.0e3}
    data["channels"]["T0"]["noise_std"] = NOISE_K
    rng = np.random.default_rng(0)
    constant = 0.09 * 5.670374419e-8  # W/K^4
    time_s, level_W = np.linspace(0.0, 12000.0, 201), constant * 290.0**4
    path = solve_ivp(
        lambda t, y: (level_W - constant * y**4) / 4.0e3, (0.0, 12000.0), [330.0], t_eval=time_s, rtol=1e-8
    )
    fit, calibration = fit_network(
        load_spec(data), [record_of(time_s, T0=path.y[0] + rng.normal(0.0, NOISE_K, time_s.size))]
    )
    base = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
    chill = REGISTRY["constant_heat_load"]({"node": "n0"}, {"Q_W": -1e4})
    trial = trial_module.try_on_trajectories(base, (chill,))
    assert trial is not None
    assert trial.effects[0].values["Q_W"] == pytest.approx(level_W, rel=0.02)


def test_trajectories_are_fitted_from_where_the_undeclared_heat_left_the_parameters_too(
    trials: tuple[Trial, Trial], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Much may be missing: then parameters that had to follow long trajectories alone lie far from where an effect belongs."""
    base, right = trials
    capacity = base.fit.problem.network.parameters.free_names.index("C:n0")
    astray = base.calibration().optimum.unknowns.copy()
    astray[capacity] += 3.0
    lost = replace(base.calibration(), optimum=replace(base.calibration().optimum, unknowns=astray))
    started: list[float] = []

    def caught(problem: Problem, unknowns: FloatArray, *, goal: float) -> Optimum:
        """Return where a search ends that leaves no valley: where it has begun."""
        started.append(float(unknowns[problem.network.parameters.free_names.index("C:n0")]))
        return minimise(problem, unknowns, max_iterations=0, goal=goal)

    monkeypatch.setattr(trial_module, "minimise", caught)
    effect = right.effects[0]
    for beside_heat, begun in ((False, [astray[capacity]]), (True, [astray[capacity], base.fit.free[capacity]])):
        started.clear()
        trial = trial_module.try_on_trajectories(base, (effect,), lost, beside_heat=beside_heat)
        assert trial is not None and started == begun
        assert trial.fit.free[capacity] == begun[-1]


def test_an_effect_of_no_size_gains_nothing_over_a_fit_that_has_converged() -> None:
    """A fit that ended early leaves to whatever is added next what its own next passes would have gained."""
    base = declared(0.0)
    large = replace(base.fit.undeclared, std_W=100.0 * base.fit.undeclared.std_W)
    near = replace(base.fit, undeclared=large)
    early = replace(base, fit=fit_with_undeclared_heat(near.problem, near.free, near=near, n_passes=1))
    settled = converged(early)
    assert settled.fit.log_posterior > early.fit.log_posterior + 1.0
    assert converged(settled) is settled
    nothing = REGISTRY["constant_heat_load"]({"node": "n1"}, {"Q_W": 1e-6})
    assert try_effects(settled, [nothing], n_passes=12).fit.log_posterior < settled.fit.log_posterior + 2.0
    assert try_effects(early, [nothing], n_passes=12).fit.log_posterior > early.fit.log_posterior + 1.0


def test_a_share_of_an_effect_lies_between_it_and_none() -> None:
    gain = REGISTRY["input_gain"]({"channel": "Q"}, {"g": 3.0})
    assert gain.shortened(0.25).values == {"g": 1.5}
    heater = REGISTRY["constant_heat_load"]({"node": "n0"}, {"Q_W": -4.0})
    assert heater.shortened(0.25).values == {"Q_W": -1.0}


def test_left_out_blocks_are_predicted_as_by_a_refit() -> None:
    """The formula for leaving a block out against a true fit without it; nearly linear, so they agree to a few percent."""
    calibration = declared(0.0).calibration()
    found = blocked_errors(calibration)[0]
    problem = calibration.problem
    (segment,) = problem.segments
    edges = np.linspace(0, segment.measured_K.shape[0], N_BLOCKS + 1).astype(int)
    expected = []
    for first, last in pairwise(edges.tolist()):
        row = np.arange(segment.measured_K.shape[0])
        inside = (row >= max(first, 20)) & (row < last)  # of 200 samples the first 20 tell the initial state
        rest = replace(segment, measured_K=np.where(inside[:, None], np.nan, segment.measured_K))
        optimum = minimise(replace(problem, segments=(rest,)), calibration.optimum.unknowns)
        error = (segment.measured_K - optimum.fit.predicted_K[0])[inside] / problem.noise_K
        expected.append(float((error**2).sum()))
    np.testing.assert_allclose(found, expected, rtol=0.05)


def session(levels_W: list[float], gain: float, exponent: float) -> Record:
    """Return a run of which ``gain * heat * (heat / 60 W)^(exponent - 1)`` is delivered."""
    rng = np.random.default_rng(int(sum(levels_W)))
    time_s, heat = 60.0 * np.arange(200), np.repeat(rng.choice(levels_W, 20), 10)
    capacity = np.array([4.0e3, 7.0e3])
    rates = -laplacian(2, [(0, 1)], [2.5]) / capacity[:, None]
    delivered = gain * heat * (np.maximum(heat, 1e-9) / 60.0) ** (exponent - 1.0)
    drive = np.stack([delivered, np.zeros(200)], axis=1) / capacity
    read = linear_states(rates, drive, np.array([290.0, 288.0]), time_s) + rng.normal(0.0, NOISE_K, (200, 2))
    return record_of(time_s, Q=heat, T0=read[:, 0], T1=read[:, 1])


@pytest.mark.parametrize(("gains", "exponent", "is_law"), [((1.0, 1.1), 1.0, False), ((1.0, 1.0), 1.2, True)])
def test_what_changes_between_sessions_is_no_law(gains: tuple[float, float], exponent: float, is_law: bool) -> None:
    """A heater that delivers more in the second session, at higher power, looks like a power law on both together."""
    records = [session([0.0, 40.0, 60.0], gains[0], exponent), session([0.0, 70.0, 90.0], gains[1], exponent)]
    fit, calibration = fit_network(spec(), records)
    base = Trial((), fit, calibration.max_step_s, (calibration.optimum,))
    law = REGISTRY["input_power_law"]({"channel": "Q"}, {"n": 1.1}, {"reference": 60.0})
    trial = try_effects(base, [law], n_passes=10)
    validation = validate(base, trial)
    assert validation.ratio < 0.5
    assert (validation.forward_ratio < 0.5) == is_law
    assert (validation.foresight < FORESIGHT) == is_law


@pytest.mark.parametrize("share", [0.4, 0.645, 0.8, 0.95])
def test_what_follows_an_event_is_foretold_by_what_has_seen_it(share: float) -> None:
    """The usual beginning, 65 % of the record, knows nothing of an event at its end."""
    base = declared(20.0, int(200 * share))
    clock = {"begin_s": 0.0, "span_s": 60.0 * 199, "width_s": 60.0, "dated": False}
    step = REGISTRY["heat_load_step"]({"node": "n1"}, {"Q_W": 15.0, "time": 60.0 * 200 * share}, clock)
    trial = try_effects(base, [step], n_passes=12)
    assert trial.effects[0].values["Q_W"] == pytest.approx(20.0, rel=0.2)
    assert validate(base, trial).forward_ratio < 0.5


@pytest.fixture(scope="module")
def trials() -> tuple[Trial, Trial]:
    """Return the declared model where 6 W are missing, and the same with a constant heat."""
    base = declared(6.0)
    start = REGISTRY["constant_heat_load"]({"node": "n1"}, {"Q_W": 1.0})
    return base, try_effects(base, [start], n_passes=12)


def test_the_right_effect_is_fitted_and_supported(trials: tuple[Trial, Trial]) -> None:
    base, right = trials
    assert right.effects[0].values["Q_W"] == pytest.approx(6.0, rel=0.1)
    evidence = weigh(base, right, 10)
    assert evidence.log_bayes_factor > 10.0
    assert evidence.p_value < 1e-4
    validation = validate(base, right)
    assert validation.ratio < 0.5
    assert validation.blocks_better > 0.7


def test_evidence_pays_for_parameters_and_candidates(trials: tuple[Trial, Trial]) -> None:
    """Schwarz: half ln n per parameter; ln m for m candidates; the p-value after Wilks and Bonferroni.

    Wandering heat and misfit at the sensors are averaged over, as likelihoods and not as their logarithms.
    """
    base, right = trials
    both = [[t.fit.log_posterior, t.calibration().log_posterior] for t in (base, right)]
    gain = float(np.diff(logsumexp(both, axis=1, b=0.5))[0])
    assert weigh(base, right, 1, quick=True).log_bayes_factor <= weigh(base, right, 1).log_bayes_factor
    for tried in (1, 40):
        evidence = weigh(base, right, tried)
        assert evidence.log_bayes_factor == pytest.approx(gain - 0.5 * np.log(400) - np.log(tried))
        assert evidence.p_value == pytest.approx(min(1.0, tried * chi2.sf(2.0 * gain, 1)))


def test_an_instant_is_paid_for_as_one_among_all_samples() -> None:
    """The oracle adds up the evidence of a step of unit-information prior at each of n instants, in closed form.

    An instant is told to a few samples whatever n is, not to a share that falls with its root, as Schwarz has it.
    """
    excess = []
    for n in (400, 4000, 40000):
        values = np.random.default_rng(n).standard_normal(n) + np.where(np.arange(n) < 0.4 * n, 0.0, 1.0)
        later = np.arange(n - 1, 0, -1)  # samples from each instant on
        sums = np.cumsum(values[::-1])[::-1][1:]
        gains = 0.5 * sums**2 / later
        exact = logsumexp(gains * later / (later + 1.0) - 0.5 * np.log1p(later)) - np.log(n - 1.0)
        clock = {"begin_s": 0.0, "span_s": 1.0, "width_s": 1.0, "dated": False}
        step = REGISTRY["heat_load_step"]({"node": "n1"}, {"Q_W": 1.0, "time": 0.4}, clock)
        simple, rich = stub(n_free=3), stub(step, n_free=5)
        simple, rich = replace(simple, n_samples=n), replace(rich, n_samples=n)
        excess.append(evidence_module.paid(float(gains.max()), simple, rich, 1) - exact)
    assert np.ptp(excess) < 1.5 and np.abs(excess).max() < 3.0


def test_a_superfluous_effect_is_not_supported() -> None:
    base = declared(0.0)
    useless = REGISTRY["constant_heat_load"]({"node": "n1"}, {"Q_W": 0.0})
    evidence = weigh(base, try_effects(base, [useless], n_passes=12), 1)
    assert evidence.log_bayes_factor < 0.0
    assert evidence.p_value > 1e-3


def test_a_simpler_model_that_runs_away_where_a_block_is_left_out_makes_an_effect_no_better(
    trials: tuple[Trial, Trial], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Parameters that a single block tells are anything without it."""
    base, right = trials
    before, after = (np.nanmean(np.concatenate(trial.calibration().residuals) ** 2) for trial in trials)
    monkeypatch.setattr(Trial, "block_errors", lambda own: np.full((2, N_BLOCKS), 1e9 if own is base else 1.0))
    assert validate(base, right).ratio == pytest.approx(np.sqrt(after / before))


@pytest.mark.parametrize("worse", [0, 1])
def test_where_refits_differ_the_less_favourable_one_counts(
    trials: tuple[Trial, Trial], monkeypatch: pytest.MonkeyPatch, worse: int
) -> None:
    """Beside the sensors' own noise, or beside the noise that lasts."""
    base, right = trials
    after = np.full(2, 1.0)
    after[worse] = 9.0
    monkeypatch.setattr(
        Trial, "block_errors", lambda own: (np.full(2, 4.0) if own is base else after)[:, None] * np.ones((2, N_BLOCKS))
    )
    monkeypatch.setattr(Trial, "forward_error", lambda own: np.full(2, 40.0) if own is base else 10.0 * after)
    validation = validate(base, right)
    assert (validation.ratio, validation.forward_ratio, validation.blocks_better) == (1.5, 1.5, 0.0)


@pytest.mark.parametrize(
    ("before", "after", "ratio", "at_best"),
    [
        (1.8, 4.9, 1.0, np.sqrt(0.5)),
        (1.8, 20.0, 2.0, np.sqrt(16.0 / 1.8)),
        (40.0, 90.0, 1.5, np.sqrt(86.0 / 40.0)),
        (4.0, 1.0, 0.5, 0.0),
        (90.0, 4.0, 2.0 / np.sqrt(90.0), 0.0),
        (200.0, 200.0, 1.0, np.sqrt(0.98)),
    ],
    ids=["as any coarse network", "beyond it", "both beyond it", "better within it", "better", "far beyond it"],
)
def test_what_any_coarse_network_may_miss_is_not_held_against_what_follows(
    trials: tuple[Trial, Trial],
    monkeypatch: pytest.MonkeyPatch,
    before: float,
    after: float,
    ratio: float,
    at_best: float,
) -> None:
    """Mean squares in units of the noise, of which a coarse network leaves up to 1 + 4."""
    base, right = trials
    monkeypatch.setattr(Trial, "forward_error", lambda own: np.full(2, before if own is base else after))
    validation = validate(base, right)
    assert validation.forward_ratio == pytest.approx(ratio)
    assert validation.forward_at_best == pytest.approx(at_best)


def test_a_correction_is_validated_as_it_is_handed_out(
    trials: tuple[Trial, Trial], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without gradients within the nodes: beside them a second name halved what it was not fitted to, and was worse than none."""
    base, right = (replace(trial) for trial in trials)

    def beside(own: Trial) -> None:
        raise AssertionError("gradients are not handed out")

    monkeypatch.setattr(Trial, "beside_gradients", beside)
    assert validate(base, right).foresight < 0.5
