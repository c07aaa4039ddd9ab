"""The calibrated model: numbers with their uncertainty, plain words about what the data cannot see, a JSON form."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NoReturn

import numpy as np

from twin_core import __version__
from twin_core._typing import FloatArray, Json
from twin_core.effects import effect_from_json, effect_to_json
from twin_core.effects.base import Effect
from twin_core.errors import ModelError, SpecError
from twin_core.network.model import Network, build_network
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import dump_spec, load_spec
from twin_core.parameters.transforms import Log, is_logarithmic

FORMAT = "thermal-twin-model/1"
LEAST_STEP_S = 1e-3
"""No thermal record is sampled faster; a shorter step would only fill the memory."""


@dataclass(frozen=True, repr=False)
class CalibratedModel:
    """A network at its calibrated values.

    Attributes
    ----------
    spec
        What the operator declared.
    effects
        Terms that were found to be missing, as effects with their values.
    values
        Parameter name -> physical value, effects included.
    covariance : (n_free, n_free)
        Of the free parameters in the solver's coordinate (ln for positive ones), in the order of ``free_names``, if the network
        is the whole truth; the deviations of ``summary`` hold how far it is not, where that is known.
    free_names
        Names of the calibrated parameters; none, and no covariance, where the method states no uncertainty.
    noise_K
        Sensor -> white noise standard deviation.
    misfit_K, misfit_length_s
        Sensor -> standard deviation and correlation length of what the model leaves beyond the noise.
    max_step_s
        Longest time step of its rollouts.
    table_knots
        (channel, node) -> levels read from telemetry.
    summary
        Train span, errors, notices, parameters with standard deviations.
    """

    spec: TwinSpec
    effects: tuple[Effect, ...]
    values: dict[str, float]
    covariance: FloatArray
    free_names: tuple[str, ...]
    noise_K: dict[str, float]
    misfit_K: dict[str, float]
    misfit_length_s: dict[str, float]
    max_step_s: float
    table_knots: dict[tuple[str, str], tuple[float, ...]] = field(default_factory=dict)
    summary: Json = field(default_factory=dict)

    def __repr__(self) -> str:
        """Tell what it is in one line."""
        added = ", ".join(effect.label for effect in self.effects) or "no effect"
        return f"<CalibratedModel {self.spec.twin}: {len(self.free_names)} calibrated parameters, {added} added>"

    def network(self) -> Network:
        """Return the network at the calibrated values."""
        return self._network

    @cached_property
    def _network(self) -> Network:
        """Made once: live forecasts and assimilation ask for it with every step."""
        network = build_network(self.spec, self.effects, table_knots=self.table_knots)
        return network.with_parameters(network.parameters.updated(self.values))

    def noise_vector_K(self) -> FloatArray:
        """Return the noise of the sensors, (n_sensors,)."""
        return np.array([self.noise_K[s] for s in self.spec.sensors])

    def to_json(self) -> Json:
        """Return the model as plain JSON data that ``from_json`` reads back."""
        return {
            "format": FORMAT,
            "code_version": __version__,
            "spec": dump_spec(self.spec),
            "effects": [effect_to_json(effect) for effect in self.effects],
            "values": self.values,
            "free_names": list(self.free_names),
            "covariance": self.covariance.tolist(),
            "noise_K": self.noise_K,
            "misfit_K": self.misfit_K,
            "misfit_length_s": self.misfit_length_s,
            "max_step_s": self.max_step_s,
            "table_knots": [{"channel": c, "node": n, "knots": list(k)} for (c, n), k in self.table_knots.items()],
            "summary": self.summary,
        }

    @classmethod
    def from_json(cls, data: Any) -> "CalibratedModel":
        """Return the model of a JSON file.

        Raises
        ------
        SpecError
            Naming the field that is missing or wrong.
        """
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise SpecError(
                f"format: not a model file of this program (expected '{FORMAT}'); make one with twin calibrate"
            )
        try:
            spec = load_spec(_mapping(data["spec"], "spec"))
            free_names = tuple(str(name) for name in _list(data["free_names"], "free_names"))
            values = _mapping(data["values"], "values")
            per_sensor = {
                field_name: {
                    s: _number(_mapping(data[field_name], field_name)[s], f"{field_name}.{s}") for s in spec.sensors
                }
                for field_name in ("noise_K", "misfit_K", "misfit_length_s")
            }
            model = cls(
                spec,
                tuple(effect_from_json(item, i) for i, item in enumerate(_list(data["effects"], "effects"))),
                {str(name): _number(value, f"values.{name}") for name, value in values.items()},
                _square(data["covariance"], len(free_names)),
                free_names,
                **per_sensor,
                max_step_s=_number(data["max_step_s"], "max_step_s"),
                table_knots=dict(_knots(item, i) for i, item in enumerate(_list(data["table_knots"], "table_knots"))),
                summary=dict(_mapping(data["summary"], "summary")),
            )
        except KeyError as error:
            raise SpecError(f"{error.args[0]}: is missing from the model file") from error
        model._check()
        return model

    def _check(self) -> None:
        """Refuse a model whose numbers are not numbers, or do not fit its network."""
        positive = {
            "noise_K": self.noise_K,
            "misfit_length_s": self.misfit_length_s,
            "": {"max_step_s": self.max_step_s},
        }
        for field_name, row in positive.items():
            for name, value in row.items():
                if not (np.isfinite(value) and value > 0.0):
                    raise SpecError(f"{field_name}.{name}: must be a positive number".lstrip("."))
        if self.max_step_s < LEAST_STEP_S:
            raise SpecError(f"max_step_s: must be at least {LEAST_STEP_S:g} s (got {self.max_step_s:g})")
        if not all(np.isfinite(value) and value >= 0.0 for value in self.misfit_K.values()):
            raise SpecError("misfit_K: must be numbers of at least 0")
        if not np.isfinite(self.covariance).all():
            raise SpecError("covariance: holds a number that is not finite")
        wrong = [name for name, value in self.values.items() if not np.isfinite(value)]
        if wrong:
            raise SpecError(f"values.{wrong[0]}: is not a finite number")
        self._check_network()

    def _check_network(self) -> None:
        """Refuse a model whose values do not fit its network."""
        try:
            parameters = self.network().parameters
        except ModelError as error:
            raise SpecError(f"effects: {error}") from error
        except KeyError as error:
            raise SpecError(f"effects: the setting '{error.args[0]}' is missing") from error
        lacking = [name for name in parameters.index if name not in self.values]
        if lacking:
            raise SpecError(f"values.{lacking[0]}: is missing from the model file")
        if self.free_names and self.free_names != parameters.free_names:
            raise SpecError("free_names: are not the free parameters of the specification and its effects")
        for parameter in parameters.parameters:
            if not is_logarithmic(parameter.transform):
                continue
            if not parameter.value > 0.0:
                raise SpecError(f"values.{parameter.name}: must be positive")
            if not Log().to_value(-np.inf) <= parameter.value <= Log().to_value(np.inf):
                raise SpecError(f"values.{parameter.name}: is out of all proportion ({parameter.value:g})")


def _damaged(name: str, wanted: str) -> NoReturn:
    raise SpecError(f"{name}: must be {wanted}; the model file is damaged")


def _mapping(item: Any, name: str) -> Json:
    return item if isinstance(item, dict) else _damaged(name, "a mapping")


def _list(item: Any, name: str) -> list[Any]:
    return item if isinstance(item, list) else _damaged(name, "a list")


def _number(item: Any, name: str) -> float:
    return float(item) if isinstance(item, int | float) and not isinstance(item, bool) else _damaged(name, "a number")


def _square(item: Any, size: int) -> FloatArray:
    """Return the covariance, (size, size)."""
    rows = _list(item, "covariance")
    flat = [_number(x, f"covariance[{i}]") for i, row in enumerate(rows) for x in _list(row, f"covariance[{i}]")]
    if len(rows) != size or any(len(row) != size for row in rows):
        _damaged("covariance", "a square of numbers, one row per name in free_names")
    return np.array(flat, dtype=np.float64).reshape(size, size)


def _knots(item: Any, position: int) -> tuple[tuple[str, str], tuple[float, ...]]:
    """Return the place of a table and its levels."""
    name = f"table_knots[{position}]"
    table = _mapping(item, name)
    knots = tuple(_number(x, f"{name}.knots") for x in _list(table["knots"], f"{name}.knots"))
    return (str(table["channel"]), str(table["node"])), knots
