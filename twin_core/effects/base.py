"""What an effect is: a named term that a declared network may lack, with its parameters, places and starting points.

Adding one is one file with a subclass, and one line: in the registry of ``twin_core.effects``, or an entry point of a package
of your own (``twin_core.effects.plugins``). Nothing else knows its name.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, ClassVar, Self

import numpy as np

from twin_core._typing import BoolArray, FloatArray, Json
from twin_core.errors import ModelError, SpecError
from twin_core.network.model import Addition, ExtraNode, Layout, declared_terms
from twin_core.network.terms import Along, CapacityTerm, ReadingTerm, Term
from twin_core.parameters.parameter import Parameter
from twin_core.parameters.transforms import Bounded, Identity, Log, Shifted, Transform
from twin_core.units import format_instant

Where = dict[str, Any]
Place = tuple[str, frozenset[tuple[str, Any]]]
"""Name and place of an effect as a key."""

LEAST_SHARE = 0.1
"""A positive parameter that a linear response would push below this share of its null value starts there instead."""


@dataclass(frozen=True)
class ParameterSpec:
    """One parameter of an effect.

    Attributes
    ----------
    name, unit
        As the report writes them.
    null
        The value at which the effect vanishes; None for a parameter that shapes it without scaling it.
    positive
        Whether the value must stay positive.
    prior_std
        Weak prior around the starting value, in ln for positive ones, in scales for instants; None = flat.
    lower
        The least value, itself possible; None where there is none or the value is positive anyway.
    step_limit
        How far one step of a solver may take a value of either sign: its slope is told by single events; None where any.
    resolution
        Standard deviation of what no fit to this telemetry can tell: it adds to that of the fit.
    instant
        For an instant on the clock of ``Record.clock_s``: where the solver counts from, and in what; None for others.
    open_ended
        Whether the data may tell no more than that it is large: a limit that was never reached.
    upper
        The greatest value, itself possible; None where there is none.
    breaks_down
        Whether the law comes to nothing at a bound, within what the record visits: a value that is not told from it is none.
    """

    name: str
    unit: str
    null: float | None = None
    positive: bool = False
    prior_std: float | None = None
    lower: float | None = None
    instant: Shifted | None = None
    step_limit: float | None = None
    resolution: float = 0.0
    open_ended: bool = False
    upper: float | None = None
    breaks_down: bool = False

    @property
    def transform(self) -> Transform:
        """How a solver moves it."""
        if self.positive:
            return Log(np.inf if self.upper is None else self.upper)
        if self.step_limit is not None:
            return Shifted(0.0, self.step_limit)
        if self.lower is None and self.upper is None:
            return self.instant or Identity()
        return Bounded(-np.inf if self.lower is None else self.lower, np.inf if self.upper is None else self.upper)

    def spread(self, fitted: float) -> float:
        """Return the standard deviation, given that of a fit; one as wide as its prior says that the fit tells nothing."""
        if (
            self.instant is not None
            and self.resolution > 0.0
            and fitted > 0.5 * self.instant.scale * (self.prior_std or np.inf)
        ):
            return self.resolution
        return float(np.hypot(fitted, self.resolution))

    def told_from_below(self, mean: float, std: float) -> bool:
        """Return whether the data leave open how large it is: its deviation is no less than that of its prior, relative to it."""
        return self.open_ended and self.prior_std is not None and std >= 0.99 * self.prior_std * abs(mean)

    def moved(self, amount: float) -> float | None:
        """Return the value at a distance from null, None if it is not positive but must be.

        Beyond a bound, or a small share of a positive null, it is put there: the distance is reckoned from a
        declared size that the missing effect has spoilt, so that what nearly vanishes may look like less than nothing.
        """
        assert self.null is not None
        value = self.null + amount
        if self.positive:
            value = max(value, LEAST_SHARE * self.null)
            return value if value > 1e-12 else None
        return self.transform.to_value(value) if self.lower is not None or self.upper is not None else value


@dataclass(frozen=True)
class Survey:
    """The training record as a candidate sees it: the declared model's own trajectory and inputs.

    Attributes
    ----------
    layout
        Names and positions.
    along
        Stage points of all segments one after the other.
    rate_K_per_s : (n_points, n_nodes)
        Rates of the declared model there.
    capacity_J_per_K : (n_nodes,)
        Calibrated capacities.
    channel_levels
        Auxiliary channel -> resting values, for those declared with levels.
    segment_edges
        Positions in the points where segments begin, and the end.
    parameters
        Full name -> calibrated value of every parameter of the declared model.
    sample_s : (n_samples,)
        When something was read, on the clock of ``along``.
    dated
        Whether that clock shows dates or a file's own seconds.
    residual_K : (n_points, n_sensors)
        Measured minus modelled, interpolated where nothing was read.
    terms
        Everything that exchanges heat in the model so far; what is declared where not given.
    """

    layout: Layout
    along: Along
    rate_K_per_s: FloatArray
    capacity_J_per_K: FloatArray
    channel_levels: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    segment_edges: tuple[int, ...] = ()
    parameters: Mapping[str, float] = field(default_factory=dict)
    sample_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    dated: bool = False
    residual_K: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    terms: tuple[Term, ...] = ()

    def through_boundary(self, name: str) -> list[tuple[int, FloatArray]]:
        """Return the heat into the nodes per kelvin of a boundary: (node, (n_points,) in W/K) for all that reads it."""
        boundary, through = self.layout.boundary(name), []
        for term in self.terms or declared_terms(self.layout):
            named = [p.name for p in term.parameters] + list(term.borrows)
            values = np.array([self.parameters.get(n, np.nan) for n in named])
            through += [e for e in term.evaluate(self.along, values).d_boundaries if e.item == boundary]
        return [(entry.node, entry.series) for entry in through]

    def declared_boundary_K(self, name: str) -> FloatArray:
        """Return a boundary's temperature as it is declared, before effects change it, (n_points,)."""
        return self.along.declared_K[:, self.layout.boundary(name)]

    def temperature_K(self, node: str) -> FloatArray:
        """Return a node's temperature along the record, (n_points,)."""
        return self.along.temperatures_K[:, self.layout.node(node)]

    @property
    def begin_s(self) -> float:
        """The first sample, on the clock of ``along``."""
        return float(self.sample_s.min())

    @property
    def one_clock(self) -> bool:
        """Whether an instant means one moment: files in their own seconds may all begin at zero."""
        spans = sorted((self.along.time_s[s][0], self.along.time_s[s][-1]) for s in self.segments())
        return all(before[1] <= after[0] for before, after in pairwise(spans))

    def segments(self) -> Iterable[slice]:
        """Yield the points of each segment."""
        yield from (slice(a, b) for a, b in pairwise(self.segment_edges))


