"""SINDA/FLUINT decks as Thermal Desktop writes them (``.cc``, ``.k``, ``.hra``, ``.inp``) -> a specification.

Numbers only, one node or conductor to a line: what a preprocessor would have to generate (``GEN``, ``SIV``, registers) is
refused by line.
"""

import re
from collections.abc import Callable, Mapping

import numpy as np

from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4, ZERO_CELSIUS_K
from twin_core.interchange.imported import Course, Imported, twin_id
from twin_core.interchange.network import Deck, specified

_HEADER = re.compile(r"^\s*HEADER\s+([A-Z0-9 ]+?)\s*(?:,\s*(\w+))?\s*$", re.IGNORECASE)
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[EeDd][-+]?\d+)?"
_HEAT = re.compile(rf"^\s*(?:(\w+)\.)?Q(\d+)\s*=\s*(?:(?:\1\.)?Q\2\s*\+\s*)?({_NUMBER})\s*$", re.IGNORECASE)

_SETTING = re.compile(rf"^(?!SIGMA|ABSZRO|[TCQGX]\d)[A-Z]\w*\s*=\s*{_NUMBER}$")
"""A constant of the solution, such as TIMEND, is set: no temperature, heat, conductor or unit."""

_RATED = re.compile(r"^C\s+solar albedo planetshine - (\S+)\s")

_TOLD = ("OPTIONS", "OUTPUT CALLS", "SOLVER")
"""Blocks that say how to solve and print, not what the model is."""

_SOLUTIONS = ("STEADY", "FASTIC", "STDSTL", "TRANSIENT", "FWDBCK", "FORWRD")
"""Routines of SINDA that solve the model as it is."""


def read_sinda(
    texts: Mapping[str, str],
    *,
    channels: Mapping[str, str] | None = None,
    held: bool = False,
    over_time: bool = False,
    by_submodel: bool = False,
) -> Imported:
    """Return a deck as a specification.

    Parameters
    ----------
    texts
        File -> its text: the ``.cc`` with nodes and conductors, ``.k`` with radiation, ``.hra`` with heat rates, and the
        ``.inp`` for its constants, which by default are those of kelvin and square metres.
    channels
        ``SUBMODEL.node`` -> column of the telemetry that reads it.
    held
        Take couplings as known; by default they are guesses.
    over_time
        Read the course of the heat rates over the orbit, a channel per node, instead of their averages.
    by_submodel
        Calibrate a factor for the couplings of each pair of submodels instead of every coupling.
    """
    reader = _Reader(over_time, Deck(twin_id(next(iter(texts)).rsplit("/", 1)[-1].split(".")[0])))
    for source in sorted(texts, key=lambda name: not name.endswith(".inp")):  # its constants come first
        reader.read(source, texts[source])
    deck = reader.deck
    reader.operate()
    for pair, line in reader.unseen.items():
        deck.refused.append(f"{line}: node '{pair}' is declared nowhere")
    return specified(deck, channels or {}, held=held, source=next(iter(texts)), by_submodel=by_submodel)


