"""Forecasts from the assimilated state, with planned inputs."""

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.errors import BadField, NotYet, Refusal, short
from service.instants import AGREEING_US, format_instant, format_instants, in_words, now_us, parse_instants
from service.live.engine import Engine
from service.live.known import Known
from service.live.position import Position
from service.live.pulse import Beat, listed
from service.schemas import Columns, ForecastRequest
from service.store import samples, twins
from service.store.anomalies import WORDS
from service.store.database import Database
from service.store.models import Active
from service.twins.registry import Entry
from service.workbench.interface import Forecasted, ForecastTask, Telemetry

SETTLE_S = 10.0
"""How long a forecast waits for samples that are stored but not yet assimilated."""
FIRST_S = 15.0
"""How much longer it waits where there is no state at all; clients wait 30 s for an answer."""
MOST_POINTS = 20_000
MOST_STEPS = 200_000
PAST = 20_000
"""Usual distances of samples, from which is told how inputs go on: two weeks of minutes."""

NEEDED = (0.05, 0.5, 0.95)
"""Quantiles that every forecast has, by which limits are judged."""

Json = dict[str, Any]


async def state_of(tracker: Known) -> tuple[Active, Position]:
    """Return the active model and its present state; Refusal if there is none, NotYet if it comes by itself."""
    settled = await tracker.settled(SETTLE_S)
    if not settled and tracker.position is None:
        settled = await tracker.settled(FIRST_S)
    if not settled and tracker.position is None and tracker.trouble is None:
        raise NotYet("the state is not known: the archive is still being assimilated; ask again")
    if tracker.active is None:
        raise Refusal("no model is active; calibrate first, or activate a version")
    if tracker.position is None:
        raise Refusal(f"the state is not known: {tracker.trouble or 'the archive is empty'}")
    return tracker.active, tracker.position


def moment(twin: Entry, active: Active, position: Position) -> Telemetry:
    """Return the one sample that the state describes: inputs as they hold there, readings already used."""
    values = {name: np.array([value]) for name, value in position.held.items()}
    values |= {name: np.array([np.nan]) for name in twin.sensors}
    return Telemetry(active.epoch_us, np.array([position.time_us], dtype=np.int64), values)


async def past_of(twin: Entry, database: Database, active: Active, position: Position) -> Telemetry | None:
    """Return what inputs and boundaries did up to the present; None where the twin has none."""
    names = [name for name in twin.channels if name not in twin.sensors]
    if not names:
        return None
    start_us = position.time_us - round(PAST * position.sampling_s * 1e6)
    rows = [twin.channels.index(name) for name in names]
    span_us = (start_us, position.time_us + 1)
    found = await database.read(samples.select, twin.key, len(twin.channels), rows, *span_us)
    if not found.time_us.size:
        return None
    return Telemetry(active.epoch_us, found.time_us, dict(zip(names, found.values, strict=True)))


def build_task(
    twin: Entry, active: Active, position: Position, past: Telemetry | None, request: ForecastRequest
) -> ForecastTask:
    """Return what a worker needs for a forecast; BadField if the request asks for too much."""
    step_s = request.step_s or min(position.sampling_s, request.horizon_s)
    if step_s > request.horizon_s:
        raise BadField("step_s", f"must be at most the horizon ({request.horizon_s:g} s), got {step_s:g}")
    if request.horizon_s / step_s > MOST_POINTS:
        if request.step_s is not None:
            raise BadField("step_s", f"gives more than {MOST_POINTS} points; take a longer step")
        step_s = request.horizon_s / MOST_POINTS
    longest_s = MOST_STEPS * float(active.parsed_step_s)
    if request.horizon_s > longest_s:
        raise BadField("horizon_s", f"must be at most {longest_s:g} s for this model")
    telemetry = moment(twin, active, position)
    plan = None if request.plan is None else _plan(twin, request.plan, active.epoch_us)
    if plan is not None:
        _check_span(plan, position.time_us, position.time_us + round(request.horizon_s * 1e6))
    quantiles = tuple({*request.quantiles, *NEEDED})
    return ForecastTask(telemetry, position.state, request.horizon_s, step_s, plan, quantiles, request.inputs, past)


