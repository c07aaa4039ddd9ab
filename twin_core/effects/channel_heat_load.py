"""Heat that follows a channel that no load reads: attitude-steered sunlight, an instrument mode, a table position, a power."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Self

import numpy as np

from twin_core._typing import BoolArray, FloatArray
from twin_core.effects.base import Beyond, Effect, ParameterSpec, Survey, Where
from twin_core.errors import ModelError
from twin_core.network.model import Addition, Layout
from twin_core.network.orbit_block import PREFIX
from twin_core.network.spec import Load
from twin_core.network.terms import Along, ChannelLoad, SteeredTable, TableLoad, nearest, table_basis
from twin_core.orbit.environment import BETA

N_KNOTS = 6
OTHER_KNOTS = (4, 9, 13, 18)
"""Other numbers of knots that a curve is tried with where it is worth a refit; each value must pay for itself."""
EDGE = 1e-9
"""Share of the visited range by which a channel may leave it without a word."""
MIN_SHARE = 0.02
"""An inner knot needs this share of the samples near it, or its value would be a guess."""

N_PARTS, MIN_PARTS = 8, 2
"""What a state does at a knot must be seen in so many parts of the record: only what repeats can be told from chance."""


def in_proportion(series: FloatArray) -> tuple[float]:
    """Return the one knot of a heat in proportion to a power: the largest that it is."""
    return (float(series[np.abs(series).argmax()]),)


def even_knots(series: FloatArray, n_knots: int = N_KNOTS) -> tuple[float, ...]:
    """Return knots spread evenly over the visited range, ends included, without those that few samples are near."""
    knots = np.linspace(float(series.min()), float(series.max()), n_knots)
    kept = np.bincount(nearest(series, knots.tolist()), minlength=n_knots) > MIN_SHARE * series.size
    kept[[0, -1]] = True
    return tuple(float(k) for k in knots[kept])


def revisited(at: BoolArray, n_least: float) -> bool:
    """Return whether points (n_points,) are at least so many, in several parts of the record."""
    counts = np.array([part.sum() for part in np.array_split(at, N_PARTS)])
    return bool(counts.sum() > n_least and (counts > n_least / N_PARTS).sum() >= MIN_PARTS)


class ChannelHeatLoad(Effect):
    """q = f(x): piecewise linear over knots, or one value per level; or per level another table of a declared channel.

    With a single knot it is in proportion to the channel: a load that was not declared. The latter is what a commanded state
    does that shades or exposes parts: what attitude brings in differs from state to state. The declared table tells it for
    the state that is visited most, the effect how the others differ from that.
    """

    name = "channel_heat_load"
    keys = ("node", "channel")
    equation = "q = f(x)"
    reference = (
        "Solar heat by pitch and instrument position in the Chandra thermal models (Aldcroft, Xija documentation)"
    )
    sentence = "a heat load on {node} that depends on {channel} was missing"
    reported_settings = ("knots", "states", "across")

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the heat at each knot; what straight lines between knots get wrong adds to its deviation."""
        errors = self._interpolation_error_W()
        return tuple(ParameterSpec(f"values_W[{i}]", "W", null=0.0, resolution=float(e)) for i, e in enumerate(errors))

    @property
    def _is_curve(self) -> bool:
        """Whether the heat is a curve over its own channel, rather than levels or another channel's table by state."""
        return "across" not in self.settings and not self.settings["levels"]

    @property
    def _is_in_proportion(self) -> bool:
        return len(self.settings["knots"]) == 1

    def _interpolation_error_W(self) -> FloatArray:
        """Return by how much a smooth curve lies off the best straight lines between its knots, (n_knots,).

        Straight lines that fit a curve of second derivative f'' best lie off it by h² f'' / 12 at the knots (C. de Boor, A
        Practical Guide to Splines, 2001, chapter III); h² f'' is told by the second differences of the values.
        """
        knots = np.array(self.settings["knots"], dtype=np.float64)
        if not self._is_curve or knots.size < 3:
            return np.zeros(knots.size)
        values = np.array([self.values.get(f"values_W[{i}]", 0.0) for i in range(knots.size)])
        slopes, gaps = np.diff(values) / np.diff(knots), np.diff(knots)
        bends = np.abs(np.diff(slopes)) / (0.5 * (gaps[1:] + gaps[:-1])) * np.maximum(gaps[1:], gaps[:-1]) ** 2
        return np.asarray(np.concatenate([bends[:1], bends, bends[-1:]]) / 12.0)

    def beyond(self, layout: Layout, along: Along) -> Beyond | None:
        """Return where the channel leaves the range of the knots: the heat is held there, a curve would have gone on."""
        if not self._is_curve or self._is_in_proportion:
            return None
        knots = np.array(self.settings["knots"], dtype=np.float64)
        x = along.inputs[self.where["channel"]]
        away = np.maximum(np.maximum(knots[0] - x, x - knots[-1]), 0.0)
        outside = away > EDGE * (knots[-1] - knots[0])
        if not outside.any():
            return None
        values = np.array([self.values[q.name] for q in self.parameter_specs()])
        slope = float(np.sqrt(np.mean((np.diff(values) / np.diff(knots)) ** 2)))
        visited = f"{self.where['channel']} {knots[0]:.4g} to {knots[-1]:.4g}"
        return Beyond(layout.node(self.where["node"]), outside, np.where(outside, slope * away, 0.0), visited)

    def refined(self, survey: Survey) -> Iterable[Self]:
        """Yield the curve over fewer and over more knots."""
        if self._is_curve and not self._is_in_proportion:
            series = survey.along.inputs[self.where["channel"]]
            knots = {even_knots(series, n) for n in (N_KNOTS, *OTHER_KNOTS)}
            for some in sorted(knots, key=len):
                yield self._null(self.where, {"knots": some, "levels": False})

    def simplified(self, survey: Survey) -> Iterable[Self]:
        """Yield the table about no mean over the record: one value is held, for only their differences count."""
        if "across" in self.settings or self._is_in_proportion or self.held:
            return
        knots, levels = tuple(self.settings["knots"]), bool(self.settings["levels"])
        visits = table_basis(survey.along.inputs[self.where["channel"]], knots, levels).mean(axis=0)
        held = self.holding(self.parameter_specs()[int(visits.argmax())].name)
        yield replace(held, settings={**held.settings, "visits": tuple(visits.tolist())})

    def centred(self, survey: Survey) -> Self:
        """Return a table about no mean with each value as the heat that flows there."""
        if "visits" not in self.settings:
            return self
        mean_W = float(np.dot(self.settings["visits"], [self.values[q.name] for q in self.parameter_specs()]))
        return self.with_values({q.name: self.values[q.name] - mean_W for q in self.parameter_specs()})

    def addition(self, layout: Layout) -> Addition:
        """Return the table."""
        own, node, channel = self.settings, layout.node(self.where["node"]), self.where["channel"]
        knots, parameters = tuple(own["knots"]), self.parameters()
        if self._is_in_proportion:
            return Addition((ChannelLoad(node, channel, 1.0 / knots[0], False, parameters),))
        if "across" not in own:
            visits = tuple(own.get("visits", ()))
            if len(visits) not in (0, len(knots)):
                raise ModelError(
                    f"{self.label}: settings.visits must hold {len(knots)} shares, one for each knot, or none"
                )
            table = TableLoad(node, channel, knots, bool(own["levels"]), 1.0, False, parameters, visits=visits)
            return Addition((table,))
        solar, states, rests = bool(own["solar"]), tuple(own["states"]), tuple(own["levels"])
        table = SteeredTable(
            node, own["across"], knots, False, 1.0, solar, parameters, (), None, states, channel, rests
        )
        return Addition((table,))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node with every auxiliary channel, but where a table of that channel is declared; and with every power
        of the telemetry that no load reads.

        Not the parts of a quaternion, which mean nothing one by one, nor the orbit's angle to the Sun, which moves so
        slowly that it would explain any drift; nor what a formula gives, whose channels stand for themselves.
        """
        spec = layout.spec
        mute = {f"{PREFIX}{BETA}", *spec.attitude_channels, *spec.derived}
        declared = {(load.channel, load.node) for load in spec.loads if load.table is not None}
        channels = [name for name, c in spec.inputs.items() if c.kind == "auxiliary" and name not in mute]
        channels += [
            name for name, c in spec.channels.items() if c.kind == "power" and name not in spec.balance_channels
        ]
        for node in layout.declared_nodes:
            for channel in channels:
                if (channel, node) not in declared:
                    yield {"node": node, "channel": channel}

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield a table over the levels that the channel takes, or over its range, and what a level does to others; of a power
        what is in proportion to it."""
        name = where["channel"]
        if name not in survey.along.inputs:
            return
        series = survey.along.inputs[name]
        channel = survey.layout.spec.inputs[name]
        if channel.kind == "power":
            if np.ptp(series) > 0.0:
                yield cls._null(where, {"knots": in_proportion(series), "levels": False})
            return
        levels = channel.levels or np.unique(series).size <= 6
        knots = survey.channel_levels.get(name) or tuple(np.unique(series))
        if not levels:
            knots = even_knots(series)
        if len(knots) < 2:
            return
        yield cls._null(where, {"knots": knots, "levels": bool(levels)})
        for load in survey.layout.spec.loads if levels else ():
            if load.table is not None and load.table.knots and load.channel in survey.along.inputs:
                yield from cls._steered(where, knots, load, survey)

    @classmethod
    def _steered(cls, where: Where, levels: tuple[float, ...], load: Load, survey: Survey) -> Iterable[Self]:
        """Yield how a declared table differs between states, at the knots to which each state has come again and again."""
        assert load.table is not None and load.table.knots is not None
        knots = load.table.knots
        state = nearest(survey.along.inputs[where["channel"]], levels)
        knot = nearest(survey.along.inputs[load.channel], knots)
        reference = int(np.bincount(state, minlength=len(levels)).argmax())
        n_least = MIN_SHARE / len(levels) * state.size
        cells = [
            (level, at)
            for k, level in enumerate(levels)
            for i, at in enumerate(knots)
            if k != reference and revisited((state == k) & (knot == i), n_least)
        ]
        states, at = tuple(level for level, _ in cells), tuple(knot for _, knot in cells)
        if len(at) > len(set(states)):  # a state with a single knot is a level
            settings = {"knots": at, "states": states, "across": load.channel, "levels": levels, "solar": load.solar}
            yield cls._null(where, settings)

    @classmethod
    def _null(cls, where: Where, settings: dict[str, object]) -> Self:
        """Return the effect at no heat."""
        knots = settings["knots"]
        assert isinstance(knots, tuple)
        return cls(where, {f"values_W[{i}]": 0.0 for i in range(len(knots))}, settings)
