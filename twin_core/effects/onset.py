"""What effects that set in at an instant share: a ramp of fixed width around it, and where to look for it.

The instant is an ordinary parameter. A step would have no derivative by it; a ramp as wide as one sampling interval does,
and no telemetry can tell the two apart.
"""

from collections.abc import Iterable
from typing import ClassVar, Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.parameters.transforms import Shifted

N_ONSETS = 28
N_REFINED = 32
MARGIN = 0.03
"""Onsets this close to an end of the record, as a share of its samples, are nobody's business: too little tells them."""


class OnsetEffect(Effect):
    """An effect that sets in at ``time``; a subclass names its amplitude."""

    amplitude: ClassVar[ParameterSpec]

    def parameter_specs(self) -> tuple[ParameterSpec, ...]:
        """Return the amplitude and the onset, which moves by the spacing of ``starts``; its prior spans the record."""
        clock = Shifted(self.settings["begin_s"], self.settings["span_s"] / N_ONSETS)
        resolution = self.blind_s / np.sqrt(12.0)
        return self.amplitude, ParameterSpec(
            "time", "s", prior_std=float(N_ONSETS), instant=clock, resolution=resolution
        )

    @property
    def blind_s(self) -> float:
        """How long it is around the onset that nothing tells one instant from another."""
        return float(self.settings.get("blind_s", 0.0))

    def ramp(self, clock_s: FloatArray, time_s: float) -> tuple[FloatArray, FloatArray]:
        """Return the share that has set in, from 0 to 1, and its derivative by the onset."""
        width = self.settings["width_s"]
        share = (clock_s - time_s) / width + 0.5
        within = np.heaviside(share, 0.5) - np.heaviside(share - 1.0, 0.5)
        return np.clip(share, 0.0, 1.0), -within / width

    def change(self, clock_s: FloatArray, values: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        """Return a factor f from the onset on, less one, and its derivatives by f and the onset; values are both."""
        share, slope = self.ramp(clock_s, values[1])
        return (values[0] - 1.0) * share, [share, (values[0] - 1.0) * slope]

    @classmethod
    def starts(cls, where: Where, survey: Survey) -> Iterable[Self]:
        """Yield onsets with equal numbers of samples between them, so that none lies in a gap."""
        samples = np.unique(survey.sample_s)
        if samples.size < 3 or not survey.one_clock:
            return
        begin, span = float(samples[0]), float(samples[-1] - samples[0])
        settings = {"begin_s": begin, "span_s": span, "width_s": float(np.median(np.diff(samples)))}
        null = cls(where, {cls.amplitude.name: cls.amplitude.null or 0.0}, {**settings, "dated": survey.dated})
        ranks = np.linspace(MARGIN, 1.0 - MARGIN, N_ONSETS) * (samples.size - 1)
        yield from (null.first_seen_at(sample) for sample in _at_ranks(samples, ranks))

    def refined(self, survey: Survey) -> Iterable[Self]:
        """Yield onsets on both sides, as far as the neighbours on the grid of ``starts``."""
        samples = np.unique(survey.sample_s)
        own, reach = float(np.searchsorted(samples, self.values["time"])), samples.size / N_ONSETS
        within = (max(MARGIN * samples.size, 1.0), (1.0 - MARGIN) * (samples.size - 1))
        ranks = np.clip(np.linspace(own - reach, own + reach, N_REFINED), *within)
        yield from (self.first_seen_at(sample) for sample in _at_ranks(samples, ranks))

    def first_seen_at(self, sample_s: float) -> Self:
        """Return the effect that a sample sees in full as the first one: it sets in half a ramp before it."""
        return self.with_values({"time": float(sample_s) - 0.5 * self.settings["width_s"]})


def _at_ranks(samples_s: FloatArray, ranks: FloatArray) -> FloatArray:
    """Return the samples next to the given positions in their order, each once."""
    return np.asarray(samples_s[np.unique(np.rint(ranks).astype(np.int64))])
