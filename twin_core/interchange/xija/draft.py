"""The specification of a Xija model as it grows, component by component."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from twin_core.interchange.imported import Data, name_of, number
from twin_core.interchange.xija.components import Component

FITTED_SPREAD, LEAST_SPREAD_W = 1.1, 0.05
"""How far off a fit of years of telemetry is taken to be, unless the user says so, as a factor; and for a table of zeros."""


class UnknownError(Exception):
    """What a component is or has that cannot be translated."""


@dataclass
class Draft:
    """The specification as it grows: its parts by their names in the file, the notes and the refusals.

    Attributes
    ----------
    source
        File of the model, for messages.
    scale
        Node -> its capacity in kJ/K, by which a rate in K/ks becomes a heat in W.
    measured, constant
        Component or MSID -> column of the telemetry that carries it, or the value that it always has.
    held, spread
        As of ``read_xija``.
    speed
        Node -> by how much its temperature moves faster than its time constants say.
    """

    source: str
    scale: Mapping[str, float]
    measured: Mapping[str, str]
    constant: Mapping[str, float]
    held: bool
    spread: float
    speed: Mapping[str, float]
    boundaries: Data = field(default_factory=dict)
    channels: Data = field(default_factory=dict)
    derived: Data = field(default_factory=dict)
    nodes: list[Data] = field(default_factory=list)
    conductors: list[Data] = field(default_factory=list)
    loads: list[Data] = field(default_factory=list)
    heaters: list[Data] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)

    def at(self, component: Component) -> str:
        """Return where a component stands."""
        return f"{self.source}: line {component.line}: {component.kind} '{component.name}'"

    def key(self, component: Component, *pars: str) -> str:
        """Return whether parameters are known or to be calibrated, as the specification says it."""
        return "guess" if not self.held and component.free & set(pars) else "value"

    def quantity(self, component: Component, value: float, *pars: str) -> Data:
        """Return a number as known, or as a guess where Xija calibrates one of these parameters."""
        key = self.key(component, *pars)
        return {key: number(value)} | ({"spread": self.spread} if key == "guess" else {})

    def channel(self, name: str, *, levels: bool = False, unit: str | None = None) -> str:
        """Return the name of an auxiliary channel, declared once; a constant where the user says so."""
        if name in self.constant:
            self.derived[name_of(name, "_")] = {"formula": repr(float(self.constant[name]))}
            return name_of(name, "_")
        column = self.measured.get(name, name_of(name, "_"))
        entry: Data = {"kind": "auxiliary"} | ({"unit": unit} if unit else {})
        entry |= {"levels": True} if levels else {"interpolation": "hold"}
        self.channels.setdefault(column, entry)
        return column

    def formula(self, name: str, formula: str, *, levels: bool = False, unit: str | None = None) -> str:
        """Return the name of a derived channel, made once for each formula."""
        entry: Data = {"formula": formula} | ({"levels": True} if levels else {}) | ({"unit": unit} if unit else {})
        name = name_of(name, "_")
        while name in self.channels or self.derived.get(name, entry) != entry:
            name += "_"
        self.derived[name] = entry
        return name

    def table(
        self,
        component: Component,
        node: str,
        channel: str,
        knots: Sequence[float],
        values: Sequence[float],
        factor: str | None,
        pars: Sequence[str],
    ) -> None:
        """Add heat in K/ks over a channel."""
        if len(knots) == 1:
            raise UnknownError("has a table of one value")
        known = self.key(component, *pars) == "value"
        scaled = [number(self.scale[node] * v) for v in values]
        key = "values_W" if known else "guess_W"
        table: Data = {"knots": [float(k) for k in knots], key: scaled}
        if not known:
            table["spread_W"] = number(max((self.spread - 1.0) * max(map(abs, scaled)), LEAST_SPREAD_W))
        load: Data = {"channel": channel, "node": name_of(node), "table": table}
        self._add({**load, "factor": factor} if factor is not None else load, component)

    def power(self, component: Component, node: str, amount: float, unit_heat: str, par: str) -> None:
        """Add ``amount`` times a formula, in K/ks."""
        if amount == 0.0:
            if component.free & {par}:
                self.notes.append(f"{self.at(component)}: {par} is 0 and left out")
            return
        sign = "" if amount > 0.0 else "-1.0 * "
        channel = self.formula(f"{component.name}_{par}", f"{sign}({unit_heat})", unit="W")
        gain = self.quantity(component, self.scale[node] * abs(amount), par)
        self._add({"channel": channel, "node": name_of(node), "gain": gain}, component)

    def _add(self, load: Data, component: Component) -> None:
        """Add a load; a second one of the same channel and factor on a node gets a factor of its own name."""
        seen = [(x["channel"], x["node"], x.get("factor")) for x in self.loads]
        if (load["channel"], load["node"], load.get("factor")) in seen:
            load["factor"] = self.formula(f"of_{component.name}", load.get("factor") or "1.0")
        self.loads.append(load)