class _Reader:
    """One deck, file after file."""

    def __init__(self, over_time: bool, deck: Deck) -> None:
        self.deck, self.over_time = deck, over_time
        self.sigma = STEFAN_BOLTZMANN_W_PER_M2_K4
        self.zero = 0.0
        self.unseen: dict[str, str] = {}
        self.routines: set[str] = set(_SOLUTIONS)
        self.operations: dict[str, list[tuple[str, str]]] = {}
        self.waiting: list[tuple[str, str, str, bool, float]] = []
        self.rates: list[float] = []
        self.rated: list[str] = []
        self.times: list[float] = []
        self.courses: dict[str, list[float]] = {}
        self.announced: list[float] | None = None
        self.filling: list[float] | None = None

    def read(self, source: str, text: str) -> None:
        """Read one file."""
        block, submodel, opened = "", "MAIN", source
        self.rates, self.rated, self.times, self.courses = [], [], [], {}
        self.announced = self.filling = None
        self.waiting = []
        for n, raw in enumerate(text.splitlines(), start=1):
            where = f"{source}: line {n}"
            if raw[:1] in ("C", "c") and (len(raw) == 1 or not raw[1].isalpha()):
                self._comment(raw)
                continue
            line = raw.split("$", 1)[0].rstrip()
            if not line.strip():
                continue
            if header := _HEADER.match(line):
                block, submodel = " ".join(header[1].upper().split()), (header[2] or submodel).upper()
                if block in _TOLD:
                    self.deck.notes.append(f"{where}: HEADER {block} says how to solve and print; it is passed over")
                opened = where
                continue
            handle = self._handlers().get(block)
            if handle is not None:
                if not handle(where, submodel, line):
                    self.deck.refused.append(f"{where}: '{line.strip()[:60]}' in HEADER {block} is not understood")
            elif block == "OPERATION DATA":
                self.operations.setdefault(opened, []).append((where, line.strip().upper()))
            elif block == "SUBROUTINE":
                if named := re.match(r"^[FM ]?\s*SUBROUTINE (\w+)", line):
                    self.routines.add(named[1].upper())
                if not re.match(r"^[FM ]?\s*(SUBROUTINE \w+|RETURN|END|CALL COMMON)\s*$", line):
                    self.deck.refused.append(f"{where}: '{line.strip()[:60]}' is code, which is not read")
            elif block not in _TOLD and not self._neutral(where, line):
                self.deck.refused.append(f"{where}: '{line.strip()[:60]}' in HEADER {block or '?'} is not read")
        for where, first, second, radiates, value in self.waiting:
            self._join(where, first, second, radiates, value)
        self._apply_rates(source)

    def operate(self) -> None:
        """Tell what the deck runs, once all of it is read: submodels that are built, solutions, routines of its own.

        The code of these routines is refused line by line where it stands.
        """
        submodels = {node.split(".")[0] for node in (*self.deck.capacities, *self.deck.boundaries)}
        for opened, lines in self.operations.items():
            for where, line in lines:
                if built := re.match(r"BUILDF?\s+(.+)$", line):
                    names = set(re.split(r"[\s,]+", built[1]))
                    if lacking := sorted(submodels - names) if "ALL" not in names else []:
                        self.deck.refused.append(f"{where}: '{line[:60]}' leaves out {', '.join(lacking)}; all is read")
                elif called := re.match(r"(?:[FM]\s+)?CALL\s+(\w+)", line):
                    if called[1] not in self.routines:
                        self.deck.refused.append(f"{where}: the routine '{called[1]}' stands nowhere in the deck")
                elif not _SETTING.match(line):
                    self.deck.refused.append(f"{where}: '{line[:60]}' is code, which is not read")
            said = "; ".join(line for _, line in lines)
            self.deck.notes.append(f"{opened}: HEADER OPERATION DATA says what to run and is passed over ({said})")

    def _handlers(self) -> dict[str, Callable[[str, str, str], bool]]:
        return {
            "NODE DATA": self._node,
            "CONDUCTOR DATA": self._conductor,
            "VARIABLES 0": self._heat,
            "CONTROL DATA": self._control,
            "ARRAY DATA": self._array,
            "CARRAY DATA": self._rated,
        }

    def _neutral(self, where: str, line: str) -> bool:
        """Return whether a line outside of all blocks is known to change nothing; ``INSERT`` names another file."""
        if match := re.match(r"^\s*INSERT\s+(\S+)", line, re.IGNORECASE):
            self.deck.notes.append(f"{where}: inserts {match[1]}; give that file too")
            return True
        return line.strip().upper().startswith(("PSTOP", "PSTART"))

    def _comment(self, raw: str) -> None:
        """Read the heat rates of an orbit, which stand in comments: a title announces an array, a number opens it."""
        if "Average heating rates" in raw:
            self.announced = self.rates
        elif re.match(r"^C\s+Time Array", raw):
            self.announced = self.times
        elif match := _RATED.match(raw):
            self.announced = self.courses.setdefault(match[1].upper(), [])
        elif (values := _values(raw)) is not None:
            if "=" in raw:
                self.filling, self.announced = self.announced, None
            if self.filling is not None:
                self.filling += values
            return
        self.filling = None

    def _node(self, where: str, submodel: str, line: str) -> bool:
        parts = [p.strip() for p in line.split(",")]
        if len(parts) != 3 or not re.fullmatch(r"-?\d+", parts[0]) or not all(map(_is_number, parts[1:])):
            return False
        node, temperature, capacity = f"{submodel}.{abs(int(parts[0]))}", _float(parts[1]), _float(parts[2])
        if self.deck.knows(node):
            self.deck.refused.append(f"{where}: node '{node}' is declared twice")
            return True
        kelvin = max(temperature - self.zero, 0.0)
        if parts[0].startswith("-"):
            self.deck.boundaries[node] = kelvin
        else:
            self.deck.capacities[node], self.deck.start_K[node] = max(capacity, 0.0), kelvin
        return True

    def _conductor(self, where: str, submodel: str, line: str) -> bool:
        if line.strip().upper() in ("PSTOP", "PSTART"):
            return True
        parts = [p.strip() for p in line.split(",")]
        if len(parts) != 4 or not re.fullmatch(r"-?\d+", parts[0]) or not _is_number(parts[3]):
            return False
        ends = [p if "." in p else f"{submodel}.{p}" for p in parts[1:3]]
        if not all(re.fullmatch(r"-?\w+\.-?\d+", end) for end in ends):
            return False
        self.waiting.append((where, ends[0].upper(), ends[1].upper(), parts[0].startswith("-"), _float(parts[3])))
        return True

    def _join(self, where: str, first: str, second: str, radiates: bool, value: float) -> None:
        """Add a conductor once all nodes of its file are known; the end with a minus sign gives without feeling it."""
        giving = [end for end in (first, second) if "-" in end]
        ends = [end.replace("-", "") for end in (first, second)]
        unseen = [end for end in ends if not self.deck.knows(end)]
        for end in unseen:
            self.unseen.setdefault(end, where)
        if unseen:
            return
        if giving and (radiates or len(giving) == 2):
            self.deck.refused.append(f"{where}: a one-way conductor must be linear, with one end marked")
        elif giving:
            source = giving[0].replace("-", "")
            other = next(end for end in ends if end != source)
            self.deck.one_way[source, other] = self.deck.one_way.get((source, other), 0.0) + value
        elif radiates:
            self.deck.join(self.deck.radiative, ends[0], ends[1], value * self.sigma / STEFAN_BOLTZMANN_W_PER_M2_K4)
        else:
            self.deck.join(self.deck.linear, ends[0], ends[1], value)

    def _heat(self, where: str, submodel: str, line: str) -> bool:
        found = _HEAT.match(line)
        if found is None:
            return False
        node = f"{(found[1] or submodel).upper()}.{found[2]}"
        if not self.deck.knows(node):
            self.unseen.setdefault(node, where)
            return True
        self.deck.heat("loads", node, _float(found[3]))
        return True

    def _control(self, where: str, submodel: str, line: str) -> bool:
        for setting in line.split(","):
            name, _, value = (part.strip() for part in setting.partition("="))
            if name.lower() in ("sigma", "abszro") and not _is_number(value):
                return False
            if name.lower() == "sigma":
                self.sigma = _float(value)
            elif name.lower() == "abszro":
                self.zero = _float(value)
                if self.zero not in (0.0, -ZERO_CELSIUS_K, -273.0):
                    self.deck.refused.append(f"{where}: temperatures are neither K nor degC (abszro {value})")
            elif name.upper() == "UID" and value.upper() != "SI":
                self.deck.refused.append(f"{where}: units are '{value}'; only SI is read")
        return True

    def _array(self, where: str, submodel: str, line: str) -> bool:
        """Pass over the arrays: what a heat-rate file holds besides its averages is times and scale factors."""
        return bool(re.match(rf"^[\s\d=.,]*({_NUMBER}[\s,]*)*$", line)) or line.strip().upper() in ("PSTOP", "PSTART")

    def _rated(self, where: str, submodel: str, line: str) -> bool:
        self.rated += [p.strip() for p in line.split("=", 1)[-1].split(",") if p.strip()]
        return True

    def _apply_rates(self, source: str) -> None:
        """Give the average heat rates to the nodes that a file lists, each submodel before its nodes."""
        nodes, submodel = [], ""
        for item in self.rated:
            if item.isdigit():
                nodes.append(f"{submodel}.{item}")
            else:
                submodel = item.upper()
        if len(nodes) != len(self.rates):
            if nodes or self.rates:
                self.deck.refused.append(f"{source}: {len(self.rates)} average heat rates for {len(nodes)} nodes")
            return
        for node, rate in zip(nodes, self.rates, strict=True):
            if not self.deck.knows(node):
                self.unseen.setdefault(node, source)
            course = self.courses.get(node, [])
            if self.over_time and len(course) == len(self.times) > 1:
                self.deck.driven[f"Q_{node}"] = {node: 1.0}
                self.deck.courses[f"Q_{node}"] = Course(np.array(self.times), np.array(course), self.times[-1])
            else:
                self.deck.heat("orbit_average", node, rate)
        averaged = sum(f"Q_{node}" not in self.deck.courses for node in nodes)
        if averaged and not self.over_time:
            self.deck.notes.append(
                f"{source}: {averaged} heat rates are averages over the orbit; --over-time reads their course"
            )
        elif averaged:
            self.deck.notes.append(f"{source}: {averaged} heat rates have no course over the orbit and are averages")


def _values(raw: str) -> list[float] | None:
    """Return the numbers of a comment that holds nothing else but the number of an array before them; None of any other."""
    number, equals, rest = raw[1:].partition("=")
    if equals and not number.strip().isdigit():
        return None
    tokens = (rest if equals else number).replace(",", " ").split()
    return [_float(t) for t in tokens] if tokens and all(map(_is_number, tokens)) else None


def _is_number(text: str) -> bool:
    return re.fullmatch(_NUMBER, text) is not None


def _float(text: str) -> float:
    return float(re.sub("[Dd]", "e", text))
