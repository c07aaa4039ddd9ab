"""What effects that set in at an instant share: a ramp of fixed width around it, and where to look for it.

The instant is an ordinary parameter. A step would have no derivative by it; a ramp as wide as one sampling interval does,
and no telemetry can tell the two apart.
"""

from collections.abc import Iterable
from typing import Any, ClassVar, Self

import numpy as np

from twin_core._typing import FloatArray
from twin_core.effects.base import Effect, Quality, Survey, Where
from twin_core.parameters.transforms import Shifted

N_ONSETS = 28
MARGIN = 0.03
"""Onsets this close to an end of the record, as a share of its samples, are nobody's business: too little tells them."""

N_REFINED = 32


class OnsetEffect(Effect):
    """An effect that sets in at ``time``; a subclass names its amplitude."""

    amplitude: ClassVar[Quality]

    def qualities(self) -> tuple[Quality, ...]:
        """Return the amplitude and the onset, which moves by the spacing of ``starts``; its prior spans the record."""
        clock = Shifted(self.settings["begin_s"], self.settings["span_s"] / N_ONSETS)
        return self.amplitude, Quality("time", "s", prior_std=float(N_ONSETS), instant=clock)

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
        if samples.size < 3:
            return
        ends = np.quantile(np.arange(samples.size), [MARGIN, 1.0 - MARGIN])
        for k in _ranks(ends[0], ends[1], N_ONSETS, samples.size):
            yield cls(where, cls._at(samples, k), _settings(samples, survey.dated))

    def refined(self, survey: Survey) -> Iterable[Self]:
        """Yield onsets on both sides, as far as the neighbours on the grid of ``starts``."""
        samples = np.unique(survey.sample_s)
        own, reach = np.searchsorted(samples, self.values["time"]), samples.size / N_ONSETS
        for k in _ranks(own - reach, own + reach, N_REFINED, samples.size):
            yield type(self)(self.where, self._at(samples, k), self.settings)

    @classmethod
    def _at(cls, samples_s: FloatArray, k: int) -> dict[str, float]:
        """Return the values of an effect without amplitude that has set in at sample ``k``, half a ramp before it."""
        assert cls.amplitude.null is not None
        return {cls.amplitude.name: cls.amplitude.null, "time": float(samples_s[k]) - 0.5 * _width_s(samples_s)}


def _ranks(first: float, last: float, count: int, n_samples: int) -> list[int]:
    """Return up to ``count`` positions of samples, evenly between two of them, the very first left out."""
    positions = np.rint(np.linspace(first, last, count)).astype(np.int64)
    return [int(k) for k in np.unique(positions) if 0 < k < n_samples]


def _width_s(samples_s: FloatArray) -> float:
    return float(np.median(np.diff(samples_s)))


def _settings(samples_s: FloatArray, dated: bool) -> dict[str, Any]:
    span = float(samples_s[-1] - samples_s[0])
    return {"begin_s": float(samples_s[0]), "span_s": span, "width_s": _width_s(samples_s), "dated": dated}
