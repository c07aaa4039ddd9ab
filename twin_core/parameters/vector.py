"""A named set of parameters and the flat free vector that a solver sees."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twin_core._typing import FloatArray, IntArray
from twin_core.errors import ModelError
from twin_core.parameters.parameter import Parameter


@dataclass(frozen=True)
class ParameterSet:
    """Parameters in a fixed order; the free ones form the solver's vector (n_free,)."""

    parameters: tuple[Parameter, ...]

    def __post_init__(self) -> None:
        """Refuse two parameters of one name."""
        seen: set[str] = set()
        for parameter in self.parameters:
            if parameter.name in seen:
                raise ModelError(f"parameter '{parameter.name}' stands twice in the model")
            seen.add(parameter.name)

    def __len__(self) -> int:
        return len(self.parameters)

    @cached_property
    def index(self) -> dict[str, int]:
        """Position of each name."""
        return {p.name: i for i, p in enumerate(self.parameters)}

    @cached_property
    def free_index(self) -> IntArray:
        """Positions of the parameters that are neither frozen nor tied to another, (n_free,)."""
        own = [i for i, p in enumerate(self.parameters) if not p.frozen and p.tied_to is None]
        return np.array(own, dtype=np.int64)

    @cached_property
    def ties(self) -> dict[int, tuple[int, float]]:
        """Position of each tied parameter -> that of the one it follows, and the size by which it does."""
        return {i: (self.index[p.tied_to], p.size) for i, p in enumerate(self.parameters) if p.tied_to is not None}

    def _tied(self, values: FloatArray) -> FloatArray:
        """Return values (n_parameters,) with those of tied parameters following theirs."""
        if self.ties:
            values = values.copy()
            for i, (shared, size) in self.ties.items():
                values[i] = size * values[shared]
        return values

    @property
    def free_names(self) -> tuple[str, ...]:
        """Names of the free parameters, in the order of the free vector."""
        return tuple(self.parameters[i].name for i in self.free_index)

    @property
    def values(self) -> FloatArray:
        """Physical values, (n_parameters,)."""
        return np.array([p.value for p in self.parameters], dtype=np.float64)

    @property
    def free(self) -> FloatArray:
        """The free vector at the current values, (n_free,)."""
        return np.array([self.parameters[i].free for i in self.free_index], dtype=np.float64)

    @cached_property
    def prior_std(self) -> FloatArray:
        """Prior standard deviations of the free vector, (n_free,); infinite where flat."""
        stds = [self.parameters[i].prior_std for i in self.free_index]
        return np.array([np.inf if s is None else s for s in stds], dtype=np.float64)

    @property
    def lowest(self) -> FloatArray:
        """Lower bounds of the free vector, (n_free,); minus infinity where there is none."""
        return np.array([self.parameters[i].transform.lowest for i in self.free_index], dtype=np.float64)

    @property
    def highest(self) -> FloatArray:
        """Upper bounds of the free vector, (n_free,); infinite where there is none."""
        return np.array([self.parameters[i].transform.highest for i in self.free_index], dtype=np.float64)

    @property
    def step_limits(self) -> FloatArray:
        """Longest steps of the free vector at once, (n_free,); infinite where any will do."""
        return np.array([self.parameters[i].transform.step_limit for i in self.free_index], dtype=np.float64)

    def slope(self, index: int, value: float) -> float:
        """Return d value / d free of one parameter where its physical value is ``value``."""
        transform = self.parameters[index].transform
        return float(transform.slope(transform.to_free(value)))

    def to_values(self, free: FloatArray) -> FloatArray:
        """Return all physical values, (n_parameters,), for a free vector (n_free,)."""
        values = self.values
        for position, i in enumerate(self.free_index):
            values[i] = self.parameters[i].transform.to_value(float(free[position]))
        return self._tied(values)

    def slopes(self, free: FloatArray) -> FloatArray:
        """Return d value / d free of each free parameter, (n_free,)."""
        return np.array(
            [self.parameters[i].transform.slope(float(x)) for i, x in zip(self.free_index, free, strict=True)],
            dtype=np.float64,
        )

    def at_free(self, free: FloatArray) -> "ParameterSet":
        """Return the set with the values of a free vector."""
        return self.at_values(self.to_values(free))

    def at_values(self, values: FloatArray) -> "ParameterSet":
        """Return the set with other physical values, (n_parameters,); tied ones follow theirs."""
        return ParameterSet(tuple(p.at(float(v)) for p, v in zip(self.parameters, self._tied(values), strict=True)))

    def updated(self, values: Mapping[str, float]) -> "ParameterSet":
        """Return the set with the named values replaced; names that it lacks are ignored, tied ones follow theirs."""
        named = np.array([values.get(p.name, p.value) for p in self.parameters], dtype=np.float64)
        return self.at_values(named)

    def joined(self, more: Iterable[Parameter]) -> "ParameterSet":
        """Return the set with more parameters at its end."""
        return ParameterSet(self.parameters + tuple(more))

    def as_dict(self) -> dict[str, float]:
        """Return name -> physical value."""
        return {p.name: p.value for p in self.parameters}
