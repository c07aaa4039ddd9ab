"""A sensor that never changes is told first, and nothing is guessed from it."""

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