def _plan(twin: Entry, plan: Columns, epoch_us: int) -> Telemetry | None:
    """Return the planned inputs; None if no time is planned."""
    for name, column in plan.values.items():
        if name not in twin.channels:
            raise BadField(
                f"plan.values.{name}", f"unknown channel '{short(name)}' (known: {', '.join(twin.channels)})"
            )
        if name in twin.sensors:
            raise BadField(f"plan.values.{name}", "is what the forecast predicts; plan inputs and boundaries only")
        if len(column) != len(plan.time):
            raise BadField(f"plan.values.{name}", f"has {len(column)} values, time has {len(plan.time)}")
    time_us = parse_instants(plan.time, "plan.time")
    if time_us.size == 0:
        return None
    steps = np.diff(time_us)
    if (steps <= 0).any():
        index = int(np.argmax(steps <= 0)) + 1
        raise BadField(
            f"plan.time[{index}]", "does not come after the time before it; sort the plan, each instant once"
        )
    values = {name: np.array(column, dtype=np.float64) for name, column in plan.values.items()}
    for name, planned in values.items():
        if not np.isfinite(planned).any():
            raise BadField(f"plan.values.{name}", "plans no value; give some or leave the channel out")
        twin.refuse_implausible(planned[None, :], twin.channels.index(name), "plan.values.")
    return Telemetry(epoch_us, time_us, values)


def _check_span(plan: Telemetry, now_us: int, stop_us: int) -> None:
    """Refuse a plan of another time than the forecast's."""
    first_us, last_us = int(plan.time_us[0]), int(plan.time_us[-1])
    if last_us < now_us:
        raise BadField("plan.time", f"ends before the forecast begins at {format_instant(now_us)}")
    if first_us > stop_us:
        raise BadField("plan.time", f"begins after the forecast ends at {format_instant(stop_us)}")


def quantile_name(probability: float) -> str:
    """Return ``q05`` for 0.05, ``q50`` for 0.5, ``q97.5`` for 0.975."""
    percent = round(100.0 * probability, 6)
    return f"q{percent:02.0f}" if percent.is_integer() else f"q{percent:g}"


def silence_s(twin: Entry, beats: Mapping[str, Beat]) -> float | None:
    """Return for how long no sensor has been heard of, in seconds; None while one of them is, or where nobody knows."""
    at_us = now_us()
    sensors = [beats[name] for name in twin.sensors]
    silent = [s for beat in sensors if (s := beat.silent_s(at_us)) is not None]
    if not silent or any(beat.standing(at_us) in ("live", "delayed") for beat in sensors):
        return None
    return min(silent)


@dataclass(frozen=True)
class Look:
    """A look ahead: with which model, from which state, how far that lags, and what it shows."""

    active: Active
    position: Position
    lag: "Behind"
    made: Forecasted


async def look_ahead(tracker: Known, database: Database, engine: Engine, request: ForecastRequest) -> Look:
    """Forecast from the present state; Refusal if there is none, or if the request asks for too much."""
    active, position = await state_of(tracker)
    lag, past = await asyncio.gather(behind(tracker, database), past_of(tracker.twin, database, active, position))
    task = build_task(tracker.twin, active, position, past, request)
    return Look(active, position, lag, await engine.forecast(active.document, task))


@dataclass(frozen=True)
class Behind:
    """How far a state lags: ``seconds`` of telemetry, while of ``of`` samples of the archive ``done`` are assimilated.

    ``quarantined`` more lie ahead of the present.
    """

    seconds: float
    done: int
    of: int
    quarantined: int


async def behind(tracker: Known, database: Database) -> Behind:
    """Return how far the state of a twin is behind the last sample; one that waits for company does not count."""
    head = await database.read(twins.get, tracker.twin.name)
    position, last_us = tracker.position, head.last_us
    lag_us = 0
    if position is not None and last_us is not None and last_us != tracker.waits_us:
        lag_us = max(last_us - position.time_us, 0)
    of = head.samples
    if tracker.floor_us is not None:
        of = await database.read(samples.count_after, tracker.twin.key, tracker.floor_us - 1)
    return Behind(lag_us / 1e6, max(of - tracker.left, 0), of, head.quarantined)


def notices(tracker: Known, position: Position, lag: Behind, silent_s: float | None) -> list[str]:
    """Say where a forecast begins, if that is not the present or is known less well than it will be.

    ``silent_s`` is for how long no sensor has been heard of; None while one is.
    """
    told = []
    if silent_s is not None:
        told.append(
            f"no telemetry has arrived for {in_words(silent_s)}: this forecast starts at the last sample, "
            f"{format_instant(position.time_us)}"
        )
    if lag.seconds > 0.0:
        why = tracker.trouble or f"{lag.done} of {lag.of} samples of the archive are assimilated"
        told.append(
            f"this forecast is not from the present: it starts at {format_instant(position.time_us)}, "
            f"{in_words(lag.seconds)} before the last sample ({why})"
        )
    base = tracker.base
    if base is not None and base.is_short:
        needed = f"; its slowest node remembers {in_words(base.needed_s)}" if np.isfinite(base.needed_s) else ""
        told.append(
            f"the state rests on the last {in_words(base.known_s)} until the archive before is assimilated{needed}"
        )
    if tracker.waits_us is not None:
        when = format_instant(tracker.waits_us)
        told.append(
            f"the last sample, of {when}, lies far ahead of the others and waits for another one: its clock may be wrong"
        )
    if lag.quarantined:
        told.append(
            "1 sample ahead of the receive clock is in quarantine and not used: its clock may be wrong"
            if lag.quarantined == 1
            else f"{lag.quarantined} samples ahead of the receive clock are in quarantine and not used: their clock may be wrong"
        )
    return told


