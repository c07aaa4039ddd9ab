"""Evidence: what the readings say for a trial against a simpler one, and how it predicts what it was not fitted to."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.special import chdtrc

from twin_core._typing import FloatArray
from twin_core.calibrate.undeclared.model import HeatFit
from twin_core.discover import policy
from twin_core.discover.left_out import forward_error
from twin_core.discover.trial import Trial
from twin_core.once import ask_each
from twin_core.side_by_side import side_by_side

CONSIDERABLE = 0.1
"""Nodes whose undeclared heat moves them less than this share of the most moved one say nothing about an effect."""


@dataclass(frozen=True)
class Evidence:
    """What the likelihood says for a trial against a simpler one.

    Attributes
    ----------
    log_bayes_factor
        Difference of log evidence (Schwarz), the number of candidates tried counted against it.
    p_value
        Likelihood-ratio test, corrected for the number of candidates (Bonferroni).
    """

    log_bayes_factor: float
    p_value: float


@dataclass(frozen=True)
class Validation:
    """How a trial predicts blocks of the training record that it was not fitted to.

    Attributes
    ----------
    ratio
        Open-loop error after over before (rms), no less than where both were fitted: what a simpler model's parameters do where
        the block that tells them is left out is nothing that an effect explains.
    blocks_better
        Share of blocks whose error fell.
    forward_ratio
        The same for the end of the training record after a refit to its beginning, or where there are several segments
        for each after a refit to the others: does the effect extrapolate? An error that grows counts so far as it
        is larger than any coarse network's.
    removed_share
        Misfit that the effect removes from the training record, as a share of the temperatures' spread (rms).
    explained_share
        Share of the undeclared heat's variance that the effect makes superfluous, on the node where it does so most.
    n_sessions
        Segments of the training record.
    is_law
        Whether no effect is an event at an instant.
    forward_at_best
        ``forward_ratio`` if all that any coarse network may leave there were no fault of the effects.
    """

    ratio: float
    blocks_better: float
    forward_ratio: float
    removed_share: float
    explained_share: float
    n_sessions: int = 1
    is_law: bool = True
    forward_at_best: float = 0.0

    @property
    def foresight(self) -> float:
        """Error on what the effects were not fitted to, after over before (rms).

        A law holds in every session, so each is predicted from the others; what gains much less there than on blocks within
        them is what differs between sessions. Of a single one, or of an event, blocks and the end may each see little:
        their geometric mean counts, but what blocks of a single one gain only as far as its end may gain, give or take
        coarseness: an effect lasts, while parts of the same days may be alike by chance. What makes one of them worse counts
        twice more.
        """
        worse = max(1.0, self.ratio, self.forward_ratio) ** 2
        if self.n_sessions > 1 and self.is_law:
            is_told_by_all = 1.0 - self.forward_ratio >= policy.BETWEEN_SESSIONS * (1.0 - self.ratio)
            return self.forward_ratio * worse if is_told_by_all else worse
        blocks = self.ratio if self.n_sessions > 1 else max(self.ratio, self.forward_at_best)
        return float(np.sqrt(blocks * self.forward_ratio)) * worse


def weigh(simple: Trial, rich: Trial, n_tried: int, *, quick: bool = False) -> Evidence:
    """Return what the readings say for the rich trial, chosen among ``n_tried``; with ``quick`` what they say at least."""
    after = rich.least_evidence if quick else rich.log_evidence()
    gain = after - simple.log_evidence()
    p_value = min(1.0, max(n_tried, 1) * float(chdtrc(_n_more(simple, rich), 2.0 * max(gain, 0.0))))
    return Evidence(paid(gain, simple, rich, n_tried), p_value)


def paid(gain: float, simple: Trial, rich: Trial, n_tried: int) -> float:
    """Return a log Bayes factor from a gain in log-likelihood: every parameter and every candidate tried is paid for.

    An instant pays twice (Zhang and Siegmund, Biometrics 63 (2007) 22): it is one among all samples, and told to a few of them
    whatever their number.
    """
    n_paid = _n_more(simple, rich) + max(_n_instants(rich) - _n_instants(simple), 0)
    return float(gain - 0.5 * n_paid * np.log(max(rich.n_samples, 2)) - np.log(max(n_tried, 1)))


def _n_more(simple: Trial, rich: Trial) -> int:
    """Return how many more parameters a trial has."""
    return max(rich.fit.problem.n_free - simple.fit.problem.n_free, 1)


def _n_instants(trial: Trial) -> int:
    """Return how many parameters of a trial's effects are instants."""
    return sum(q.instant is not None for effect in trial.effects for q in effect.parameter_specs())


