"""What inputs and boundary temperatures do over the horizon: as planned, from the orbit, repeated, or held."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from twin_core._typing import FloatArray
from twin_core.errors import ModelError
from twin_core.forecast.period import Period, find_period, values_at
from twin_core.network.spec import TwinSpec
from twin_core.telemetry import Record

Inputs = Literal["auto", "repeat", "hold"]
How = Literal["plan", "orbit", "repeat", "hold"]
MOST_TIMES = 20_000
"""Repeated samples become times of the rollout up to this number; beyond, every second one, every fourth one and so on."""
APART_S = 1e-3
"""Times closer than this are one: telemetry is stamped in milliseconds."""


@dataclass(frozen=True)
class Past:
    """What a channel did: its samples, (n_times,), in SI, and how values between them are meant."""

    time_s: FloatArray
    column: FloatArray
    held: bool

    def at(self, time_s: FloatArray) -> FloatArray:
        """Return the channel at any times."""
        return values_at(self.time_s, self.column, time_s, held=self.held)

    @cached_property
    def _summed(self) -> FloatArray:
        """The integral up to each sample, value times s, of a channel that holds."""
        return np.concatenate([[0.0], np.cumsum(self.column[:-1] * np.diff(self.time_s))])

    def integral(self, time_s: FloatArray) -> FloatArray:
        """Return the integral of a channel that holds from the first sample up to any times, value times s."""
        return np.interp(time_s, self.time_s, self._summed)

    @cached_property
    def period(self) -> Period | None:
        """Its own period, None where it has none."""
        return find_period(self.time_s, self.column, held=self.held)

    @property
    def varies(self) -> bool:
        """Whether it ever changed."""
        return bool(np.ptp(self.column) > 0.0)


@dataclass(frozen=True)
class Rule:
    """How a channel is taken to go on; ``period_s`` is None where its last value holds."""

    past: Past
    period_s: float | None

    def ahead(self, origin_s: FloatArray | float, lead_s: FloatArray) -> FloatArray:
        """Return the channel ``lead_s`` after ``origin_s``, told by nothing later than the origin; both broadcast."""
        origin_s, lead_s = np.asarray(origin_s), np.asarray(lead_s)
        if self.period_s is None:
            last = np.searchsorted(self.past.time_s, origin_s + APART_S, side="right") - 1
            held = self.past.column[np.maximum(last, 0)]
            return np.broadcast_to(held, np.broadcast_shapes(origin_s.shape, lead_s.shape))
        # a moment that the period's own error puts just beyond the origin belongs to the cycle before
        cycles = np.ceil((lead_s - APART_S) / self.period_s)
        return self.past.at(origin_s + lead_s - np.maximum(cycles, 0.0) * self.period_s)

    def integral_ahead(self, origin_s: FloatArray, lead_s: FloatArray) -> FloatArray:
        """Return the integral of ``ahead`` over the lead time, value times s, of a channel that holds; both broadcast."""
        if self.period_s is None:
            return self.ahead(origin_s, lead_s) * lead_s
        before = np.maximum(np.ceil(lead_s / self.period_s), 1.0) - 1.0
        cycle = self.past.integral(origin_s) - self.past.integral(origin_s - self.period_s)
        rest = self.past.integral(origin_s + lead_s - (before + 1.0) * self.period_s)
        return before * cycle + rest - self.past.integral(origin_s - self.period_s)


@dataclass(frozen=True)
class Assumed:
    """What was assumed.

    Attributes
    ----------
    how
        Channel -> where its future comes from.
    rules
        Of the channels that repeat or hold and have a past.
    """

    how: Mapping[str, How]
    rules: Mapping[str, Rule]

    def in_words(self) -> tuple[str, ...]:
        """Return one sentence for what varied in the past and is not planned; none where there is nothing of it."""
        varying = {name: rule for name, rule in self.rules.items() if rule.past.varies}
        periods: dict[str, list[str]] = {}
        for name, rule in varying.items():
            if rule.period_s is not None:
                periods.setdefault(f"{float(f'{rule.period_s:.4g}'):g}", []).append(name)
        parts = [
            f"{', '.join(names)} {'repeat their' if len(names) > 1 else 'repeats its'} last {s} s"
            for s, names in periods.items()
        ]
        held = [name for name, rule in varying.items() if rule.period_s is None]
        does = "hold their last values" if len(held) > 1 else "holds its last value"
        parts += [f"{', '.join(held)} {does}"] if held else []
        return (f"no plan was given: {'; '.join(parts)}; the bands contain what that missed before",) if parts else ()


def assume(
    spec: TwinSpec, past: Record, plan: Record | None, inputs: Inputs, orbit_period_s: float | None = None
) -> Assumed:
    """Settle how every driving channel goes on.

    Parameters
    ----------
    spec
        Declares the channels.
    past
        Telemetry; nothing after the present in it.
    plan
        Future inputs; a channel with any value in it is planned.
    inputs
        ``auto`` repeats channels that have a period of their own and holds the others, ``hold`` holds all, ``repeat``
        gives those without a period the shortest one of the others, else ``orbit_period_s``.

    Raises
    ------
    ModelError
        If ``inputs`` is none of the three.
    """
    if inputs not in ("auto", "repeat", "hold"):
        raise ModelError(f"inputs: must be auto, repeat or hold (got '{inputs}')")
    how: dict[str, How] = {load.channel: "orbit" for load in spec.loads if load.channel in spec.orbit_channels}
    rules: dict[str, Rule] = {}
    for name in driving(spec):
        planned = plan is not None and name in plan.values and bool(np.isfinite(plan.values[name]).any())
        how[name] = "plan" if planned else "hold"
        column = past.values.get(name)
        valid = None if column is None else np.isfinite(column)
        if planned or column is None or valid is None or not valid.any():
            continue
        known = Past(past.time_s[valid], column[valid], spec.channels[name].is_held)
        own = known.period if inputs != "hold" else None
        rules[name] = Rule(known, None if own is None else own.period_s)
    if inputs == "repeat":
        common = min((r.period_s for r in rules.values() if r.period_s is not None), default=orbit_period_s)
        rules = {name: _repeating(rule, common) for name, rule in rules.items()}
    how |= {name: "repeat" for name, rule in rules.items() if rule.period_s is not None}
    return Assumed(how, rules)


def driving(spec: TwinSpec) -> list[str]:
    """Return the channels whose future a rollout needs: all but sensors."""
    return [name for name in spec.used_channels if name in spec.driving_channels]


def _repeating(rule: Rule, common_s: float | None) -> Rule:
    """Return a rule with a period if there is one to take, and a past as long as it."""
    long = common_s is not None and float(np.ptp(rule.past.time_s)) >= common_s
    return rule if rule.period_s is not None or not long else Rule(rule.past, common_s)


def future_record(
    spec: TwinSpec,
    record: Record,
    horizon_s: float,
    step_s: float,
    plan: Record | None,
    rules: Mapping[str, Rule] | None = None,
) -> Record:
    """Return inputs and boundary temperatures over the horizon: as planned, by their rules, else the last value held.

    The first sample is the present. Planned samples, and repeated ones, that lie between the forecast's own times become
    times too.
    """
    rules = rules or {}
    own = own_times_s(record, horizon_s, step_s)
    now_s = float(own[0])
    times = own
    if plan is not None:
        times = np.union1d(times, plan.time_s[(plan.time_s > times[0]) & (plan.time_s < times[-1])])
    times = _with_times(times, [_repeats(rule, now_s, float(own[-1]), step_s) for rule in rules.values()])
    values: dict[str, FloatArray] = {}
    for name in driving(spec):
        column = record.values.get(name)
        finite = None if column is None else column[np.isfinite(column)]
        last = float(finite[-1]) if finite is not None and finite.size else np.nan
        rule = rules.get(name)
        if plan is not None and name in plan.values:
            if not np.isfinite(last) and rule is not None:
                last = float(rule.past.column[-1])
            values[name] = _planned(plan, name, times, last, spec.channels[name].is_held)
        elif rule is not None and (rule.period_s is not None or not np.isfinite(last)):
            values[name] = np.array(rule.ahead(now_s, times - now_s))
        else:
            values[name] = np.full(times.size, last)
    return Record(times, values, record.epoch_ns, "forecast")


def own_times_s(record: Record, horizon_s: float, step_s: float) -> FloatArray:
    """Return the times of a forecast on the record's axis, the present first, (n_times + 1,)."""
    count = int(np.floor(horizon_s / step_s + 1e-9))
    return record.time_s[-1] + step_s * np.arange(count + 1, dtype=np.float64)


