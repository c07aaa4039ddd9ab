"""Model files -> calibrated models."""

from pathlib import Path

from twin_core.calibrate import CalibratedModel
from twin_core.errors import SpecError
from twin_core.network.spec_io import read_mapping


def load_model(path: Path) -> CalibratedModel:
    """Read a model file.

    Raises
    ------
    SpecError
        With one line naming the file and the field.
    """
    data = read_mapping(path)
    try:
        return CalibratedModel.from_json(data)
    except SpecError as error:
        raise SpecError(f"{path}: {error}") from error
