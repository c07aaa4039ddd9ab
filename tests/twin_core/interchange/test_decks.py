"""Small ESATAN-TMS and SINDA decks of our own, against their steady states written down; and other people's where they are."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import fsolve

from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4 as SIGMA
from twin_core.errors import NoSolutionError, SpecError
from twin_core.interchange.esatan import read_esatan
from twin_core.interchange.imported import Course, Imported, over_time
from twin_core.interchange.sinda import read_sinda
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.steady import steady_state

MODELS = Path(os.environ.get("FOREIGN_MODELS", Path(__file__).parents[4] / "shared" / "models"))

ESATAN = """\
$MODEL PLATE  # a plate, its cover, a mount
  $LOCALS
    $REAL
      k = 2.0D0;  width = 0.1;   # arithmetic over locals
      area = width * 0.2 +
             0.01;
      P = 4.0;
  $NODES
    D1 = 'Plate', T = 20.0, C = 900.0 * 0.3, A = area, ALP = 0.3, EPS = 0.8, QI = 1.0;
    D2 = 'Cover', T = 0.0, A = area, EPS = 0.5, FX = 0.0;
    D10 = 'Pin', T = 0.0, C = 5.0;
    D11 = 'Pin', T = 0.0, C = 5.0;
    D12 = 'Pin', T = 0.0, C = 5.0;
    X90 = 'Removed', T = 0.0;
    B99 = 'Space', T = -270.0, A = 1.0E+20, EPS = 1.0;
  $CONDUCTORS
    GL(1, 2) = k * area / 0.5;
    GL(1, 10) = 0.2;  GL(10, 1) = 0.1;
    FOR i = 10 TO 11 DO
      GL(i, i + 1) = 0.5 / (i - 9);
    END DO
    GR(12, 99) = 0.01;
    GR(1, 90) = 0.5;
    GF(1, 12) = 0.05;
    GV(2, 99) = 0.9;
  $CONSTANTS
  $ARRAYS
  $INITIAL
C A comment
      CALL VFAC
      IF (P .GE. 3.0D0) THEN
      QI10 = P * 0.5
      ELSE
      QI10 = 77.0
      END IF
      QI11 = QI10 / 2
  $EXECUTION
      CALL SOLVFM
