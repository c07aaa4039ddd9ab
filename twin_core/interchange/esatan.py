"""ESATAN-TMS decks -> a specification.

Read are ``$LOCALS`` and ``$CONSTANTS`` (numbers and arithmetic over them), ``$ARRAYS`` (numbers, and pairs over time), ``$NODES``
(D, B and X nodes), ``$CONDUCTORS`` (GL, GR, GF, with loops) and, of ``$INITIAL`` and ``$VARIABLES1``, assignments of heats and
locals under plain conditions, interpolation over time included.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from twin_core._typing import FloatArray
from twin_core.constants import STEFAN_BOLTZMANN_W_PER_M2_K4, ZERO_CELSIUS_K
from twin_core.errors import SpecError
from twin_core.interchange.imported import Course, Imported, name_of, twin_id
from twin_core.interchange.network import Deck, kelvin, specified
from twin_core.network.formula import channels_of, evaluate
from twin_core.wording import counted

_SECTION = re.compile(r"^\s*\$(\w+)\s*(.*)$")
_NODE = re.compile(r"^([DBX])\s*(\d+)\s*=\s*'([^']*)'\s*(?:,(.*))?$", re.IGNORECASE | re.DOTALL)
_CONDUCTOR = re.compile(r"^(G[A-Z])\s*\(\s*([^,()]+?)\s*,\s*([^,()]+?)\s*\)\s*=\s*(.+)$", re.IGNORECASE | re.DOTALL)
_ASSIGNMENT = re.compile(r"^([A-Za-z]\w*?)\s*(?::?\s*(\d+))?\s*=\s*(.+)$", re.DOTALL)
_LOOP = re.compile(r"^FOR\s+(\w+)\s*=\s*(.+?)\s+TO\s+(.+?)\s+DO$", re.IGNORECASE)
_ARRAY = re.compile(r"^(\w+)\s*\(\s*(\d+)\s*(?:,\s*(\d+)\s*)?\)\s*=\s*(.+)$", re.DOTALL)
_INTERPOLATION = re.compile(
    r"\b(INTRP1|INTCYC)\s*\(\s*TIMEM\s*,\s*(\w+)\s*,\s*1\s*(?:,\s*([^,()]+?)\s*,\s*([^,()]+?)\s*)?\)", re.IGNORECASE
)
"""Linear interpolation of an array of pairs over the time of the mean step, once or in cycles."""
_HEATS = ("QI", "QS", "QE", "QA", "QR")
_SURFACES = ("A", "ALP", "EPS")
_PLACES = ("FX", "FY", "FZ")
_SILENT = ("EXECUTION", "OUTPUTS", "MODEL", "ENDMODEL")
_RELATIONS = {
    ".LT.": "<",
    ".LE.": "<=",
    ".GT.": ">",
    ".GE.": ">=",
    ".EQ.": "==",
    ".NE.": "!=",
    ".AND.": " and ",
    ".OR.": " or ",
}
MOST_TURNS = 100_000


class _UnknownError(Exception):
    """What a statement holds that cannot be read."""


@dataclass
class _Reader:
    """One deck, statement by statement."""

    source: str
    deck: Deck
    values: dict[str, float] = field(default_factory=dict)
    inactive: set[str] = field(default_factory=set)
    inactive_couplings: int = 0
    arrays: dict[str, FloatArray] = field(default_factory=dict)
    driven: dict[tuple[str, str], tuple[str, float]] = field(default_factory=dict)
    views: dict[tuple[str, str], float] = field(default_factory=dict)
    views_line: int = 0
    uses_views: bool = False

    def refuse(self, line: int, what: str) -> None:
        self.deck.refused.append(f"{self.source}: line {line}: {what}")

    def number(self, text: str) -> float:
        """Return the value of an expression over what is known."""
        found = re.sub(r"(?<=[\d.])[dD](?=[-+]?\d)", "e", " ".join(text.split()))
        for relation, sign in _RELATIONS.items():
            found = re.sub(re.escape(relation), sign, found, flags=re.IGNORECASE)
        found = re.sub(r"\b([A-Za-z]\w*)\s*\(\s*(\d+)\s*\)", self._element, found)
        found = re.sub(r"\b([A-Za-z]+)\s*:\s*(\d+)", r"\1_of_\2", found)
        found = re.sub(r"[A-Za-z_]\w*", lambda m: m[0] if re.match(r"^[eE]\d*$", m[0]) else m[0].lower(), found)
        try:
            unknown = [name for name in channels_of(found) if name not in self.values]
            if unknown:
                raise _UnknownError(f"'{unknown[0]}' is not known")
            value = float(evaluate(found, {n: np.array(v) for n, v in self.values.items()}, np.zeros(())))
        except ValueError as error:
            raise _UnknownError(f"'{text.strip()[:60]}' {error}") from error
        if not np.isfinite(value):
            raise _UnknownError(f"'{text.strip()[:60]}' is not finite")
        return value

    def _element(self, match: re.Match[str]) -> str:
        """Return an element of an array as a number; what is no array stays as it is."""
        array = self.arrays.get(match[1].lower())
        if array is None or array.ndim != 1:
            return match[0]
        if not 1 <= int(match[2]) <= array.size:
            raise _UnknownError(f"'{match[0]}' is beyond the {array.size} elements of the array")
        return repr(float(array[int(match[2]) - 1]))

    def declare_array(self, statement: str) -> None:
        """Read ``NAME(n) = ...`` or ``NAME(2, n) = x, y, x, y, ...``; the first index runs first."""
        match = _ARRAY.match(statement)
        if match is None:
            raise _UnknownError(f"'{statement[:60]}' is no array of one or two dimensions")
        values = np.array([self.number(part) for part in _parts(match[4])])
        shape = [int(size) for size in (match[2], match[3]) if size is not None]
        if values.size != int(np.prod(shape)):
            raise _UnknownError(f"array {match[1]} has {values.size} values for {' x '.join(map(str, shape))}")
        self.arrays[match[1].lower()] = values if len(shape) == 1 else values.reshape(shape[::-1]).T

    def over_time(self, text: str) -> tuple[str, Course, float] | None:
        """Return channel, course and factor of a heat that an array tells over time; None where it does not."""
        match = _INTERPOLATION.search(text)
        if match is None:
            return None
        name = match[2].lower()
        array = self.arrays.get(name)
        if array is None or array.ndim != 2 or array.shape[0] != 2 or array.shape[1] < 2:
            raise _UnknownError(f"'{match[0][:60]}': {match[2]} is no array of pairs (2, n)")
        if (np.diff(array[0]) <= 0.0).any():
            raise _UnknownError(f"'{match[0][:60]}': the times of {match[2]} do not increase")
        factor = self.number(text.replace(match[0], "1.0"))
        rest = self.number(text.replace(match[0], "0.0"))
        double = self.number(text.replace(match[0], "2.0"))
        if rest != 0.0 or abs(double - 2.0 * factor) > 1e-12 * abs(factor) or factor <= 0.0:
            raise _UnknownError(f"'{text[:60]}' is no positive multiple of what the array tells")
        period = None
        if match[1].upper() == "INTCYC":
            if match[3] is None:
                raise _UnknownError(f"'{match[0][:60]}' names no period")
            period = self.number(match[3])
            if self.number(match[4] or "0") != 0.0:
                raise _UnknownError(f"'{match[0][:60]}': a cycle that begins elsewhere than at 0 is not read")
        return match[2], Course(array[0], array[1], period), factor

    def node(self, text: str) -> str | None:
        """Return the name of a node by its number, which may be an expression; None where it is inactive."""
        value = self.number(text)
        name = f"n{value:.0f}"
        if name in self.inactive:
            return None
        if not self.deck.knows(name):
            raise _UnknownError(f"node {value:.0f} is declared nowhere")
        return name

    def define(self, statement: str) -> None:
        """Read ``name = expression`` of a local or constant."""
        name, _, text = statement.partition("=")
        if not re.fullmatch(r"\s*\w+\s*", name) or not text:
            raise _UnknownError(f"'{statement[:60]}' is no definition")
        key, value = name.strip().lower(), self.number(text)
        if key == "tabs" and abs(value - ZERO_CELSIUS_K) > 0.2:
            raise _UnknownError(f"TABS is {value:g}: only temperatures in degC are read")
        self.values[key] = value

    def declare_node(self, statement: str) -> None:
        """Read a node with what it has."""
        match = _NODE.match(statement)
        if match is None:
            raise _UnknownError(f"'{statement[:60]}' is no node")
        kind, number, label = match[1].upper(), match[2], match[3]
        name = f"n{int(number)}"
        if self.deck.knows(name) or name in self.inactive:
            raise _UnknownError(f"node {number} is declared twice")
        told: dict[str, float] = {}
        for part in _parts(match[4] or ""):
            key, _, text = part.partition("=")
            key = key.strip().upper()
            if key not in ("T", "C", *_HEATS, *_SURFACES, *_PLACES):
                raise _UnknownError(f"node {number} has '{key}', which is not read")
            told[key] = self.number(text)
        self.deck.labels[name] = label
        for key in _SURFACES:
            if key in told:
                self.values[f"{key.lower()}_of_{int(number)}"] = told[key]
        start_K = kelvin(told.get("T", 0.0))
        if kind == "X":
            self.inactive.add(name)
        elif kind == "B":
            self.deck.boundaries[name] = start_K
        else:
            self.deck.capacities[name], self.deck.start_K[name] = told.get("C", 0.0), start_K
        for key in _HEATS:
            if told.get(key):
                self.deck.heat(key, name, told[key])

    def declare_conductor(self, statement: str) -> None:
        """Read a conductor."""
        match = _CONDUCTOR.match(statement)
        if match is None or match[1].upper() not in ("GL", "GR", "GF", "GV"):
            raise _UnknownError(f"'{statement[:60]}' is no GL, GR, GF or GV")
        first, second, value = self.node(match[2]), self.node(match[3]), self.number(match[4])
        if first is None or second is None:
            self.inactive_couplings += 1
            return
        kind = match[1].upper()
        if value < 0.0:
            raise _UnknownError(f"'{statement[:60]}' is negative")
        if kind == "GV":
            self.views[first, second] = value
        elif kind == "GF":
            self.deck.one_way[first, second] = self.deck.one_way.get((first, second), 0.0) + value
        else:
            self.deck.join(self.deck.linear if kind == "GL" else self.deck.radiative, first, second, value)

    def assign(self, statement: str) -> None:
        """Read ``QI200 = ...`` or a local's new value."""
        match = _ASSIGNMENT.match(statement)
        if match is None:
            raise _UnknownError(f"'{statement[:60]}' is not understood")
        key, number, text = match[1].upper(), match[2], match[3]
        text = re.sub(r"\b(Q[A-Z])(\d+)\b", r"\1:\2", text)
        if number is None:
            self.values[key.lower()] = self.number(text)
            return
        if key not in _HEATS:
            raise _UnknownError(f"'{statement[:60]}' changes what is not a heat")
        name = self.node(number)
        if (told := self.over_time(text)) is not None:
            channel, course, factor = told
            self.deck.heats_W.get(key, {}).pop(name or "", None)
            if name is not None:
                self.deck.courses[channel] = course
                self.driven[key, name] = channel, factor
            return
        self.driven.pop((key, name or ""), None)
        value = self.number(text)
        self.values[f"{key.lower()}_of_{int(number)}"] = value
        if name is not None:
            self.deck.heats_W.setdefault(key, {})[name] = value  # an assignment replaces what was there