@dataclass(frozen=True)
class Beyond:
    """Points at which an effect is used outside what it was learned from.

    Attributes
    ----------
    node
        Position of the node that receives its heat.
    outside : (n_points,)
    std_W : (n_points,)
        Standard deviation that its heat has for this alone; zero inside.
    visited
        What it was learned from, in words: ``px 280.00 to 295.00 K``.
    """

    node: int
    outside: BoolArray
    std_W: FloatArray
    visited: str


@dataclass(frozen=True)
class Effect(ABC):
    """A missing-physics term at a place, with values.

    Attributes
    ----------
    where
        Contract keys: node, nodes (a pair), sink, boundary, channel, sensor.
    values
        Parameter name -> value; tables are numbered, ``values_W[0]``.
    settings
        What is not calibrated: knots, a degree, a reference.
    """

    where: Where
    values: Mapping[str, float]
    settings: Mapping[str, Any] = field(default_factory=dict)

    name: ClassVar[str]
    keys: ClassVar[tuple[str, ...]]
    optional_keys: ClassVar[tuple[str, ...]] = ()
    """Keys of ``where`` that may follow."""
    equation: ClassVar[str]
    reference: ClassVar[str]
    sentence: ClassVar[str]
    """What a report says of it: ``{node}``, ``{sink}``, ``{first}`` and ``{second}`` of a pair, ... stand for its place."""
    reported_settings: ClassVar[tuple[str, ...]] = ()
    """Settings that the report lists beside the parameters where the effect has them, such as knots."""
    plugin: ClassVar[str] = ""
    """The file or the package that it comes from, where it is none of the effects that are always there."""
    driven_by: ClassVar[str] = ""
    """What its heat is a function of where that is no single temperature: ``difference`` of the temperatures of its two ends, or
    ``radiation``, the difference of what black bodies at these temperatures emit."""
    fallback: ClassVar[bool] = False
    """True for an effect that is tried only where no named one is supported."""
    adds_mass: ClassVar[bool] = False
    """True for an effect that gives its place a mass to exchange heat with."""

    @abstractmethod
    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the parameters, in order."""

    @abstractmethod
    def addition(self, layout: Layout) -> Addition:
        """Return the terms over a layout; ModelError if a name of ``where`` does not exist."""

    @classmethod
    @abstractmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every place of a network where the effect could act and the declared model does not have it."""

    @classmethod
    @abstractmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the effect at its null amplitude for a grid of its nonlinear settings."""

    def refined(self, survey: Survey) -> Iterable[Self]:
        """Yield starts between this one and its neighbours, where ``starts`` is too coarse for a local search; or none."""
        return ()

    def completed(self, survey: Survey) -> Iterable[Self]:
        """Yield the effect with what it may also have and its simplest form lacks, such as an end; most have no more."""
        return ()

    def simplified(self, survey: Survey) -> Iterable[Self]:
        """Yield the fitted effect with an amplitude held that readings may not speak for; most can spare none."""
        return ()

    def centred(self, survey: Survey) -> Self:
        """Return the fitted effect with what the record leaves open put in the middle; most leave nothing open."""
        return self

    def extra_nodes(self, layout: Layout) -> tuple[ExtraNode, ...]:
        """Return the states that the effect adds; none for most."""
        return ()

    def learned(self, covariance: FloatArray) -> Self:
        """Return the effect with the covariance of its free parameters in the solver's coordinate, where it carries it."""
        return self

    def beyond(self, layout: Layout, along: Along) -> Beyond | None:
        """Return where the effect is used outside what it was learned from; None where it is not, or is a law."""
        return None

    @property
    def label(self) -> str:
        """Name and place, unique in a model: ``radiation_to_sink(px,space)``."""
        places = [p for v in self.where.values() for p in ((v,) if isinstance(v, str) else v)]
        return f"{self.name}({','.join(places)})"

    @classmethod
    def told(cls, where: Mapping[str, Any]) -> str:
        """Return the effect at a place as a sentence without capital and full stop: ``a conductor between a and b was missing``.

        Raises
        ------
        KeyError
            If ``where`` lacks a key that the sentence names.
        """
        names = {key: value for key, value in where.items() if isinstance(value, str)}
        if "nodes" in where:
            names["first"], names["second"] = where["nodes"]
        return cls.sentence.format(**names)

    @property
    def place(self) -> Place:
        """Name and place as a key; a pair of nodes has no order."""
        items = ((k, v if isinstance(v, str) else frozenset(v)) for k, v in self.where.items())
        return self.name, frozenset(items)

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the effect's parameters under their full names."""
        return tuple(
            Parameter(
                f"{self.label}.{q.name}",
                q.unit,
                float(self.values[q.name]),
                q.transform,
                q.prior_std,
                frozen=q.name in self.held,
            )
            for q in self.parameter_specs()
        )

    @property
    def held(self) -> tuple[str, ...]:
        """Names of the values that are held, and no unknowns of a fit."""
        return tuple(self.settings.get("held", ()))

    @property
    def n_free(self) -> int:
        """How many values a fit may move."""
        return len(self.parameter_specs()) - len(self.held)

    def holding(self, name: str) -> Self:
        """Return the effect with one more value held where it is."""
        return replace(self, settings={**self.settings, "held": (*self.held, name)})

    def presented(self, spec: ParameterSpec) -> float | str:
        """Return a value as people read it: an instant in the telemetry's own form, to the millisecond where dated."""
        value = float(self.values[spec.name])
        is_date = spec.instant is not None and self.settings["dated"]
        return format_instant(round(1e3 * value) * 1_000_000) if is_date else value

    @property
    def amplitudes(self) -> tuple[int, ...]:
        """Positions of the parameters that scale the effect (those with a null value) and are not held."""
        return tuple(i for i, q in enumerate(self.parameter_specs()) if q.null is not None and q.name not in self.held)

    @property
    def linear_up_to(self) -> float:
        """The distance of an amplitude from null up to which the response to it is that of :meth:`unit_heats`; mostly any."""
        return np.inf

    def with_values(self, values: Mapping[str, float]) -> Self:
        """Return the effect with some of its values replaced (short names)."""
        return replace(self, values={**self.values, **values})

    def shortened(self, share: float) -> Self:
        """Return the effect with a share of its amplitudes: each that far from the value at which it vanishes."""
        nulls = {q.name: q.null for q in self.parameter_specs() if q.null is not None}
        return self.with_values({name: null + share * (self.values[name] - null) for name, null in nulls.items()})

    def at_parameters(self, named: Mapping[str, float]) -> Self:
        """Return the effect with the values that a model gives to its full parameter names."""
        prefix = f"{self.label}."
        return self.with_values({k.removeprefix(prefix): v for k, v in named.items() if k.startswith(prefix)})

    def with_amplitudes(self, amounts: FloatArray) -> Self | None:
        """Return the effect with its amplitudes moved from null by ``amounts``; None if that is not physical."""
        parameter_specs = self.parameter_specs()
        moved = {}
        for i, amount in zip(self.amplitudes, amounts, strict=True):
            value = parameter_specs[i].moved(float(amount))
            if value is None:
                return None
            moved[parameter_specs[i].name] = value
        return self.with_values(moved)

    def unit_heats(self, survey: Survey) -> list[list[tuple[int, FloatArray]]]:
        """Return d heat / d amplitude along the survey: per amplitude a list of (node, (n_points,) in W per unit).

        Extra capacity counts as the heat that it swallows at the rates of the survey.
        """
        columns: list[list[tuple[int, FloatArray]]] = [[] for _ in self.amplitudes]
        alone = self._alone(survey.layout)
        for term in alone.terms:
            scaled = self._scaled_by(term.parameters)
            for entry in term.evaluate(survey.along, self._null_values(term, survey)).d_values:
                if entry.item in scaled:
                    columns[scaled[entry.item]].append((entry.node, entry.series))
        for capacity in alone.capacities:
            temperature_K = survey.along.temperatures_K[:, capacity.node]
            scaled = self._scaled_by(capacity.parameters)
            for entry in capacity.evaluate(temperature_K, self._null_values(capacity, survey)).d_values:
                if entry.item in scaled:
                    swallowed = -entry.series * survey.rate_K_per_s[:, entry.node]
                    columns[scaled[entry.item]].append((entry.node, swallowed))
        return columns

    def unit_readings(self, survey: Survey) -> list[list[tuple[int, FloatArray]]]:
        """Return d reading / d amplitude along the survey: per amplitude a list of (sensor, (n_points,) in K per unit)."""
        columns: list[list[tuple[int, FloatArray]]] = [[] for _ in self.amplitudes]
        for term in self._alone(survey.layout).readings:
            scaled = self._scaled_by(term.parameters)
            reading = term.evaluate(survey.along.time_s, self._null_values(term, survey))
            for item, series in reading.d_values:
                if item in scaled:
                    columns[scaled[item]].append((reading.sensor, series))
        return columns

    def _alone(self, layout: Layout) -> Addition:
        """Return the terms over a layout that has only its own states added."""
        return self.addition(replace(layout, nodes=layout.nodes + tuple(n.name for n in self.extra_nodes(layout))))

    def _scaled_by(self, own: Sequence[Parameter]) -> dict[int, int]:
        """Return position among a term's own parameters -> which amplitude it is."""
        names = [f"{self.label}.{self.parameter_specs()[i].name}" for i in self.amplitudes]
        return {i: names.index(p.name) for i, p in enumerate(own) if p.name in names}

    def _null_values(self, term: Term | CapacityTerm | ReadingTerm, survey: Survey) -> FloatArray:
        """Return a term's values where the effect vanishes, then those that it borrows from the declared model."""
        null = {
            f"{self.label}.{q.name}": self.values[q.name] if q.null is None else q.null for q in self.parameter_specs()
        }
        return np.array([null[p.name] for p in term.parameters] + [survey.parameters[name] for name in term.borrows])