$ENDMODEL
"""


def solved(imported: Imported, start_K: float = 280.0) -> dict[str, float]:
    """Return the steady state of what was imported."""
    network = build_network(load_spec(imported.data))
    return dict(zip(network.nodes, steady_state(network, np.full(len(network.nodes), start_K)).tolist(), strict=True))


def test_an_esatan_deck_is_in_balance_as_it_says() -> None:
    imported = read_esatan(ESATAN, "plate.d", channels={"n1": "T_plate"}, held=True)
    assert not imported.refused
    assert imported.start_K["n1"] == pytest.approx(293.15)
    found = solved(imported)
    space, area = 3.15, 0.03

    def balance(t: np.ndarray) -> list[float]:
        plate, cover, a, b, c = t
        joint = 2.0 * area / 0.5
        # the cover sees space with 0.9; a plate in front of a black hall exchanges e A F
        return [
            1.0 + joint * (cover - plate) + 0.3 * (a - plate),
            joint * (plate - cover) + SIGMA * 0.5 * area * 0.9 * (space**4 - cover**4),
            2.0 + 0.3 * (plate - a) + 0.5 * (b - a),
            1.0 + 0.5 * (a - b) + 0.25 * (c - b),
            0.25 * (b - c) + 0.05 * (plate - c) + SIGMA * 0.01 * (space**4 - c**4),
        ]

    expected = fsolve(balance, np.full(5, 280.0), xtol=1e-12)
    np.testing.assert_allclose([found[f"n{i}"] for i in (1, 2, 10, 11, 12)], expected, atol=1e-4)
    assert any("inactive" in note for note in imported.notes) and any("parallel" in note for note in imported.notes)


WRONG = {
    "GL(1, 2) = k * area / 0.5;": ("GL(1, 7) = 1.0;", "node 7 is declared nowhere"),
    "GF(1, 12) = 0.05;": ("GT(1, 12) = 0.05;", "is no GL, GR, GF or GV"),
    "GR(12, 99) = 0.01;": ("GR(12, 99) = INTRP1(T12, tab, 1);", "cannot use 'intrp1"),
    "QI11 = QI10 / 2": ("CALL HEATER(11)", "not understood"),
    "D10 = 'Pin', T = 0.0, C = 5.0;": ("D10 = 'Pin', T = 0.0, C = unheard;", "'unheard' is not known"),
    "  $CONSTANTS\n": ("  $CONSTANTS\n    $CONTROL\n      TABS = 0.0;\n", "TABS is 0: only temperatures in degC"),
    "IF (P .GE. 3.0D0) THEN": ("IF (T1 .GE. 3.0D0) THEN", "what stands under this condition is not read"),
    "  $ARRAYS\n": ("  $ARRAYS\n    tab = 1, 2;\n", "is no array of one or two dimensions"),
}


@pytest.mark.parametrize("old", WRONG)
def test_what_an_esatan_deck_cannot_say_is_one_line_with_its_place(old: str) -> None:
    new, said = WRONG[old]
    text = ESATAN.replace(old, new)
    lines = read_esatan(text, "plate.d", held=True).refused
    number = 1 + text[: text.index(new.strip().splitlines()[-1].strip())].count("\n")
    assert any(said in line and line.startswith(f"plate.d: line {number}: ") for line in lines), lines


def test_a_deck_that_was_cut_off_is_refused() -> None:
    (line,) = read_esatan(ESATAN.replace("$ENDMODEL\n", ""), "plate.d", held=True).refused
    assert "ends without $ENDMODEL" in line


def test_nothing_under_a_condition_that_is_not_understood_is_taken() -> None:
    deck = ESATAN.replace("IF (P .GE. 3.0D0) THEN", "IF (T1 .GE. 3.0D0) THEN").replace("QI11 = QI10 / 2", "QI11 = 3.0")
    imported = read_esatan(deck, "plate.d", held=True)
    assert len(imported.refused) == 1
    assert {load["node"] for load in imported.data["loads"]} == {"n1", "n11"}


def test_the_constant_of_radiation_is_the_decks_own() -> None:
    constants = f"  $CONSTANTS\n    $CONTROL\n      STEFAN = {2.0 * SIGMA!r};\n"
    own, usual = (read_esatan(text, "d", held=True) for text in (ESATAN.replace("  $CONSTANTS\n", constants), ESATAN))
    areas = [[r["area_m2"]["value"] for r in found.data["radiation"]] for found in (own, usual)]
    np.testing.assert_allclose(areas[0], 2.0 * np.array(areas[1]))


def test_what_is_no_deck_is_refused() -> None:
    with pytest.raises(SpecError, match="no \\$MODEL"):
        read_esatan("hello", "x.d")


SINDA = {
    "case.inp": "HEADER CONTROL DATA, GLOBAL\n    abszro = 0.\n    sigma = 5.67e-08\n    UID = SI\nINSERT case.cc\n",
    "case.cc": """\
HEADER OPTIONS
C    a comment
HEADER NODE DATA, BOX
    1,    293.15,    10.5
    2,    293.15,    -1.0
    3,    293.15,    20.0  $ with words
HEADER CONDUCTOR DATA, BOX
    1,    BOX.1,    BOX.2,    0.02
    2,    2,        3,        0.03
    3,    BOX.1,    -BOX.3,   0.01
HEADER VARIABLES 0, BOX
      BOX.Q1 = BOX.Q1 + 0.5
      Q3 = Q3 + 0.25
HEADER NODE DATA, SPACE
    -1,    2.73,    -1.0
""",
    "case.k": """\
HEADER CONDUCTOR DATA, RADK
PSTOP
  -1,  BOX.1,  SPACE.1,  0.004  $ 0.2
  -2, BOX.3, SPACE.1, 0.002
  -3, BOX.1, BOX.3, 1e-3
PSTART
""",
    "case.hra": """\
HEADER ARRAY DATA, RATES
C Average heating rates
C     1= 1.500000e-01 ,2.500000e-01
C Relative node storage for LOADQ
HEADER CARRAY DATA, RATES
 1 = BOX, 1, 3
