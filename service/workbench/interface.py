"""The science behind one small door: what the service asks for, in plain arrays and JSON that travel between processes."""

import hashlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from twin_core.anomaly import Interval, Thresholds

Progress = Callable[[float, str], None]
Json = dict[str, Any]
Inputs = Literal["auto", "repeat", "hold"]
Masks = Mapping[str, Mapping[str, NDArray[np.bool_]]]
"""Channel -> reason -> which samples are no readings, (n_times,)."""


@dataclass(frozen=True)
class Telemetry:
    """A stretch of samples on the way to a worker.

    Attributes
    ----------
    epoch_us
        Where the model's time axis begins, in microseconds since 1970.
    time_us : (n_times,)
        Strictly increasing.
    values : channel -> (n_times,)
        In the channel's own unit; NaN is a missing sample.
    """

    epoch_us: int
    time_us: NDArray[np.int64]
    values: Mapping[str, NDArray[np.float64]]

    def before(self, instant_us: int) -> "Telemetry":
        """Return the samples before an instant."""
        count = int(np.searchsorted(self.time_us, instant_us))
        return Telemetry(self.epoch_us, self.time_us[:count], {c: v[:count] for c, v in self.values.items()})

    def since(self, instant_us: int) -> "Telemetry":
        """Return the samples from an instant on."""
        count = int(np.searchsorted(self.time_us, instant_us))
        return Telemetry(self.epoch_us, self.time_us[count:], {c: v[count:] for c, v in self.values.items()})

    def sha256(self) -> str:
        """Return a fingerprint of times, names and values."""
        digest = hashlib.sha256(self.time_us.tobytes())
        for name in sorted(self.values):
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(self.values[name]).tobytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class Watch:
    """What the search for anomalies needs of a stretch besides its residuals.

    Attributes
    ----------
    readings : sensor -> (n_new,)
        The newest samples as they were read, those included that the filter is not given; NaN where missing.
    state
        What the search before this stretch left behind; None to begin.
    thresholds
        Where an anomaly opens.
    """

    readings: Mapping[str, NDArray[np.float64]]
    state: Json | None
    thresholds: Thresholds


@dataclass(frozen=True)
class Stretch:
    """Telemetry to be filtered with the model of a document, from a state whose instant is that of its first sample."""

    document: str
    telemetry: Telemetry
    state: Json | None
    watch: Watch | None = None


@dataclass(frozen=True)
class CalibrationTask:
    """Calibrate on samples before ``validation_us``, score on those from there on, and score the rival there too."""

    specification: Json
    telemetry: Telemetry
    validation_us: int
    method: str
    deadline_s: float
    """The search ends after so many seconds with the best so far."""
    rival: Json | None = None
    siblings: Mapping[str, Json] = field(default_factory=dict)
    """Active models of other spacecraft of the design: they tell where parameters lie before any telemetry does."""


@dataclass(frozen=True)
class DiagnosisTask:
    """Close the loop on the telemetry."""

    specification: Json
    telemetry: Telemetry
    holdout: float
    burn_in_s: float | None
    false_alarm_rate: float
    deadline_s: float
    """As of a calibration."""
    siblings: Mapping[str, Json] = field(default_factory=dict)
    """Active models of other spacecraft of the design: their effects are looked for first."""


@dataclass(frozen=True)
class Outcome:
    """What a job leaves: a model with what is worth knowing about it, and for a diagnosis report and page."""

    document: Json
    train: Json
    validation: Json
    effects: list[Json]
    rival_rmse_K: float | None = None
    report: Json | None = None
    page: str | None = None
    extra: Json = field(default_factory=dict)
    cut_short: bool = False
    """Whether the search ended at its deadline."""


@dataclass(frozen=True)
class Filtered:
    """An assimilated stretch: (n_times, n_sensors) innovations and their predicted standard deviations, (n_times,) NIS.

    Where anomalies were looked for, ``watch`` is what the next search goes on from, ``intervals`` what changed.
    """

    sensors: tuple[str, ...]
    innovation_K: NDArray[np.float64]
    innovation_std_K: NDArray[np.float64]
    nis: NDArray[np.float64]
    state: Json
    watch: Json | None = None
    intervals: tuple[Interval, ...] = ()


@dataclass(frozen=True)
class ForecastTask:
    """Forecast from the end of ``telemetry``, the filter starting there in ``state`` if there is one.

    ``past`` is what the driving channels did before, ``inputs`` says what those without a plan are taken to do.
    """

    telemetry: Telemetry
    state: Json | None
    horizon_s: float
    step_s: float | None
    plan: Telemetry | None
    quantiles: tuple[float, ...]
    inputs: Inputs = "auto"
    past: Telemetry | None = None


@dataclass(frozen=True)
class Forecasted:
    """Future readings in the channels' own units: (n_times,) and per sensor (n_times,).

    ``present`` is what each sensor reads by the state from which the forecast starts.
    ``whole`` is the low and the high end of the simultaneous band, in which a sensor's whole path stays with
    ``whole_probability``; ``inputs`` says where the future of each driving channel comes from.
    """

    time_us: NDArray[np.int64]
    mean: dict[str, NDArray[np.float64]]
    quantiles: dict[float, dict[str, NDArray[np.float64]]]
    present: Mapping[str, float]
    notices: tuple[str, ...] = ()
    whole: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = field(default_factory=dict)
    whole_probability: float = 0.9
    inputs: Mapping[str, str] = field(default_factory=dict)

    def since(self, from_us: int) -> "Forecasted":
        """Return times and quantiles with the present before them, which is known."""
        time_us = np.concatenate([[from_us], self.time_us])
        quantiles = {
            q: {name: np.concatenate([[self.present[name]], column]) for name, column in columns.items()}
            for q, columns in self.quantiles.items()
        }
        return replace(self, time_us=time_us, quantiles=quantiles)


class Workbench(Protocol):
    """What the service needs to be done."""

    def calibrate(self, task: CalibrationTask, progress: Progress) -> Outcome:
        """Fit the declared network."""

    def diagnose(self, task: DiagnosisTask, progress: Progress) -> Outcome:
        """Close the loop."""

    def inspect(self, document: Json) -> Outcome:
        """Check a model that was made elsewhere; raise TwinError if it is not one."""

    def assimilate(self, stretches: Sequence[Stretch]) -> Sequence[Filtered | Exception]:
        """Filter stretches of telemetry, of one twin each; for each return what it gives, or the error that it raises."""

    def memory_s(self, document: str, telemetry: Telemetry) -> float:
        """Return the longest time constant of a model in seconds, linearised where the telemetry begins."""

    def score(self, document: str, telemetry: Telemetry) -> float | None:
        """Return the open-loop error of a model in K over some telemetry, which begins with a burn-in; None if it has none."""

    def screen(self, units: Mapping[str, str | None], inputs: Collection[str], telemetry: Telemetry) -> Masks:
        """Return which samples of channels in these units, some of which are inputs, are no readings."""

    def forecast(self, document: str, task: ForecastTask) -> Forecasted:
        """Look ahead."""

    def flows(self, document: str, telemetry: Telemetry, state: Json) -> Json:
        """Return temperatures and heat flows of the moment that the state describes."""


MakeWorkbench = Callable[[], Workbench]
"""What makes a workbench in a worker process; it travels there."""


def work(workbench: MakeWorkbench, function: str, task: Any, progress: Progress) -> Any:
    """Do one task; worker processes find this function by its name."""
    return getattr(workbench(), function)(task, progress)