def require(where: Where, kind: type[Effect]) -> None:
    """Raise ModelError unless ``where`` has the keys of an effect, with names as values and a pair under ``nodes``."""
    effect, known = kind.name, (*kind.keys, *kind.optional_keys)
    for key in kind.keys:
        if key not in where:
            raise ModelError(f"effect {effect}: where.{key} is missing")
    for key, value in where.items():
        if key not in known:
            raise ModelError(f"effect {effect}: where.{key} is not one of {', '.join(known)}")
        pair = isinstance(value, list | tuple) and len(value) == 2 and all(isinstance(v, str) for v in value)
        if (key == "nodes" and not pair) or (key != "nodes" and not isinstance(value, str)):
            raise ModelError(
                f"effect {effect}: where.{key} must be {'a pair of nodes' if key == 'nodes' else 'a name'}"
            )


def touched_nodes(effect: Effect, layout: Layout) -> list[str]:
    """Return the declared nodes at which an effect acts: that a channel feeds, that a sensor reads, that face a boundary."""
    if "node" in effect.where:
        return [effect.where["node"]]
    if "nodes" in effect.where:
        return [n for n in effect.where["nodes"] if n in layout.declared_nodes]
    if "channel" in effect.where:
        return [load.node for load in layout.loads_of(effect.where["channel"])]
    if "boundary" in effect.where:
        return [node for node, boundary in layout.surfaces if boundary == effect.where["boundary"]]
    return [layout.sensor_node(effect.where["sensor"])]


