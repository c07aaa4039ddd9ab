"""The suite of the closed loop: which spacecraft hide what. Every case is drawn from its seed and nothing else."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count

from benchmarks.case import Case
from benchmarks.fem_cases import FEM_EFFECTS, fem_case
from benchmarks.hidden_effects import HIDDEN
from benchmarks.network_cases import network_case
from benchmarks.outside_vocabulary import OUTSIDE
from benchmarks.several_effects import kind_of, several_case
from benchmarks.solid_cases import solid_case
from benchmarks.worlds.hidden import EFFECTS

GROUPS = ("network", "fem", "fem2", "two", "three", "clean", "clean_fem2", "outside")
N_NETWORKS = 5
N_FEM = 1
N_FEM2 = 1
N_TWO, N_THREE = 24, 12
N_CLEAN = 300
N_CLEAN_FEM2 = 13
N_OUTSIDE = 2
LEAST_TRACE = 2.0
"""Effects that move the readings of the training part less than this, in units of their noise, are drawn again."""

SEVERAL = {"two": 2, "three": 3}
REDRAWN = 100_000
FIRST_SEED = 63_000
"""Seeds from here on belong to the suite; the tests use smaller ones."""


@dataclass(frozen=True)
class Task:
    """One case by name.

    Attributes
    ----------
    group
        One of ``GROUPS``.
    effect
        What is hidden, or the kind of case where there are several; None in clean cases.
    seed
        Draws everything else.
    """

    group: str
    effect: str | None
    seed: int

    @property
    def name(self) -> str:
        """Return a name that is unique in the suite."""
        return f"{self.group}:{self.effect or 'nothing'}:{self.seed}"

    def build(self) -> Case:
        """Simulate the case. Clean records vary in length and sampling as those with effects do."""
        if self.group in ("fem2", "clean_fem2"):
            return solid_case(self.effect, self.seed)
        if self.group in SEVERAL:
            return several_case(SEVERAL[self.group], self.seed)
        if self.group == "fem":
            return fem_case(self.effect, self.seed)
        if self.group == "clean" and self.seed % 10 == 0:
            return fem_case(None, self.seed)
        n_orbits, dt_s = ((12, 60.0), (8, 60.0), (12, 30.0), (6, 45.0))[self.seed % 4]
        if self.effect is None:
            return network_case(None, self.seed, n_orbits=n_orbits, dt_s=dt_s)
        drawn = (network_case(self.effect, self.seed + k * REDRAWN, n_orbits=n_orbits, dt_s=dt_s) for k in count())
        return next(case for case in drawn if case.trace > LEAST_TRACE)


def suite(
    groups: Sequence[str] = GROUPS,
    *,
    n_networks: int = N_NETWORKS,
    n_clean: int = N_CLEAN,
    first_seed: int = FIRST_SEED,
) -> list[Task]:
    """Return the tasks of the suite's groups: so many networks per effect, so many clean records, seeds from where."""
    every = {
        "network": [
            Task("network", e, first_seed + 10 * i + k) for i, e in enumerate(HIDDEN) for k in range(n_networks)
        ],
        "fem": [Task("fem", e, first_seed + 10 * i + k) for i, e in enumerate(FEM_EFFECTS) for k in range(N_FEM)],
        "fem2": [Task("fem2", e, first_seed + 10 * i + k) for i, e in enumerate(EFFECTS) for k in range(N_FEM2)],
        "two": [Task("two", kind_of(s), s) for s in range(first_seed, first_seed + N_TWO)],
        "three": [Task("three", kind_of(s), s) for s in range(first_seed, first_seed + N_THREE)],
        "clean_fem2": [Task("clean_fem2", None, first_seed + k) for k in range(N_CLEAN_FEM2)],
        "clean": [Task("clean", None, first_seed + k) for k in range(n_clean)],
        "outside": [
            Task("outside", e, first_seed + 10 * i + k) for i, e in enumerate(OUTSIDE) for k in range(N_OUTSIDE)
        ],
    }
    return [task for group in groups for task in every[group]]