""",
}


def test_a_sinda_deck_is_in_balance_as_it_says() -> None:
    deck = {name: text.replace("-BOX.3", "BOX.-3") for name, text in SINDA.items()}
    imported = read_sinda(deck, channels={"BOX.1": "T"}, held=True)
    assert not imported.refused, imported.refused
    found = solved(imported)
    sigma = 5.67e-8

    def balance(t: np.ndarray) -> list[float]:
        a, b, c = t
        return [
            0.65 + 0.02 * (b - a) + 0.01 * (c - a) + sigma * (0.004 * (2.73**4 - a**4) + 1e-3 * (c**4 - a**4)),
            0.02 * (a - b) + 0.03 * (c - b),
            0.5 + 0.03 * (b - c) + sigma * (0.002 * (2.73**4 - c**4) + 1e-3 * (a**4 - c**4)),
        ]

    expected = fsolve(balance, np.full(3, 250.0), xtol=1e-12)
    np.testing.assert_allclose([found[f"BOX.{i}"] for i in (1, 2, 3)], expected, atol=1e-4)


@pytest.mark.parametrize(
    "line, said",
    [
        ("    GEN 4, 10, 1, 293.15, 2.0", "is not understood"),
        ("    3,    293.15,    1.0", "declared twice"),
        ("    SIV 4, 293.15, A1, 1.0", "is not understood"),
    ],
)
def test_what_a_sinda_deck_cannot_say_is_one_line_with_its_place(line: str, said: str) -> None:
    text = SINDA["case.cc"].replace("HEADER CONDUCTOR DATA, BOX", f"{line}\nHEADER CONDUCTOR DATA, BOX")
    refused = read_sinda({"case.cc": text}, held=True).refused
    assert any(r.startswith("case.cc: line 7: ") and said in r for r in refused), refused


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("NLOOPS = 1000, ABSZRO = -459.67", "neither K nor degC"),
        ("SIGMA = TWO * 5.67E-8", "is not understood"),
        ("UID = ENG, NLOOPS = 3", "units are 'ENG'"),
    ],
)
def test_every_setting_of_a_line_counts(line: str, said: str) -> None:
    case = SINDA["case.inp"].replace("    UID = SI\n", f"    {line}\n")
    refused = read_sinda({"case.inp": case, "case.cc": SINDA["case.cc"]}, held=True).refused
    assert any(r.startswith("case.inp: line 4: ") and said in r for r in refused), refused


def test_couplings_by_submodel_share_a_factor() -> None:
    """The same steady state as with every number known, and the factors are all that is free."""
    deck = {name: text.replace("-BOX.3", "BOX.-3") for name, text in SINDA.items()}
    grouped = read_sinda(deck, channels={"BOX.1": "T"}, by_submodel=True)
    assert grouped.data["parameters"] == {name: {"guess": 1.0} for name in ("GL_BOX", "GR_BOX_SPACE", "GR_BOX")}
    network = build_network(load_spec(grouped.data))
    assert set(network.parameters.free_names) == {"GL_BOX", "GR_BOX_SPACE", "GR_BOX"}
    known = solved(read_sinda(deck, channels={"BOX.1": "T"}, held=True))
    assert solved(grouped) == pytest.approx(known, abs=1e-6)


OPERATION = "HEADER OPERATION DATA\n{}\nHEADER OUTPUT CALLS, BOX\n      CALL TPRINT('ALL')\n"


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("BUILD ALL", "BUILD ALL"),
        ("BUILD CASE, SPACE, BOX", "BUILD CASE, SPACE, BOX"),
        (
            "BUILD ALL\n      CALL TDHTR\n      CALL STEADY\n      TIMEND = 5700.",
            "BUILD ALL; CALL TDHTR; CALL STEADY; TIMEND",
        ),
    ],
)
def test_what_a_sinda_deck_runs_is_told(lines: str, said: str) -> None:
    routine = "HEADER SUBROUTINE\n      SUBROUTINE TDHTR\nC     nothing\n      RETURN\n      END\n"
    deck = {"case.inp": OPERATION.format(lines), "case.cc": SINDA["case.cc"] + routine}
    imported = read_sinda(deck, channels={"BOX.1": "T"}, held=True)
    assert not imported.refused, imported.refused
    assert any(n.startswith("case.inp: line 1: ") and said in n for n in imported.notes), imported.notes
    assert any(": HEADER OUTPUT CALLS" in n and "passed over" in n for n in imported.notes), imported.notes


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("BUILD CASE, BOX", "leaves out SPACE"),
        ("      BOX.T1 = 300.", "is code, which is not read"),
        ("      Q1 = 3.0", "is code, which is not read"),
        ("      CALL HTRMOD('BOX')", "'HTRMOD' stands nowhere in the deck"),
        ("      IF (BOX.T1 .GT. 300.) CALL STEADY", "is code, which is not read"),
    ],
)
def test_what_a_sinda_deck_changes_as_it_runs_is_refused(line: str, said: str) -> None:
    deck = {"case.inp": OPERATION.format(line), "case.cc": SINDA["case.cc"]}
    refused = read_sinda(deck, held=True).refused
    assert any(r.startswith("case.inp: line 2: ") and said in r for r in refused), refused


def test_a_node_that_cannot_lose_heat_has_no_steady_state() -> None:
    data = {
        "twin": "t",
        "channels": {"T": {"kind": "temperature", "unit": "K"}},
        "nodes": [{"id": "a", "sensor": "T", "capacity_J_per_K": {"value": 1.0}}],
    }
    with pytest.raises(NoSolutionError):
        steady_state(build_network(load_spec(data)), np.array([280.0]))


@pytest.mark.skipif(not (MODELS / "sinda").is_dir(), reason="other people's decks are not beside this checkout")
def test_the_deck_of_a_flown_cubesat_has_the_temperatures_that_sinda_printed() -> None:
    folder = MODELS / "sinda" / "oresat05"
    names = ("case0.inp", "case0.cc", "C0A0.k", "C0A2.k", "C0A1.hra")
    imported = read_sinda({name: (folder / name).read_text() for name in names}, channels={"BATTERY.1": "T"}, held=True)
    assert not imported.refused
    found, printed, submodel = solved(imported, 293.15), dict[str, float](), ""
    for line in (folder / "case0.out").read_text().splitlines():
        if match := re.search(r"SUBMODEL NAME = (\w+)", line):
            submodel = match[1]
        printed |= {f"{submodel}.{n}": float(t) for n, t in re.findall(r"T\s+(\d+)=\s*([-\d.]+)", line)}
    assert len(found) == 658
    assert max(abs(found[node] - printed[node]) for node in found) < 0.01


@pytest.mark.skipif(not (MODELS / "esatan").is_dir(), reason="other people's decks are not beside this checkout")
def test_the_deck_of_a_small_satellite_is_read_whole() -> None:
    imported = read_esatan((MODELS / "esatan" / "RU_template.txt").read_text(), "RU", held=True)
    assert not imported.refused
    network = build_network(load_spec(imported.data))
    found = solved(imported)
    assert len(found) == 40 and len(imported.data["conductors"]) == 51
    values = network.parameters.as_dict()
    assert values["G:n10|n11"] == pytest.approx(28.0 * 0.320)
    assert values["G:n100|n101"] == pytest.approx(0.0102870 / (2 * 0.0005 / 130.0))
    heats = {load["node"]: load["gain"]["value"] for load in imported.data["loads"]}
    produced = 0.115 * 0.127 * 0.28 * 0.5 * 1365.0 + 0.127 * 0.1 * 0.28 * 0.5 * 1365.0
    assert heats["n102"] == pytest.approx(produced * 0.05)
    assert heats["n300"] == pytest.approx(0.2 + (produced * 0.95 - 0.5) * 0.5)
    lost_W = sum(
        SIGMA * r["area_m2"]["value"] * (found[next(n for n in r["between"] if n != "n99999")] ** 4 - 3.15**4)
        for r in imported.data["radiation"]
        if "n99999" in r["between"]
    )
    assert lost_W == pytest.approx(sum(heats.values()), rel=1e-6)


def timed(assignments: str) -> Imported:
    """Return the plate with arrays, and heats that follow them."""
    arrays = """\
  $ARRAYS
    $REAL
      SUN(2, 4) = 0.0, 0.0,  1000.0, 80.0,  2000.0, 80.0,  6000.0, 0.0;
      CARDS(3) = 1.5, 2.5, k * 2.0;