def to_json(effect: Effect) -> Json:
    """Return an effect as plain data."""
    where = {k: v if isinstance(v, str) else list(v) for k, v in effect.where.items()}
    settings = {k: list(v) if isinstance(v, tuple) else v for k, v in effect.settings.items()}
    data = {"effect": effect.name, "where": where, "settings": settings, "values": dict(effect.values)}
    return data | {"plugin": effect.plugin} if effect.plugin else data


def read(kind: type[Effect], data: Json, field: str) -> Effect:
    """Return an effect of a kind from plain data.

    Parameters
    ----------
    kind
        Which effect.
    data
        As ``to_json`` wrote it.
    field
        Where it stands, for messages.

    Raises
    ------
    SpecError
        Naming the part of ``field`` that is missing or wrong.
    """
    parts = {part: data.get(part, {}) for part in ("where", "settings", "values")}
    for part, given in parts.items():
        if not isinstance(given, dict):
            raise SpecError(f"{field}.{part}: must be a mapping")
    try:
        require(parts["where"], kind)
        settings = {k: tuple(v) if isinstance(v, list) else v for k, v in parts["settings"].items()}
        effect = kind(dict(parts["where"]), {k: float(v) for k, v in parts["values"].items()}, settings)
        lacking = [q.name for q in effect.parameter_specs() if q.name not in effect.values]
        unknown = set(effect.held) - {q.name for q in effect.parameter_specs()}
    except ModelError as error:
        raise SpecError(f"{field}: {error}") from error
    except KeyError as error:
        raise SpecError(f"{field}.settings.{error.args[0]}: is missing") from error
    except (TypeError, ValueError) as error:
        raise SpecError(f"{field}.values: must be numbers ({error})") from error
    if lacking:
        raise SpecError(f"{field}.values.{lacking[0]}: is missing")
    if unknown:
        raise SpecError(f"{field}.settings.held: {min(unknown, key=str)!r} is none of its values")
    return effect