def _repeats(rule: Rule, now_s: float, stop_s: float, step_s: float) -> FloatArray:
    """Return when samples of the last period come again.

    Of a channel that holds, those that change nothing are left out where the forecast's own steps are as short as its
    sampling: they would only double the work.
    """
    if rule.period_s is None:
        return np.empty(0)
    time_s, column = rule.past.time_s, rule.past.column
    tells = time_s > now_s - rule.period_s
    if rule.past.held and tells.sum() > 1 and step_s <= np.median(np.diff(time_s[tells])) + APART_S:
        tells &= np.diff(column, prepend=np.nan) != 0.0
    last = time_s[tells]
    cycles = np.arange(1, int(np.ceil((stop_s - now_s) / rule.period_s)) + 1)
    again = (last + rule.period_s * cycles[:, None]).ravel()
    return again[(again > now_s) & (again < stop_s)]


def _with_times(times: FloatArray, more: list[FloatArray]) -> FloatArray:
    """Return times with others between them, of which none is closer than ``APART_S`` to its neighbour."""
    extra = np.unique(np.concatenate([np.empty(0), *more]))
    extra = extra[:: 1 + extra.size // MOST_TIMES]
    place = np.searchsorted(times, extra)
    near = np.minimum(
        np.abs(times[np.minimum(place, times.size - 1)] - extra), np.abs(times[np.maximum(place - 1, 0)] - extra)
    )
    extra = extra[near > APART_S]
    extra = extra[np.diff(extra, prepend=-np.inf) > APART_S]
    return np.union1d(times, extra)


def _planned(plan: Record, name: str, times: FloatArray, last: float, is_held: bool) -> FloatArray:
    """Return a planned channel at the forecast's times; before the plan begins the last measured value holds."""
    valid = np.isfinite(plan.values[name])
    at, column = plan.time_s[valid], plan.values[name][valid]
    if not at.size:
        return np.full(times.size, last)
    if is_held:
        position = np.searchsorted(at, times + 1e-9, side="right") - 1
        return np.where(position >= 0, column[np.maximum(position, 0)], last)
    inside = np.interp(times, at, column)
    return np.where(times >= at[0], inside, last if np.isfinite(last) else column[0])
