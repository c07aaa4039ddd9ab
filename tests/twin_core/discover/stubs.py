"""Stubs of trials and findings of which only what decides counts."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from twin_core.discover.evidence import Evidence, Validation
from twin_core.discover.judge import (
    Judged,
)
from twin_core.discover.policy import (
    LEAST_COARSENESS,
    MOST_COARSENESS,
    VISIBLE_COARSENESS,
)
from twin_core.discover.trial import Trial
from twin_core.effects import REGISTRY
from twin_core.effects.base import Effect

JUST = 1e-6


NEEDED = 4.6


LEAST, MOST = LEAST_COARSENESS, MOST_COARSENESS


N_READINGS = 5000


CHANCE = VISIBLE_COARSENESS * float(np.sqrt(2.0 / N_READINGS))


@dataclass
class Problem:
    """A problem of which only the number of its parameters and what its network is declared to touch count."""

    n_free: int
    conducted: tuple[str, ...] = ()
    radiated: tuple[str, ...] = ()

    @property
    def segments(self) -> list[SimpleNamespace]:
        return [SimpleNamespace(valid=np.ones((N_READINGS // 2, 2), dtype=bool))]

    @property
    def network(self) -> SimpleNamespace:
        conductors = [SimpleNamespace(between=("a", boundary)) for boundary in self.conducted]
        radiators = [SimpleNamespace(node="a", sink=boundary) for boundary in self.radiated]
        return SimpleNamespace(spec=SimpleNamespace(conductors=conductors, radiators=radiators))


@dataclass
class Fit:
    problem: Problem
    network: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(layout=None))


@dataclass
class Stub:
    """A trial of which only the excess, the number of its parameters and its likelihood along trajectories count."""

    effects: tuple[Effect, ...] = ()
    left: float = 0.0
    n_free: int = 3
    n_samples: int = N_READINGS
    foresight: float = 1.0
    along: float = 0.0
    beside: float | None = None
    nats: float = 0.0
    fit: Fit = field(init=False)
    present_effects: tuple[Effect, ...] = field(init=False)

    def __post_init__(self) -> None:
        self.fit = Fit(Problem(self.n_free))
        self.present_effects = self.effects

    def excess(self) -> Any:
        return np.array([2.0 * self.left, 0.0])

    def unexplained(self) -> float:
        return self.left_beside(self.share_of_gradients())

    def share_of_gradients(self) -> float:
        return 0.0

    def left_beside(self, share: float) -> float:
        return float(self.excess().mean())

    def log_evidence(self) -> float:
        return self.nats

    def calibration(self) -> Any:
        return SimpleNamespace(log_posterior=self.along)

    def beside_gradients(self) -> Any:
        return None if self.beside is None else SimpleNamespace(log_posterior=self.beside)


def stub(*effects: Effect, left: float = 0.0, n_free: int = 3, foresight: float = 1.0) -> Trial:
    return cast(Trial, Stub(tuple(effects), left, n_free, foresight=foresight))


def load(node: str) -> Effect:
    return REGISTRY["constant_heat_load"]({"node": node}, {"Q_W": 1.0})


def unnamed() -> Effect:
    """Return an effect that claims no law; of its kind alone counts."""
    return cast(Effect, type("Free", (), {"fallback": True, "place": "n0", "label": "free(n0)"})())


def judged(node: str, nats: float, *, n_free: int = 3, left: float = 0.0, foresight: float = 0.5) -> Judged:
    validation = Validation(foresight, 1.0, foresight, 0.1, 1.0, 1, False)
    return Judged(
        (load(node),), Evidence(nats, 0.0), stub(load(node), left=left, n_free=n_free, foresight=foresight), validation
    )


def leak(judged_load: Judged) -> Judged:
    """Return an option with a leak at the node of its load."""
    node = judged_load.effects[0].where["node"]
    effect = REGISTRY["leak_to_boundary"]({"node": node, "boundary": "room"}, {"G_W_per_K": 1.0})
    return replace(judged_load, effects=(effect,))
