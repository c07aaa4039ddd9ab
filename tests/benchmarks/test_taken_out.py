"""Parts taken out of measured declarations: what is left is a declaration, and an effect could put the part back."""

import pytest

from benchmarks.loop import place
from benchmarks.measured_splits import example
from benchmarks.taken_out import MOST_PARTS, TakenOut, parts, places, table, without
from twin_core.effects import REGISTRY
from twin_core.network.model import build_network

EXAMPLES = ("three-block", "tclab", "daisy", "flexhouse", "dutch-home", "funcube1")


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_part_leaves_a_declaration_that_effects_could_complete(name: str) -> None:
    spec = example(name)
    own = parts(spec, name)
    assert 0 < len(own) <= MOST_PARTS
    assert len({part.name for part in own}) == len(own)
    for part in own:
        left = without(spec, part)
        assert len(left.conductors) + len(left.loads) == len(spec.conductors) + len(spec.loads) - 1
        offered = {
            place({"effect": effect, "where": {k: [*v] if isinstance(v, tuple) else v for k, v in where.items()}})
            for effect, kind in REGISTRY.items()
            for where in kind.places(build_network(left).layout)
        }
        assert places(spec, part) & offered


def test_a_table_counts_what_came_back() -> None:
    row = {"group": "lab", "words": "a-b", "verdict": "effect_added", "before_K": 2.0, "seconds": 3.0}
    rows = [
        {**row, "task": "lab: 1", "named": True, "listed": True, "found": "missing_conductor a-b", "after_K": 1.0},
        {**row, "task": "lab: 2", "named": False, "listed": True, "found": "sensor_lag T", "after_K": 2.1},
        {**row, "task": "lab: 3", "named": False, "listed": False, "found": "", "after_K": 2.0},
        {"task": "lab: 4", "group": "lab", "error": "ModelError()"},
    ]
    told = table(rows)
    for words in (
        "named | 1 of 4",
        "an alternative | 1 of 4",
        "nothing | 1 of 4",
        "worse after | 1 of 4",
        "ModelError()",
    ):
        assert words in told


def test_a_part_has_the_name_of_its_ends() -> None:
    assert TakenOut("lab", "conductors", 0, "a-b").name == "lab: a-b"
