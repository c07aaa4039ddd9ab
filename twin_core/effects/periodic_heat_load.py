"""An undeclared periodic heat: a duty cycle, an instrument's schedule, albedo that nobody modelled."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.network.model import Addition, Layout
from twin_core.network.terms import Along, Entry, Heat
from twin_core.parameters.parameter import Parameter

N_PEAKS = 6
SAMPLES_PER_PERIOD = 4.0
LEAST_PERIODS = 2.0
"""Periods within the longest segment, at least: what went through fewer has not come back once; a slow change is no period."""

FINER = 4
"""The spectrum is read at a spacing this much finer than one over the record's length."""


@dataclass(frozen=True)
class PeriodicHeat:
    """q = Q + A sin(2 pi t / P) + B cos(2 pi t / P), t from an origin; values are Q, A, B, P."""

    node: int
    origin_s: float
    parameters: tuple[Parameter, ...]
    borrows: tuple[str, ...] = ()

    def evaluate(self, along: Along, values: FloatArray) -> Heat:
        """Evaluate the load."""
        mean, sine, cosine, period = values
        phase = 2.0 * np.pi * (along.time_s - self.origin_s) / period
        s, c = np.sin(phase), np.cos(phase)
        by_period = -(sine * c - cosine * s) * phase / period
        series = (np.ones_like(phase), s, c, by_period)
        return Heat(
            (self.node,),
            (mean + sine * s + cosine * c)[:, None],
            np.zeros((1, 1, 1)),
            [Entry(i, self.node, x) for i, x in enumerate(series)],
        )


class PeriodicHeatLoad(Effect):
    """q = Q + A sin(2 pi t / P) + B cos(2 pi t / P).

    A period shows in every reading, its mean only in what long trajectories tell of conductances: in a building with a daily
    cycle a mean that no reading spoke for made up for a mass, with four times the losses, and a colder week was told 2 K wrong.
    """

    name = "periodic_heat_load"
    keys = ("node",)
    equation = "q = Q + A sin(2 pi (t - t_0) / P) + B cos(2 pi (t - t_0) / P), t_0 = first sample"
    reference = "Gilmore, Spacecraft Thermal Control Handbook, 2nd ed., ch. 2: orbital heating"
    sentence = "a periodic heat load on {node} was missing"

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return mean, both amplitudes and the period, which is no longer than the record that it was found in can tell."""
        return (
            ParameterSpec("Q_W", "W", null=0.0),
            ParameterSpec("A_W", "W", null=0.0),
            ParameterSpec("B_W", "W", null=0.0),
            ParameterSpec("P_s", "s", positive=True, prior_std=1.0, upper=self.settings.get("longest_s")),
        )

    def addition(self, layout: Layout) -> Addition:
        """Return the load."""
        node, origin = layout.node(self.where["node"]), float(self.settings["origin_s"])
        return Addition((PeriodicHeat(node, origin, self.parameters()),), dated=bool(self.settings["dated"]))

    @classmethod
    def places(cls, layout: Layout) -> Iterable[Where]:
        """Yield every node."""
        yield from ({"node": node} for node in layout.declared_nodes)

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield the null effect at the periods that stand out in what the node's sensors, or all, read beyond the model."""
        window = longest_segment(survey)
        span_s = float(np.ptp(survey.along.time_s[window]))
        settings = {"origin_s": survey.begin_s, "dated": survey.dated, "longest_s": span_s / LEAST_PERIODS}
        for period in standing_out_s(survey, where["node"]):
            yield cls(where, {"Q_W": 0.0, "A_W": 0.0, "B_W": 0.0, "P_s": period}, settings)

    def simplified(self, survey: Survey) -> Iterable[Self]:
        """Yield the load about no mean."""
        if not self.held:
            yield self.with_values({"Q_W": 0.0}).holding("Q_W")


def longest_segment(survey: Survey) -> slice:
    """Return the points of the segment that lasts longest."""
    return max(survey.segments(), key=lambda s: survey.along.time_s[s.stop - 1] - survey.along.time_s[s.start])


def standing_out_s(survey: Survey, node: str) -> list[float]:
    """Return the periods at which the residual's spectrum, or that of its rate, has its highest peaks, in s.

    A heat of some period leaves a line at that period in every temperature that feels it. The rate of a residual is as
    white as the heat behind it; the residual itself shows the lines that are felt most.

    Parameters
    ----------
    survey
        Its longest segment is taken.
    node
        Whose sensors are looked at; all sensors where it has none.
    """
    window = longest_segment(survey)
    spec = survey.layout.spec
    own = [i for i, sensor in enumerate(spec.sensors) if survey.layout.sensor_node(sensor) == node]
    time_s, residual = survey.along.time_s[window], survey.residual_K[window][:, own or slice(None)]
    grid_s = np.linspace(time_s[0], time_s[-1], max(time_s.size // 2, 2))
    even = np.stack([np.interp(grid_s, time_s, column) for column in residual.T], axis=1)
    even = (even - even.mean(axis=0)) / np.maximum(even.std(axis=0), 1e-12) * np.hanning(grid_s.size)[:, None]
    step = float(grid_s[1] - grid_s[0])
    frequency = np.fft.rfftfreq(FINER * grid_s.size, step)
    power = (np.abs(np.fft.rfft(even, FINER * grid_s.size, axis=0)) ** 2).sum(axis=1)
    seen = (frequency * (grid_s[-1] - grid_s[0]) >= LEAST_PERIODS) & (frequency * step <= 1.0 / SAMPLES_PER_PERIOD)
    found: list[int] = []
    for spectrum in (power, power * frequency**2):
        # Peaks by hand: scipy.signal loads scipy.stats, half a second that few need.
        looked_at = np.where(seen, spectrum, 0.0)
        inner = looked_at[1:-1]
        peaks = 1 + np.flatnonzero((inner > looked_at[:-2]) & (inner >= looked_at[2:]))
        found += peaks[np.argsort(-spectrum[peaks])[:N_PEAKS]].tolist()
    return [1.0 / float(frequency[i]) for i in dict.fromkeys(found)]
