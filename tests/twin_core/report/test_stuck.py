"""A sensor that never changes is told first, and nothing is guessed from it."""

from dataclasses import replace

import numpy as np

from benchmarks.network_cases import network_case
from tests.twin_core.quality.test_lapses import heated
from twin_core.calibrate import calibrate
from twin_core.closed_loop import close_loop
from twin_core.report.phrasing import headline


def test_no_mistake_of_the_declaration_is_guessed_beside_a_stuck_sensor() -> None:
    """The heater was taken for milliwatts, since nothing that it did was seen."""
    spec, record = heated()
    record.values["T0"][:] = 294.15
    summary = calibrate(spec, [record]).summary
    assert not any("perhaps" in line for line in summary["words"])
    report = close_loop(spec, [record]).report
    assert report["resting_sensors"] == ["T0"] and report["suspicions"] == []
    assert "stuck" in headline(report) and not any("perhaps" in line for line in report["notices"])


def test_nothing_is_found_beside_one_stuck_sensor_among_others() -> None:
    """Three effects were named around one, and the model with them predicted twice as badly as the declared one."""
    case = network_case("leak_to_boundary", 3, n_orbits=4, dt_s=120.0)
    sensor = case.spec.sensors[0]
    values = case.record.values | {sensor: np.full(case.record.time_s.size, 293.15)}
    report = close_loop(case.spec, [replace(case.record, values=values)]).report
    assert report["resting_sensors"] == [sensor]
    assert report["findings"] == [] and report["verdict"] == "unexplained"
    assert headline(report).startswith(f"Sensor {sensor} never changes")
