"""Files in and out: specifications, telemetry, models."""

from pathlib import Path
from typing import overload

from thermal_twin.frames import Record
from twin_core.calibrate.result import CalibratedModel
from twin_core.closed_loop import ClosedLoop
from twin_core.errors import TelemetryError
from twin_core.files import write_text
from twin_core.network.screened import screened
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import load_spec, read_mapping
from twin_core.telemetry_csv import read_csv


@overload
def read(path: str | Path) -> TwinSpec | CalibratedModel: ...
@overload
def read(path: str | Path, spec: TwinSpec) -> Record: ...


def read(path: str | Path, spec: TwinSpec | None = None) -> TwinSpec | CalibratedModel | Record:
    """Read a file.

    Parameters
    ----------
    path
        A specification (YAML or JSON), a model (JSON, as ``save`` and the command line write it), or telemetry (CSV).
    spec
        Declares the channels of telemetry.

    Returns
    -------
    TwinSpec, CalibratedModel or Record
        Telemetry without samples that cannot be readings; ``record.notices`` says what was left out.

    Raises
    ------
    SpecError, TelemetryError
        With one line that names the file and what is wrong.
    """
    path = Path(path)
    if path.suffix == ".csv":
        if spec is None:
            raise TelemetryError(f"{path}: telemetry needs a specification: tt.read({str(path)!r}, spec)")
        return Record.of(screened(spec, read_csv(path, spec)), spec)
    if spec is not None:
        raise TelemetryError(f"{path}: telemetry is read from CSV here; twin record and twin simulate write it")
    data = read_mapping(path)
    if "spec" in data and "values" in data:
        return CalibratedModel.from_json(data)
    return load_spec(path)


def save(what: CalibratedModel | ClosedLoop, path: str | Path, *, author: str = "") -> Path:
    """Write a model to a JSON file, or a closed loop's report, page and model into a folder; return where.

    The page carries today's date and the ``author``; a browser prints it as a report to sign. The model that stands in the folder
    is read again by ``read``.
    """
    import json
    from datetime import UTC, datetime

    path = Path(path)
    if isinstance(what, CalibratedModel):
        write_text(path, json.dumps(what.to_json(), indent=2))
        return path
    from twin_core.files import make_folder
    from twin_core.report.html import render

    make_folder(path)
    what.report["document"] = {"date": datetime.now(UTC).date().isoformat(), "author": author}
    write_text(path / "model.json", json.dumps(what.model.to_json(), indent=2))
    write_text(path / "report.json", json.dumps(what.report, indent=2))
    write_text(path / "report.html", render(what.report, what.plots))
    return path