def read_esatan(text: str, source: str, *, channels: Mapping[str, str] | None = None, held: bool = False) -> Imported:
    """Return an ESATAN-TMS deck as a specification; node 12 becomes ``n12``.

    Parameters
    ----------
    text
        The deck.
    source
        Its file, for messages.
    channels
        Node (``n12``) -> column of the telemetry that reads it.
    held
        Take couplings as known; by default they are guesses.

    Raises
    ------
    SpecError
        If it is no deck.
    """
    model = re.search(r"^\s*\$MODEL\s+(\w+)", text, re.MULTILINE | re.IGNORECASE)
    if model is None:
        raise SpecError(f"{source}: has no $MODEL; an ESATAN-TMS deck begins with it")
    reader = _Reader(source, Deck(twin_id(model[1])))
    silent: set[str] = set()
    sections = list(_sections(text))
    order = ("LOCALS", "CONSTANTS", "ARRAYS", "NODES", "CONDUCTORS")
    for title, first, lines in sorted(sections, key=lambda s: order.index(s[0]) if s[0] in order else len(order)):
        if title in _SILENT:
            if any(line.strip() for line in lines):
                silent.add(f"${title}")
            continue
        if title in order:
            handle = {
                "LOCALS": reader.define,
                "CONSTANTS": reader.define,
                "ARRAYS": reader.declare_array,
                "NODES": reader.declare_node,
                "CONDUCTORS": reader.declare_conductor,
            }[title]
            for line, statement in _unrolled(reader, _statements(first, lines)):
                try:
                    handle(statement)
                except _UnknownError as error:
                    reader.refuse(line, str(error))
        elif title in ("INITIAL", "VARIABLES1"):
            _logic(reader, title, first, lines)
        else:
            for n, text_line in enumerate(lines, start=first):
                if text_line.strip():
                    reader.refuse(n, f"'{text_line.strip()[:60]}' in ${title} is not read")
    deck = reader.deck
    for (_, name), (channel, factor) in reader.driven.items():
        own = deck.driven.setdefault(channel, {})
        own[name] = own.get(name, 0.0) + factor
    if reader.views and reader.uses_views:
        _exchange(reader)
    elif reader.views:
        deck.refused.append(f"{source}: {len(reader.views)} GV are used by no CALL VFAC")
    if "stefan" in reader.values:
        share = reader.values["stefan"] / STEFAN_BOLTZMANN_W_PER_M2_K4
        deck.radiative = {pair: share * value for pair, value in deck.radiative.items()}
    if not re.search(r"^\s*\$ENDMODEL\b", text, re.MULTILINE | re.IGNORECASE):
        reader.refuse(len(text.splitlines()), "the deck ends without $ENDMODEL: a part of it is missing")
    if silent:
        deck.notes.append(f"{source}: {', '.join(sorted(silent))} say how to solve and print, and are not read")
    if reader.inactive:
        couplings = counted(reader.inactive_couplings, "coupling")
        deck.notes.append(
            f"{source}: left out: {counted(len(reader.inactive), 'inactive node')}, and {couplings} to inactive nodes"
        )
    return specified(deck, {name_of(n): c for n, c in (channels or {}).items()}, held=held, source=source)


