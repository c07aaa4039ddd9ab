"""What an importer hands back, and what all importers share."""

import re
from dataclasses import dataclass, field
from typing import Any

from twin_core._typing import Json


@dataclass(frozen=True)
class Imported:
    """A model of another tool as the data of a specification.

    Attributes
    ----------
    data
        What ``load_spec`` reads.
    notes
        What was translated in another form, or told and left out because it changes no temperature: one line each.
    refused
        What has no counterpart here, one line each that names file and line: the model is not whole without it.
    start_K
        Node -> the initial temperature that the model names.
    """

    data: Json
    notes: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    start_K: dict[str, float] = field(default_factory=dict)


def name_of(text: str, prefix: str = "n") -> str:
    """Return a text as a name of the specification: what a name cannot hold becomes '_', a leading digit gets a prefix."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", text.strip())
    return name if name[:1].isalpha() or name[:1] == "_" else f"{prefix}{name}"


def twin_id(text: str) -> str:
    """Return a text as the id of a twin."""
    return re.sub(r"-+", "-", re.sub(r"[^a-z0-9-]", "-", text.lower())).strip("-")[:63] or "imported"


def number(value: float) -> float:
    """Return a number as it should stand in a file: short of what its last digits do not mean."""
    return float(f"{value:.15g}")


Data = dict[str, Any]