def ahead_of_clock(twin: Entry, position: Position) -> list[str]:
    """Say that a forecast begins in the future, by a clock that quarantine still believes.

    A spacecraft's clock may differ a little, and a sample may be stamped with the end of what it measures: neither is told.
    """
    ahead_us = position.time_us - now_us()
    if ahead_us <= position.sampling_s * 1e6 + AGREEING_US:
        return []
    return [
        f"this forecast starts at {format_instant(position.time_us)}, {in_words(ahead_us / 1e6)} ahead of this service's clock: "
        f"the clock of the newest samples may be wrong; if so, DELETE /v1/twins/{twin.name}/telemetry takes them away"
    ]


def delays(twin: Entry, position: Position, beats: Mapping[str, Beat]) -> list[str]:
    """Say that telemetry arrives, but so long after the fact that a sensor which is as late would be taken for silent."""
    at_us = now_us()
    heard = [name for name in twin.sensors if beats[name].standing(at_us) in ("live", "delayed")]
    late = {name: s for name in heard if (s := beats[name].delay_s or 0.0) > beats[name].stale_after_s}
    if not late:
        return []
    if len(late) < len(heard):
        most = "up to " if len(late) > 1 else ""
        return [f"telemetry of {listed(list(late))} arrives {most}{in_words(max(late.values()))} late"]
    starts = f"this forecast starts at {format_instant(position.time_us)}"
    return [f"telemetry arrives {in_words(min(late.values()))} late: {starts}"]


def unheard(look: Look, beats: Mapping[str, Beat]) -> list[str]:
    """Say of which inputs nothing had come for long where a forecast begins; those that are planned or computed do not count.

    By the time that samples bear, so of a recording as well: what counts is what its state and its future were told by.
    """
    found = {}
    for name, how in look.made.inputs.items():
        beat = beats.get(name)
        if how not in ("repeat", "hold") or beat is None or beat.last_us is None or beat.interval_s is None:
            continue  # what was sent once is a setting, and holds
        silent_s = (look.position.time_us - beat.last_us) / 1e6
        if silent_s > beat.stale_after_s:
            found[name] = silent_s
    if not found:
        return []
    them, most = ("them", "up to ") if len(found) > 1 else ("it", "")
    for_how_long = f"{most}{in_words(max(found.values()))}"
    return [
        f"no telemetry of {listed(list(found))} for {for_how_long}: what is assumed of {them} rests on what came before"
    ]


def doubts(twin: Entry, open_kinds: Mapping[str, Sequence[str]]) -> list[str]:
    """Say of which sensors the readings themselves are in doubt, from the kinds of the anomalies that last."""
    found = [(name, kind) for name in twin.sensors for kind in open_kinds.get(name, []) if kind in ("stuck", "dropout")]
    return [f"{name} {WORDS[kind]}; what the forecast says of it may be wrong" for name, kind in found]


def render(twin: Entry, look: Look, quantiles: Sequence[float], limits: Sequence[Json]) -> Json:
    """Return a forecast as clients see it."""
    active, position, made = look.active, look.position, look.made
    values = {
        sensor: {"mean": mean.tolist()} | {quantile_name(q): made.quantiles[q][sensor].tolist() for q in quantiles}
        for sensor, mean in made.mean.items()
    }
    return {
        "model_version": active.version,
        "issued": format_instant(now_us()),
        "from": format_instant(position.time_us),
        "behind_s": look.lag.seconds,
        "time": format_instants(made.time_us),
        "values": values,
        "whole": {
            "probability": made.whole_probability,
            "values": {s: {"low": low.tolist(), "high": high.tolist()} for s, (low, high) in made.whole.items()},
        },
        "units": {sensor: twin.units[sensor] for sensor in made.mean},
        "inputs": dict(made.inputs),
        "limits": list(limits),
        "notices": list(made.notices),
    }