def validate(simple: Trial, rich: Trial) -> Validation:
    """Return how the rich trial predicts blocks that it was not fitted to, against the simple one.

    By refits beside the sensors' own noise and beside the noise that lasts; where they differ the less favourable one counts.
    Both as they are handed out, without gradients within the nodes.
    """
    misfits = [np.concatenate(t.calibration().residuals) / t.fit.problem.noise_K for t in (simple, rich)]
    instant = _last_instant(simple, rich)
    foretold = [simple.forward_error, rich.forward_error] if instant is None else []
    ask_each(simple.block_errors, rich.block_errors, *foretold)
    before, after = simple.block_errors(), rich.block_errors()
    where_fitted = float(np.sqrt(np.nansum(misfits[1] ** 2) / max(np.nansum(misfits[0] ** 2), 1e-300)))
    ratio = max(_rms_ratio(before.sum(axis=1), after.sum(axis=1)), where_fitted)
    forward, at_best = _forward_ratios(simple, rich, instant)
    better = float(np.mean((after < before).all(axis=0)))
    explained = explained_share(simple.fit, rich.fit)
    n_sessions = len(rich.fit.problem.segments)
    is_law = all(q.instant is None for effect in rich.effects for q in effect.parameter_specs())
    return Validation(ratio, better, forward, _removed_share(simple, rich), explained, n_sessions, is_law, at_best)


def _rms_ratio(before: FloatArray, after: FloatArray) -> float:
    """Return the error on what was left out, after over before (rms), of sums of squares by several refits: the worst one."""
    return float(np.sqrt(np.max(after / np.maximum(before, 1e-300))))


def _last_instant(simple: Trial, rich: Trial) -> float | None:
    """Return when the last event begins that the rich trial has and the simple one has not, if there is one."""
    known = {effect.place for effect in simple.effects}
    instants = [
        float(effect.values[q.name])
        for effect in rich.present_effects
        if effect.place not in known
        for q in effect.parameter_specs()
        if q.instant is not None
    ]
    return max(instants, default=None)


def _forward_ratios(simple: Trial, rich: Trial, instant: float | None) -> tuple[float, float]:
    """Return the error on what follows, after over before (rms), and what it is at best; one and zero where nothing follows.

    An event is asked about what follows it: where it comes at the end of what a fit has seen, nothing tells its size. What any
    coarse network may miss is not held against the rich trial: where all is at rest, a simple one may be right by chance to a
    fraction of that. At best all of it is no fault of the rich trial's.
    """
    if instant is None:
        before, after = simple.forward_error(), rich.forward_error()
    else:
        before, after = side_by_side([partial(forward_error, t.calibration(), instant) for t in (simple, rich)])
    if not before.any():
        return 1.0, 0.0
    coarse = policy.MOST_COARSENESS
    ratio = _rms_ratio(np.maximum(before, np.minimum(after, 1.0 + coarse)), after)
    return ratio, _rms_ratio(before, np.maximum(after - coarse, 0.0))


def explained_share(simple: HeatFit, rich: HeatFit) -> float:
    """Return the share of the undeclared heat's variance that a richer model no longer needs.

    Sizes are compared as rates of temperature, on the nodes where the simpler model needs a considerable one.
    """
    nodes = simple.network.nodes
    kept = [rich.network.nodes.index(node) for node in nodes]
    before, after = _undeclared_rates_K_per_s(simple), _undeclared_rates_K_per_s(rich)[kept]
    matters = before >= CONSIDERABLE * before.max()
    return 1.0 - float(((after[matters] / before[matters]) ** 2).min()) if before.max() > 0.0 else 0.0


def _undeclared_rates_K_per_s(fit: HeatFit) -> FloatArray:
    """Return how fast the undeclared heat alone would move each node, (n_nodes,)."""
    return np.asarray(fit.undeclared.std_W / fit.values[fit.network.capacity_index])


def _removed_share(simple: Trial, rich: Trial) -> float:
    """Return the misfit that the rich trial removes as a share of the spread of the measured temperatures."""
    measured = np.concatenate([s.measured_K for s in simple.fit.problem.segments])
    before, after = (np.concatenate(t.calibration().residuals) for t in (simple, rich))
    removed = float(np.nanmean(before**2) - np.nanmean(after**2))
    spread = float(np.nanmean(np.nanvar(measured, axis=0))) + float(np.mean(simple.fit.problem.noise_K**2))
    return float(np.sqrt(max(removed, 0.0) / spread))