"""
    code = f"  $VARIABLES1\n{assignments}  $EXECUTION\n"
    return read_esatan(ESATAN.replace("  $ARRAYS\n", arrays).replace("  $EXECUTION\n", code), "plate.d", held=True)


def test_esatan_arrays_are_read_as_numbers_and_over_time() -> None:
    imported = timed(
        "      QS1 = 0.3 * INTCYC(TIMEM, SUN, 1, 6000.0, 0.0) * width\n"
        "      QA1 = INTRP1(TIMEM, SUN, 1)\n"
        "      QI12 = CARDS(2) + CARDS(3)\n"
    )
    assert not imported.refused, imported.refused
    assert imported.data["channels"]["SUN"] == {"kind": "power", "unit": "W", "interpolation": "linear"}
    gains = {load["node"]: load["gain"]["value"] for load in imported.data["loads"] if load["channel"] == "SUN"}
    assert gains == {"n1": pytest.approx(0.3 * 0.1 + 1.0)}
    heats = {load["node"]: load["gain"]["value"] for load in imported.data["loads"] if load["channel"] == "QI"}
    assert heats["n12"] == pytest.approx(2.5 + 4.0)
    time_s, columns = over_time(imported.courses, 9000.0)
    np.testing.assert_allclose(np.interp([500.0, 4000.0], time_s, columns["SUN"]), [40.0, 40.0])
    load_spec(imported.data)


@pytest.mark.parametrize(
    ("assignment", "said"),
    [
        ("QS1 = INTCYC(TIMEM, MOON, 1, 6000.0, 0.0)", "MOON is no array of pairs"),
        ("QS1 = INTCYC(TIMEM, SUN, 1)", "names no period"),
        ("QS1 = 1.0 + INTRP1(TIMEM, SUN, 1)", "is no positive multiple"),
        ("QI1 = CARDS(7)", "beyond the 3 elements"),
    ],
)
def test_what_an_array_cannot_say(assignment: str, said: str) -> None:
    assert any(said in line for line in timed(f"      {assignment}\n").refused)


def test_a_cycle_repeats_and_a_course_ends_where_it_ends() -> None:
    cycle = Course(np.array([0.0, 50.0, 100.0]), np.array([1.0, 3.0, 1.0]), 100.0)
    once = Course(np.array([0.0, 30.0]), np.array([5.0, 8.0]))
    time_s, columns = over_time({"a": cycle, "b": once}, 250.0)
    np.testing.assert_array_equal(time_s, [0.0, 30.0, 50.0, 100.0, 150.0, 200.0, 250.0])
    np.testing.assert_allclose(columns["a"], [1.0, 2.2, 3.0, 1.0, 3.0, 1.0, 3.0])
    np.testing.assert_allclose(columns["b"], [5.0, 8.0, 8.0, 8.0, 8.0, 8.0, 8.0])


COURSES = """\
C Time Array
C     5=           0.0,1.000000e+03 ,2.000000e+03
      5=           0.0,1.000000e+03 ,2.000000e+03