def _exchange(reader: _Reader) -> None:
    """Turn view factors (GV) into radiative couplings by Gebhart's factors, as CALL VFAC does.

    B_ij = F_ij e_j + sum_k F_ik (1 - e_k) B_kj, R_ij = e_i A_i B_ij (Gebhart 1961), diffuse and grey.
    """
    nodes = sorted({node for pair in reader.views for node in pair})
    surfaces = []
    for node in nodes:
        told = [reader.values.get(f"{key}_of_{node[1:]}") for key in ("a", "eps")]
        if None in told or told[0] == 0.0:
            reader.deck.refused.append(
                f"{reader.source}: node {node[1:]} has a GV but no area (A) and emissivity (EPS)"
            )
            return
        surfaces.append(told)
    area, emissivity = np.array(surfaces, dtype=np.float64).T
    view = np.zeros((len(nodes), len(nodes)))
    for (a, b), factor in reader.views.items():
        i, j = nodes.index(a), nodes.index(b)
        view[i, j], view[j, i] = factor, factor * area[i] / area[j]
    gebhart = np.linalg.solve(np.eye(len(nodes)) - view * (1.0 - emissivity), view * emissivity)
    exchange = emissivity[:, None] * area[:, None] * gebhart
    for i, a in enumerate(nodes):
        for j in range(i + 1, len(nodes)):
            row, column = (i, j) if area[i] <= area[j] else (j, i)  # the smaller one's is not lost in rounding
            if exchange[row, column] > 0.0 and not {a, nodes[j]} <= set(reader.deck.boundaries):
                reader.deck.join(reader.deck.radiative, a, nodes[j], float(exchange[row, column]))
    reader.deck.notes.append(f"{reader.source}: CALL VFAC: {len(reader.views)} GV became radiative couplings (Gebhart)")


