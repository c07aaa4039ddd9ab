"""Run scenarios: one, or several that share a field as several right-hand sides at once."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from twin_core._typing import FloatArray, Progress, no_progress
from twin_core.errors import ModelError
from twin_core.fem.assembly import assemble
from twin_core.fem.drive import Clock, Driving, clock_of, drive_scenario, realise
from twin_core.fem.field import Field
from twin_core.fem.hidden.base import Bound, Moment
from twin_core.fem.measure import measure
from twin_core.fem.scenario import Scenario
from twin_core.fem.signals import Path
from twin_core.fem.stepping import SCHEMES, Drive
from twin_core.fem.thermostat import Switch
from twin_core.telemetry import Record

_LEAST_J = 1e-3
"""Below this nothing moved: the imbalance of an isolated field at rest is rounding over this, not over nothing."""

_PER_SCENARIO = {"scenario", "seed", "forcings", "thermostats", "hidden", "time"}
"""Fields in which scenarios that share a field may differ (of time: only jitter, gaps and missing samples)."""


@dataclass(frozen=True)
class Truth:
    """What only an oracle may know.

    Attributes
    ----------
    time_s : (n_steps + 1,)
        Instants of the simulation, from the start of the record.
    temperature_K : sensor -> (n_steps + 1,)
        True temperature at each sensor.
    region_K : region -> (n_steps + 1,)
        True mean of each region.
    hidden_heat_W : region -> (n_steps + 1,)
        Heat of the hidden effects into each region at the end of each step; lost input counts, hidden masses do not.
    imbalance : (n_steps + 1,)
        Stored minus received heat of each step, relative to the heat that moved.
    capacity_J_per_K
        Heat capacity of each region.
    """

    time_s: FloatArray
    temperature_K: Mapping[str, FloatArray]
    region_K: Mapping[str, FloatArray]
    hidden_heat_W: Mapping[str, FloatArray]
    imbalance: FloatArray
    capacity_J_per_K: Mapping[str, float]


@dataclass(frozen=True)
class Simulation:
    """A finished run: the record that an operator sees, and the truth for oracles."""

    record: Record
    truth: Truth


Watch = Callable[[float, FloatArray], None]
"""Hears the time in seconds from the start of the record, and the temperatures (n_unknowns, n_cases), after each step."""


def no_watch(time_s: float, temperature_K: FloatArray) -> None:
    """Look away: the default of a run."""


def simulate(scenario: Scenario, progress: Progress = no_progress, watch: Watch = no_watch) -> Simulation:
    """Return the run of one scenario.

    Raises
    ------
    ModelError
        If a step does not converge.
    """
    return simulate_many([scenario], progress, watch)[0]


def simulate_many(
    scenarios: Sequence[Scenario], progress: Progress = no_progress, watch: Watch = no_watch
) -> list[Simulation]:
    """Return the runs of scenarios that share geometry, materials and steps, solved side by side.

    Raises
    ------
    ModelError
        If the scenarios differ in more than forcings, hidden effects, seed and sampling; if a step does not converge.
    """
    _check_shared(scenarios)
    field, clock = assemble(scenarios[0]), clock_of(scenarios[0])
    scheme_class = SCHEMES[scenarios[0].time.scheme]
    paths = [realise(scenario, clock) for scenario in scenarios]
    drivings = [
        drive_scenario(scenario, clock, path, scheme_class.stage_fractions, scheme_class.input_weights)
        for scenario, path in zip(scenarios, paths, strict=True)
    ]
    switches = [_switches(scenario, field) for scenario in scenarios]
    history = _run(field, clock, scenarios, drivings, switches, progress, watch)
    for path, working in zip(paths, switches, strict=True):
        path.update({switch.thermostat.channel: switch.path(clock.start_s) for switch in working})
    return [
        _finish(scenario, field, clock, path, driving, history, case)
        for case, (scenario, path, driving) in enumerate(zip(scenarios, paths, drivings, strict=True))
    ]


def _switches(scenario: Scenario, field: Field) -> list[Switch]:
    return [Switch(item, field.share[item.region], scenario.time.sample_s) for item in scenario.thermostats]


def _check_shared(scenarios: Sequence[Scenario]) -> None:
    """Refuse scenarios that do not share a field and steps."""

    def shared(scenario: Scenario) -> dict[str, Any]:
        time = scenario.time
        steps = {"steps": (time.duration_s, time.step_s, time.sample_s, time.settle_s, time.scheme, time.start)}
        masses = {"masses": [mass for effect in scenario.hidden for mass in effect.masses()]}
        return scenario.model_dump(exclude=_PER_SCENARIO) | steps | masses | {"forcings": list(scenario.forcings)}

    if not scenarios:
        raise ModelError("no scenario to simulate; give at least one")
    first = shared(scenarios[0])
    for scenario in scenarios[1:]:
        different = [key for key, value in shared(scenario).items() if value != first[key]]
        if different:
            raise ModelError(
                f"scenario '{scenario.scenario}' cannot share a run with '{scenarios[0].scenario}': "
                f"{', '.join(different)} differ; simulate it on its own"
            )


@dataclass
class _History:
    """What a run leaves: readings, region means, hidden heat (n_steps + 1, rows, n_cases) and imbalance."""

    readings_K: FloatArray
    regions_K: FloatArray
    hidden_W: FloatArray
    imbalance: FloatArray


def _run(
    field: Field,
    clock: Clock,
    scenarios: Sequence[Scenario],
    drivings: Sequence[Driving],
    switches: Sequence[Sequence[Switch]],
    progress: Progress,
    watch: Watch,
) -> _History:
    """Step all cases through the whole clock."""
    n_cases, n_steps = len(scenarios), clock.start_s.size
    temperature_K = np.repeat(field.start_K[:, None], n_cases, axis=1)
    scheme = SCHEMES[scenarios[0].time.scheme](field, clock.step_s, field.start_K)
    hidden = _Hidden(field, scenarios, drivings, switches)
    means = np.stack(list(field.share.values()))
    weight = field.capacity_matrix.sum(axis=0)
    history = _History(
        np.empty((n_steps + 1, field.readings.shape[0], n_cases)),
        np.empty((n_steps + 1, means.shape[0], n_cases)),
        np.zeros((n_steps + 1, means.shape[0], n_cases)),
        np.zeros((n_steps + 1, n_cases)),
    )
    inputs_W = np.stack([driving.inputs_W for driving in drivings], axis=-1)
    boundary_K = np.stack([driving.boundary_K for driving in drivings], axis=-1)
    history.readings_K[0], history.regions_K[0] = field.readings @ temperature_K, means @ temperature_K
    watch(float(clock.start_s[0]), temperature_K)
    for n, time_s in enumerate(clock.start_s):
        hidden.begin(n, float(time_s), temperature_K)
        drive = Drive(inputs_W[n], boundary_K[n], hidden.heat_W if hidden.any else None)
        after = scheme.step(float(time_s), temperature_K, drive)
        stored_J = weight @ (after - temperature_K)
        moved_J = np.maximum(scheme.heat_moved_J, np.abs(field.capacity_matrix @ (after - temperature_K)).sum(axis=0))
        history.imbalance[n + 1] = np.abs(stored_J - scheme.heat_in_J) / np.maximum(moved_J, _LEAST_J)
        temperature_K = after
        history.readings_K[n + 1], history.regions_K[n + 1] = field.readings @ after, means @ after
        history.hidden_W[n + 1] = hidden.by_region_W()
        watch(float(time_s) + clock.step_s, temperature_K)
        if n % 64 == 0:
            progress(n / n_steps, f"simulating, {time_s / 3600.0:.1f} h")
    progress(1.0, "simulated")
    return history


class _Hidden:
    """The heat of hidden effects and of thermostats in all cases, evaluated at the stages of one step."""

    def __init__(
        self,
        field: Field,
        scenarios: Sequence[Scenario],
        drivings: Sequence[Driving],
        switches: Sequence[Sequence[Switch]],
    ) -> None:
        self._field, self._scenarios, self._drivings = field, scenarios, drivings
        bound = [[effect.bind(field) for effect in scenario.hidden] for scenario in scenarios]
        self._bound: list[list[Bound]] = [[item for item in case if item is not None] for case in bound]
        self._last_W = np.zeros((field.n_unknowns, len(scenarios)))
        self._step = 0
        self._switches = switches
        self.any = any(self._bound) or any(switches)

    def begin(self, step: int, time_s: float, temperature_K: FloatArray) -> None:
        """Let effects with a memory look at the start of a step."""
        self._step = step
        rest = np.zeros_like(temperature_K)
        for case, effects in enumerate(self._bound):
            for effect in effects:
                effect.advance(self._moment(case, 0, time_s, temperature_K, rest))
            for switch in self._switches[case]:
                switch.look(time_s, temperature_K[:, case])

    def heat_W(self, time_s: float, temperature_K: FloatArray, rate_K_per_s: FloatArray, stage: int) -> FloatArray:
        """Return the heat of all hidden effects and thermostats, (n_unknowns, n_cases)."""
        heat = np.zeros_like(temperature_K)
        for case, effects in enumerate(self._bound):
            if effects:
                moment = self._moment(case, stage, time_s, temperature_K, rate_K_per_s)
                heat[:, case] = sum(effect.heat_W(moment) for effect in effects)
        self._last_W = heat.copy()
        for case, working in enumerate(self._switches):
            for switch in working:
                heat[:, case] += switch.heat_W
        return heat

    def by_region_W(self) -> FloatArray:
        """Return the heat last evaluated, by region, (n_regions, n_cases)."""
        return self._field.ownership @ self._last_W

    def _moment(
        self, case: int, stage: int, time_s: float, temperature_K: FloatArray, rate_K_per_s: FloatArray
    ) -> Moment:
        driving, names = self._drivings[case], self._scenarios[case].forcings
        return Moment(
            self._field,
            time_s,
            temperature_K[:, case],
            rate_K_per_s[:, case],
            dict(zip(self._field.boundaries, driving.boundary_K[self._step, stage].tolist(), strict=True)),
            dict(zip(names, driving.channels[self._step, stage].tolist(), strict=True)),
        )


def _finish(
    scenario: Scenario,
    field: Field,
    clock: Clock,
    paths: dict[str, Path],
    driving: Driving,
    history: _History,
    case: int,
) -> Simulation:
    """Return record and truth of one case."""
    steps_s = clock.ends_s
    kept = steps_s >= -1e-9
    readings = {s.channel: history.readings_K[:, i, case] for i, s in enumerate(scenario.sensors)}
    regions = [region.id for region in scenario.regions]
    lost_W = (driving.inputs_W - _declared_W(scenario, driving))[:, -1] @ field.inputs.T @ field.ownership.T
    hidden_W = history.hidden_W[:, :, case] + np.concatenate([lost_W[:1], lost_W])
    truth = Truth(
        time_s=steps_s[kept],
        temperature_K={name: column[kept] for name, column in readings.items()},
        region_K={name: history.regions_K[kept, i, case] for i, name in enumerate(regions)},
        hidden_heat_W={name: hidden_W[kept, i] for i, name in enumerate(regions)},
        imbalance=history.imbalance[kept, case],
        capacity_J_per_K=field.capacity_J_per_K,
    )
    return Simulation(measure(scenario, steps_s, readings, paths), truth)


def _declared_W(scenario: Scenario, driving: Driving) -> FloatArray:
    """Return the declared heat of every forcing, zero where it is not heat."""
    is_power = np.array([forcing.kind == "power" for forcing in scenario.forcings.values()], dtype=bool)
    return driving.channels * is_power
