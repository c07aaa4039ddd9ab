"""The checker of effects: silent about every effect of the vocabulary, loud about each way to get one wrong."""

from pathlib import Path

import pytest

from tests.louver import PLUGIN
from twin_core.effects import REGISTRY
from twin_core.effects.base import Effect
from twin_core.effects.check import CHECKS, check_effect
from twin_core.effects.plugins import effects_in_file

LOUVER = PLUGIN.read_text()
CONDUCTOR = (Path(__file__).parents[3] / "twin_core" / "effects" / "missing_conductor.py").read_text()
CAPACITY = (Path(__file__).parents[3] / "twin_core" / "effects" / "latent_heat.py").read_text()
DRIFT = (Path(__file__).parents[3] / "twin_core" / "effects" / "sensor_drift.py").read_text()
OFFSET = (Path(__file__).parents[3] / "twin_core" / "effects" / "boundary_offset.py").read_text()


@pytest.mark.parametrize("kind", REGISTRY.values(), ids=list(REGISTRY))
def test_the_vocabulary_passes(kind: type[Effect]) -> None:
    assert [check for check in check_effect(kind) if not check.passed] == []
    assert [check.name for check in check_effect(kind)] == list(CHECKS)


def changed(tmp_path: Path, text: str, *changes: tuple[str, str]) -> type[Effect]:
    """Return the effect of a source that is changed in some places."""
    for before, after in changes:
        assert before in text, before
        text = text.replace(before, after)
    file = tmp_path / "mine.py"
    file.write_text(text)
    return effects_in_file(file)[-1]


WARMING = ("(sink**4 - temperature**4)", "(temperature**4 - sink**4)")
ITS_SLOPES = (
    ("moving * bare - share * 4.0", "moving * bare + share * 4.0"),
    ("by_sink = area_m2", "by_sink = -area_m2"),
)
TWICE = """    def _nothing(cls) -> None: ...

    def unit_heats(self, survey):
        return [[(node, 2.0 * series) for node, series in column] for column in super().unit_heats(survey)]

    @classmethod
"""
LOCAL = [
    ("        return Addition((LouverHeat(", "        class Local(LouverHeat): ...\n\n        return Addition((Local(")
]


@pytest.mark.parametrize(
    ("text", "changes", "failing", "detail"),
    [
        (LOUVER, [('"louver"', '"A louver"')], "name and sentence", "must be lower-case words joined by underscores"),
        (LOUVER, [('("node", "sink")', '("node", "skin")')], "name and sentence", "'skin' is none of node, nodes"),
        (LOUVER, [("between {node}", "between {box}")], "name and sentence", "does not fit the place"),
        (LOUVER, [(' = "q = sigma R s (T_s^4 - T^4), s = (T', ' = "(T')], "name and sentence", "equation must say"),
        (LOUVER, [("in layout.boundaries)", "in ())")], "places", "yields none"),
        (LOUVER, [('{"node": node, "sink": sink}', '{"sink": sink, "node": node}')], "places", "not those of 'keys'"),
        (LOUVER, [('"R_m2": 0.0', '"R_m2": 0.1')], "starts", "starts yields R_m2 = 0.1, not null"),
        (LOUVER, [(", null=0.0", "")], "starts", "no parameter has a null value"),
        (LOUVER, [("SHUT_QUANTILES = (0.05, 0.25, 0.5, 0.75)", "SHUT_QUANTILES = ()")], "starts", "no start there"),
        (LOUVER, [("T_shut_K", "T_shut")], "parameters", "T_shut is in K; let its name end in _K"),
        (LOUVER, [('"R_m2", "m2"', '"R_m2", "cm2"')], "parameters", "R_m2 says m2, its unit is 'cm2'"),
        (LOUVER, [("area_m2 * share * bare)[", "area_m2 * share * bare - 1.0)[")], "null", "still brings heat"),
        (DRIFT, [("values[0] *", "1e-3 + values[0] *")], "null", "still changes the reading"),
        (LOUVER, [("(temperature - shut_K)", "np.sqrt(temperature - shut_K)")], "range", "not finite"),
        (LOUVER, [("moving * bare - share", "share * bare - share")], "derivatives", "d heat / d T of a is off by"),
        (LOUVER, [("sink**3", "sink**2")], "derivatives", "d heat / d T of space is off by"),
        (
            CAPACITY,
            [("            -extra * x / width,", "            extra * x / width,")],
            "derivatives",
            "d capacity / d T",
        ),
        (CAPACITY, [("heat * molten,", "heat * molten**2,")], "derivatives", "d stored heat / d T"),
        (DRIFT, [("[(0, elapsed)]", "[(0, 2.0 * elapsed)]")], "derivatives", "sensor_drift(T_a).d_K_per_s is off by"),
        (OFFSET, [("one, [(0, one)]", "2.0 * one, [(0, one)]")], "derivatives", "d boundary / d what was there"),
        (
            LOUVER,
            [("    def places", TWICE + "    def places")],
            "amplitude",
            "not the slope of the heat with R_m2 at null",
        ),
        (
            LOUVER,
            [("-area_m2 * moving * share", "-area_m2 * moving")],
            "derivatives",
            "louver(a,space).T_range_K is off",
        ),
        (LOUVER, [WARMING, *ITS_SLOPES], "sign", "heat flows into a while space is colder"),
        (CONDUCTOR, [("[heat, -heat]", "[heat, -0.9 * heat]")], "energy", "must add up to zero"),
        (LOUVER, [('"T_range_K": range_K}', '"T_range_K": range_K}, {"box": {"a": (1.0,)}}')], "model file", "another"),
        (LOUVER, LOCAL, "processes", "in processes of their own"),
    ],
)
def test_each_mistake_is_told(
    tmp_path: Path, text: str, changes: list[tuple[str, str]], failing: str, detail: str
) -> None:
    outcome = check_effect(changed(tmp_path, text, *changes))
    failed = {check.name: check.detail for check in outcome if not check.passed}
    assert failing in failed, outcome
    assert detail in failed[failing]