def _sections(text: str) -> Iterator[tuple[str, int, list[str]]]:
    """Yield the title of each section, the line of its first one and its lines without comments."""
    title, first, lines = "", 1, list[str]()
    for n, raw in enumerate(text.splitlines(), start=1):
        code = title in ("INITIAL", "VARIABLES1", "VARIABLES2", "EXECUTION", "OUTPUTS", "SUBROUTINES")
        line = "" if code and raw[:1] in ("C", "c") and not raw[1:2].isalnum() else raw.split("#", 1)[0]
        match = _SECTION.match(line)
        if match is not None and match[1].upper() not in ("REAL", "INTEGER", "CHARACTER", "CONTROL"):
            if title:
                yield title, first, lines
            title, first, lines = match[1].upper(), n + 1, []
        else:
            lines.append("" if match is not None else line)
    yield title, first, lines


def _statements(first: int, lines: list[str]) -> Iterator[tuple[int, str]]:
    """Yield the line and text of each statement, which ends with a semicolon; the head of a loop ends with DO."""
    begun, text = 0, ""
    for n, line in enumerate(lines, start=first):
        for piece in re.split(r"(;)", line):
            if piece == ";":
                if text.strip():
                    yield begun, " ".join(text.split())
                text = ""
            else:
                begun = begun if text.strip() else n
                text += f" {piece}"
        stripped = " ".join(text.split())
        if _LOOP.match(stripped) or re.fullmatch(r"END\s*DO", stripped, re.IGNORECASE):
            yield begun, stripped
            text = ""
    if text.strip():
        yield begun, " ".join(text.split())


