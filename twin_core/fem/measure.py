"""From true temperatures to telemetry: sensor faults, sampling, noise, quantisation, gaps."""

from collections.abc import Mapping

import numpy as np

from twin_core._typing import FloatArray
from twin_core.errors import SpecError
from twin_core.fem.drive import generator
from twin_core.fem.scenario import Scenario
from twin_core.fem.signals import Path
from twin_core.telemetry import Record


def sample_times(scenario: Scenario) -> FloatArray:
    """Return the sampling instants, (n_times,): a regular grid from 0, jittered if asked."""
    time = scenario.time
    count = int(np.floor(time.duration_s / time.sample_s + 1e-9)) + 1
    grid: FloatArray = np.arange(count, dtype=np.float64) * time.sample_s
    if time.jitter_s:
        shift = generator(scenario, "sampling").uniform(-time.jitter_s, time.jitter_s, grid.size)
        shift[0] = abs(shift[0])
        grid = grid + shift
    return grid


def measure(
    scenario: Scenario, steps_s: FloatArray, truth_K: Mapping[str, FloatArray], paths: dict[str, Path]
) -> Record:
    """Return the record that an operator would see.

    Parameters
    ----------
    steps_s : (n_steps + 1,)
        Instants of the simulation.
    truth_K : sensor -> (n_steps + 1,)
        True temperature at each sensor.
    paths
        Realised forcings, and the power of the thermostats.
    """
    time_s = sample_times(scenario)
    values: dict[str, FloatArray] = {}
    for sensor in scenario.sensors:
        reading = truth_K[sensor.channel]
        for effect in scenario.hidden:
            if effect.where.get("sensor") == sensor.channel:
                reading = effect.read(reading, steps_s, scenario.epoch_ns)
        clean = np.interp(time_s, steps_s, reading)
        values[sensor.channel] = _disturb(scenario, sensor.channel, clean, sensor.noise_std_K, sensor.quantum_K)
    for name, forcing in scenario.forcings.items():
        if forcing.recorded:
            values[name] = _disturb(scenario, name, paths[name](time_s), forcing.noise_std_K, 0.0)
    for thermostat in scenario.thermostats:
        values[thermostat.channel] = paths[thermostat.channel](time_s)
    _cut_gaps(scenario, time_s, values)
    return Record(time_s, values, scenario.epoch_ns, scenario.scenario)


def _disturb(scenario: Scenario, channel: str, clean: FloatArray, noise_std: float, quantum: float) -> FloatArray:
    """Add noise and round to the quantum."""
    noisy = clean + noise_std * generator(scenario, f"noise {channel}").standard_normal(clean.size)
    return np.round(noisy / quantum) * quantum if quantum else noisy


def _cut_gaps(scenario: Scenario, time_s: FloatArray, values: dict[str, FloatArray]) -> None:
    """Put NaN where samples are missing; temperatures lose single samples at random, all channels lose gaps."""
    sensors = {sensor.channel for sensor in scenario.sensors}
    for name, column in values.items():
        lost = np.zeros(time_s.size, dtype=bool)
        if name in sensors and scenario.time.missing_fraction:
            lost = generator(scenario, f"missing {name}").random(time_s.size) < scenario.time.missing_fraction
        for gap in scenario.time.gaps:
            if gap.channel in (None, name):
                lost |= (time_s >= gap.start_s) & (time_s < gap.stop_s)
        if lost.all():
            raise SpecError(f"time.gaps: channel '{name}' has no sample left")
        column[lost] = np.nan
