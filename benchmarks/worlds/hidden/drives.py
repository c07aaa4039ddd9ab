"""Inputs that deliver something else than is declared, and boundaries that are not what their channel says."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.worlds.hidden.base import Change, Draft, Effect, Scene
from benchmarks.worlds.hidden.sensing import lag_exact
from benchmarks.worlds.stepping import Drive


def _fed(channel: str, factor: Callable[[Drive], np.ndarray]) -> Change:
    """Return a change of what one channel delivers, by a factor per step and stage."""

    def change(drive: Drive) -> Drive:
        return replace(drive, inputs_W={**drive.inputs_W, channel: factor(drive) * drive.inputs_W[channel]})

    return change


def _channel(s: Scene) -> str:
    return str(s.rng.choice(list(s.craft.power_W)))


def input_gain(s: Scene) -> Draft:
    """Draw an input that delivers more or less than is declared."""
    channel, sign = _channel(s), s.sign()

    def make(d: float) -> Effect:
        return Effect({"channel": channel}, {"g": 1 + sign * d}, drive=_fed(channel, lambda x: np.array(1 + sign * d)))

    return Draft(make, 0.3, 0.02, 0.9)


def input_power_law(s: Scene) -> Draft:
    """Draw an input that delivers a power of what is declared."""
    channel, sign = str(s.rng.choice([c for c in s.craft.power_W if c not in s.craft.sunlit])), s.sign()
    reference = float(s.craft.power_W[channel].max() * np.exp(s.rng.uniform(np.log(0.3), 0.0)))

    def make(d: float) -> Effect:
        n = float(np.exp(sign * d))

        def factor(drive: Drive) -> np.ndarray:
            return np.asarray(np.maximum(drive.inputs_W[channel], 1e-9) / reference) ** (n - 1.0)

        return Effect({"channel": channel}, {"n": n, "reference": reference}, drive=_fed(channel, factor))

    return Draft(make, 0.3, 0.05, 0.8)


def _share_after(drive: Drive, onset_s: float) -> np.ndarray:
    """Return the share of every step that lies after an instant, (n_steps, 1)."""
    return np.clip((drive.ends_s[1:] - onset_s) / drive.step_s, 0.0, 1.0)[:, None]


def input_step(s: Scene) -> Draft:
    """Draw an input that changes at an instant: it dies, falls or rises."""
    channel, sign, onset = _channel(s), s.sign(), s.onset()

    def make(d: float) -> Effect:
        f = 1.0 + sign * d
        change = _fed(channel, lambda drive: 1.0 + (f - 1.0) * _share_after(drive, onset))
        return Effect({"channel": channel}, {"f": f, "time": onset}, drive=change, onset_s=onset)

    return Draft(make, 0.4, 0.02, 1.0)


def input_drift(s: Scene) -> Draft:
    """Draw an input that drifts over the record."""
    channel, sign, duration = _channel(s), s.sign(), s.craft.duration_s

    def make(d: float) -> Effect:
        rate = sign * d / duration
        change = _fed(channel, lambda drive: 1.0 + rate * np.maximum(drive.stages_s, 0.0))
        return Effect({"channel": channel}, {"r_per_s": rate}, drive=change)

    return Draft(make, 0.5, 0.05, 0.95)


def _sink(boundary: str, change: Callable[[Drive, np.ndarray], np.ndarray]) -> Change:
    def changed(drive: Drive) -> Drive:
        given = drive.boundaries_K[boundary]
        return replace(drive, boundaries_K={**drive.boundaries_K, boundary: change(drive, given)})

    return changed


def _boundary(s: Scene) -> str:
    return str(s.rng.choice(list(s.craft.boundaries_K)))


def boundary_offset(s: Scene) -> Draft:
    """Draw a boundary whose channel reads too high or too low."""
    boundary, sign = _boundary(s), s.sign()

    def make(b: float) -> Effect:
        drive = _sink(boundary, lambda _, given: given + sign * b)
        return Effect({"boundary": boundary}, {"b_K": sign * b}, drive=drive)

    return Draft(make, 3.0, 0.3, 25.0)


def boundary_lag(s: Scene) -> Draft:
    """Draw a boundary that follows its channel with a delay."""
    boundary = _boundary(s)

    def make(tau_s: float) -> Effect:
        return Effect(
            {"boundary": boundary}, {"tau_s": tau_s}, drive=_sink(boundary, lambda d, g: _lagged(d, g, tau_s))
        )

    scale = s.craft.duration_s
    return Draft(make, 0.02 * scale, 3.0 * s.craft.sample_s, 0.1 * scale)


def _lagged(drive: Drive, given: np.ndarray, tau_s: float) -> np.ndarray:
    """Return a first-order lag of a series at the stages, (n_steps, 2), exact for straight lines from end to end."""
    ends = np.concatenate([given[:1, 0], given[:, 1]])
    lagged = lag_exact(ends, drive.step_s, tau_s)
    times = drive.ends_s
    return np.interp(drive.stages_s, times, lagged)


def boundary_mix(s: Scene) -> Draft:
    """Draw a boundary that its channel describes only in part, or not at all."""
    boundary = _boundary(s)
    usual = float(np.mean(s.craft.boundaries_K[boundary]))
    other = usual + float(s.rng.uniform(-8.0, 8.0))

    def make(share: float) -> Effect:
        alpha = 1.0 - share
        drive = _sink(boundary, lambda _, given: alpha * given + share * other)
        return Effect({"boundary": boundary}, {"alpha": alpha, "T_w_K": other}, drive=drive)

    return Draft(make, 0.6, 0.2, 1.0)