def _unrolled(reader: _Reader, statements: Iterator[tuple[int, str]]) -> Iterator[tuple[int, str]]:
    """Yield the statements, those of a loop once for each turn with its counter as a local."""
    for line, statement in statements:
        match = _LOOP.match(statement)
        if match is None:
            yield line, statement
            continue
        body, depth = [], 1
        for inner in statements:
            depth += 1 if _LOOP.match(inner[1]) else -1 if re.fullmatch(r"END\s*DO", inner[1], re.IGNORECASE) else 0
            if depth == 0:
                break
            body.append(inner)
        try:
            low, high = (round(reader.number(match[k])) for k in (2, 3))
        except _UnknownError as error:
            reader.refuse(line, str(error))
            continue
        if high - low > MOST_TURNS:
            reader.refuse(line, f"a loop of {high - low} turns is longer than {MOST_TURNS}")
            continue
        for turn in range(low, high + 1):
            reader.values[match[1].lower()] = float(turn)
            yield from _unrolled(reader, iter(body))


def _parts(text: str) -> list[str]:
    """Return what commas outside of brackets separate."""
    parts, depth, part = [], 0, ""
    for letter in text:
        depth += (letter == "(") - (letter == ")")
        if letter == "," and depth == 0:
            parts.append(part)
            part = ""
        else:
            part += letter
    return [p.strip() for p in (*parts, part) if p.strip()]


def _logic(reader: _Reader, title: str, first: int, lines: list[str]) -> None:
    """Read assignments under IF, ELSE IF, ELSE and END IF; anything else is refused by its line."""
    taken: list[list[bool]] = []  # of each open IF: is its present branch taken, was any before
    for n, raw in enumerate(lines, start=first):
        line = raw.strip().rstrip(";")
        if not line:
            continue
        active = all(branch[0] for branch in taken)
        try:
            if match := re.match(r"^(ELSE\s*)?IF\s*\((.+)\)\s*THEN$", line, re.IGNORECASE):
                if match[1]:
                    before = taken.pop()
                    outer = all(branch[0] for branch in taken)
                    now = outer and not before[1] and bool(reader.number(match[2]))
                    taken.append([now, before[1] or now])
                else:
                    now = active and bool(reader.number(match[2]))
                    taken.append([now, now])
            elif re.match(r"^ELSE$", line, re.IGNORECASE):
                taken[-1][0] = not taken[-1][1]
            elif re.match(r"^END\s*IF$", line, re.IGNORECASE):
                taken.pop()
            elif re.match(r"^CALL\s+VFAC\b", line, re.IGNORECASE):
                reader.uses_views = True
            elif active:
                reader.assign(line)
        except _UnknownError as error:
            under = re.match(r"^(ELSE\s*)?IF\s*\(.+\)\s*THEN$", line, re.IGNORECASE)
            if under:
                taken.append([False, True])
            reader.refuse(n, f"${title}: {error}{'; what stands under this condition is not read' if under else ''}")
        except IndexError:
            reader.refuse(n, f"${title}: '{line[:60]}' without an IF")