C solar albedo planetshine - BOX.1 Area = 0.000723 Avg = 0.002449 0.000580 0.012304
C Errors:  20.1, 20.1
C          20.1
C     6= 1.000000e-01 ,2.000000e-01
C       1.000000e-01
C solar albedo planetshine - BOX.3 Area = 0.000723 Avg = 0.002449 0.000580 0.012304
C Errors:  20.1, 20.1, 20.1
C     7= 3.000000e-01 ,2.000000e-01 ,3.000000e-01
HEADER CARRAY DATA, RATES
"""


def test_heat_rates_of_an_orbit_over_time() -> None:
    deck = {name: text.replace("-BOX.3", "BOX.-3") for name, text in SINDA.items()}
    deck["case.hra"] = deck["case.hra"].replace("HEADER CARRAY DATA, RATES\n", COURSES)
    averaged = read_sinda(deck, channels={"BOX.1": "T"}, held=True)
    assert not averaged.courses and any("--over-time" in note for note in averaged.notes)
    imported = read_sinda(deck, channels={"BOX.1": "T"}, held=True, over_time=True)
    assert not imported.refused, imported.refused
    assert set(imported.courses) == {"Q_BOX.1", "Q_BOX.3"}
    course = imported.courses["Q_BOX.1"]
    np.testing.assert_allclose(course.at(np.array([500.0, 1000.0, 2500.0])), [0.15, 0.2, 0.15])
    loads = {load["channel"]: load["node"] for load in imported.data["loads"]}
    assert loads["Q_BOX.1"] == "BOX.1" and "orbit_average" not in loads
    load_spec(imported.data)


@pytest.mark.skipif(not (MODELS / "sinda").is_dir(), reason="other people's decks are not beside this checkout")
def test_the_heat_rates_of_a_flown_cubesat_average_to_its_averages() -> None:
    folder = MODELS / "sinda" / "oresat05"
    names = ("case0.inp", "case0.cc", "C0A0.k", "C0A2.k", "C0A1.hra")
    texts = {name: (folder / name).read_text() for name in names}
    imported = read_sinda(texts, channels={"BATTERY.1": "T"}, held=True, over_time=True)
    assert not imported.refused and len(imported.courses) > 300
    averages = {
        load["node"]: load["gain"]["value"]
        for load in read_sinda(texts, channels={"BATTERY.1": "T"}, held=True).data["loads"]
        if load["channel"] == "orbit_average"
    }
    for name, course in imported.courses.items():
        mean = float(np.trapezoid(course.values, course.time_s) / course.time_s[-1])
        assert mean == pytest.approx(averages[name.removeprefix("Q_")], rel=1e-3), name
