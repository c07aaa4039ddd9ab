"""What a poor fit usually means: the common mistakes of a declaration, each tried on the telemetry.

Where parameters end far from their guesses, or the misfit is many times the noise, something is declared wrongly more
often than physics is missing: a unit, a sign, two sensors, a value that is held, a coupling. Each suspicion is a variant of
the declaration or of the record that is fitted again, coarsely. What it gains is counted in nats: readings explained to
their noise, guesses come back to, less half a logarithm for a parameter that it adds (Schwarz 1978).
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations, zip_longest
from typing import Any

import numpy as np

from twin_core._typing import FloatArray, Json
from twin_core.calibrate.approach import approach, thinned
from twin_core.calibrate.containment import NO_DEADLINE, TimeIsUpError, attempted, check_time, limited
from twin_core.calibrate.identifiability import gone_far, how_far
from twin_core.calibrate.optimise import Optimum
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.calibrate.starting import balance_starts
from twin_core.calibrate.statistics import whiteness
from twin_core.constants import ZERO_CELSIUS_K
from twin_core.network.model import Network, build_network, told_values
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import dump_spec, load_spec
from twin_core.parameters.parameter import NO_GUESS_LOG_STD
from twin_core.parameters.transforms import is_logarithmic
from twin_core.parameters.vector import ParameterSet
from twin_core.telemetry import Record

MANY_NOISES = 5.0
"""A misfit of more noises than this is no matter of a sensor's figure: something is wrong or missing."""

LEAST_GAIN_NATS = 5.0
"""A suspicion is told where it makes the record at least e^5, 150 times, as likely."""

MOST_TOLD, MOST_TRIED = 3, 100
SAMPLES = 250
"""Records are thinned to about so many samples, to twice as many at most: a mistake shows in any of them."""

SHORTEST = 10
"""Samples of a thinned record, at least."""

FIRST_CPU_S, CLOSER_CPU_S = 12.0, 8.0
"""Computing time of the first look at all suspicions together, and of the closer one. What a fit costs grows with the cube
of the network, and the number of suspicions with its square: only a limit bounds their product."""

FEWEST_INDEPENDENT = 10.0
"""A misfit that lasts as long as the record still counts as so many readings per sensor."""

EARTHLY_K = (150.0, 480.0)
"""Where temperatures of hardware lie; a unit is suspected only where the other one brings them there."""

THOUSAND = 1000.0

QUICK_ROUNDS, ROUNDS = 2, 4
"""Rounds of the approach in a first look at every suspicion, and in a closer one at the best :data:`MOST_CLOSE`."""

MOST_CLOSE = 6

WITHOUT_PARAMETER = frozenset({"unit", "sign", "swapped sensors", "swapped loads", "misplaced load"})
"""Mistakes that add no parameter where they are undone."""

SAME = 0.95
"""A misfit that is no smaller than this share of another is the same."""


@dataclass(frozen=True)
class Suspicion:
    """One mistake that would explain the misfit or the way of the parameters.

    Attributes
    ----------
    mistake
        ``unit``, ``sign``, ``swapped sensors``, ``swapped loads``, ``misplaced load``, ``held value`` or ``missing coupling``.
    where
        Names of the channels, parameters or nodes.
    words
        The mistake in words.
    misfit
        Root mean square residual that would be left, in units of the noise.
    gain_nats
        By how much the record would be likelier.
    """

    mistake: str
    where: tuple[str, ...]
    words: str
    misfit: float
    gain_nats: float

    def to_json(self) -> Json:
        """Return it as plain data."""
        return {
            "mistake": self.mistake,
            "where": list(self.where),
            "words": self.words,
            "misfit": self.misfit,
            "gain_nats": self.gain_nats,
        }


@dataclass(frozen=True)
class Declared:
    """What was declared and recorded, thinned, with levels of tables and noise as the calibration found them."""

    spec: TwinSpec
    records: tuple[Record, ...]
    noise_K: FloatArray
    knots: dict[tuple[str, str], tuple[float, ...]] = field(default_factory=dict)

    def problem(self) -> Problem:
        """Return its fitting problem."""
        step_s = 1.5 * float(np.median(np.concatenate([np.diff(r.time_s) for r in self.records])))
        network = build_network(self.spec, table_knots=self.knots)
        return build_problem(network, self.records, self.noise_K, step_s)


@dataclass(frozen=True)
class Variant:
    """A declaration with one mistake undone, made when it is asked for; ``released`` names what is no longer held."""

    mistake: str
    where: tuple[str, ...]
    words: str
    undone: Callable[[], Declared]
    released: str = ""
    added: int = 0


@dataclass(frozen=True)
class Looked:
    """What came of a look at the possible mistakes.

    Attributes
    ----------
    found
        Those that would explain the fit, the most telling first.
    tried, possible
        How many were fitted, and how many there are in such a declaration.
    complete
        Whether nothing was left out: neither a mistake, nor the closer look at one that had come first.
    """

    found: list[Suspicion]
    tried: int
    possible: int
    complete: bool

    @property
    def left_out(self) -> str:
        """What was not looked at, in words; empty where everything was."""
        if self.complete:
            return ""
        if self.tried < self.possible:
            return (
                f"checked {self.tried:,} of {self.possible:,} possible single mistakes in the specification (units, signs, "
                "swapped sensors, misplaced loads, known values, missing couplings); the computing time did not allow for "
                f"the other {self.possible - self.tried:,}, one of which may be the cause"
            )
        return "checked all possible single mistakes in the specification, but not all of the likeliest ones in detail"


def declared_of(problem: Problem) -> Declared:
    """Return what a calibration was made from, thinned; of many records the longest."""
    spec, records = problem.network.spec, [segment.record for segment in problem.segments]
    stride = max(1, sum(r.time_s.size for r in records) // SAMPLES)
    stride = min(stride, max(1, max(r.time_s.size for r in records) // SHORTEST))
    kept: list[Record] = []
    samples = 0
    for record in sorted(records, key=lambda r: -r.time_s.size):
        size = record.time_s.size // stride
        if kept and (size < SHORTEST or samples + size > 2 * SAMPLES):
            break
        kept.append(record)
        samples += size
    in_order = [record for record in records if any(record is one for one in kept)]
    thin = tuple(thinned(spec, record, stride) if stride > 1 else record for record in in_order)
    return Declared(spec, thin, problem.noise_K, dict(problem.network.layout.table_knots))


def variants(declared: Declared) -> list[Variant]:
    """Return the declarations with one common mistake undone each, those first that are common and few.

    Swapped pairs, held values and couplings take turns: of a large network none of them is left out altogether.
    """
    many: Iterable[Sequence[Variant | None]] = zip_longest(
        _swaps(declared), _misplaced(declared), _held(declared), _couplings(declared)
    )
    turns = [one for turn in many for one in turn if one is not None]
    return [*_temperature_units(declared), *_clocks(declared), *_powers(declared), *turns]


def _changed(declared: Declared, columns: dict[str, Any]) -> Declared:
    """Return a declaration whose records have some columns replaced: name -> function of the record."""
    records = tuple(replace(r, values={**r.values, **{n: f(r) for n, f in columns.items()}}) for r in declared.records)
    return replace(declared, records=records)


def _recorded(declared: Declared, name: str) -> bool:
    return all(np.isfinite(record.values.get(name, np.array([np.nan]))).any() for record in declared.records)


def _powers(declared: Declared) -> Iterator[Variant]:
    for name in dict.fromkeys(load.channel for load in declared.spec.loads if load.table is None):
        if not _recorded(declared, name):
            continue
        for factor, mistake, words in (
            (-1.0, "sign", f"power channel '{name}' has the wrong sign"),
            (THOUSAND, "unit", f"power channel '{name}' is 1000 times as large as recorded (kW read as W?)"),
            (1.0 / THOUSAND, "unit", f"power channel '{name}' is a thousandth of what is recorded (mW read as W?)"),
        ):
            scaled = {name: lambda r, name=name, factor=factor: factor * r.values[name]}
            yield Variant(mistake, (name,), words, partial(_changed, declared, scaled))


def _temperature_units(declared: Declared) -> Iterator[Variant]:
    spec = declared.spec
    given = [b.channel for b in spec.boundaries.values() if b.channel is not None]
    names = [n for n in dict.fromkeys([*spec.sensors, *given]) if _recorded(declared, n)]
    for shift_K, words in ((ZERO_CELSIUS_K, "is in degC, not in K"), (-ZERO_CELSIUS_K, "is in K, not in degC")):
        odd = [n for n in names if _earthly(declared, n, shift_K) and not _earthly(declared, n, 0.0)]
        shifted = {n: lambda r, n=n, shift_K=shift_K: r.values[n] + shift_K for n in odd}
        for n in odd:
            yield Variant("unit", (n,), f"channel '{n}' {words}", partial(_changed, declared, {n: shifted[n]}))
        if len(odd) > 1:
            listed = ", ".join(f"'{n}'" for n in odd)
            yield Variant(
                "unit", tuple(odd), f"each of channels {listed} {words}", partial(_changed, declared, shifted)
            )


def _clocks(declared: Declared) -> Iterator[Variant]:
    """Yield other units of time; dates have none, and an orbit is dated."""
    if any(record.epoch_ns is not None for record in declared.records):
        return
    for factor, unit in ((1.0 / THOUSAND, "ms"), (60.0, "minutes"), (3600.0, "hours")):
        words = f"the times are in {unit}, not in seconds"
        yield Variant("unit", ("time_s",), words, partial(_paced, declared, factor))


def _paced(declared: Declared, factor: float) -> Declared:
    records = tuple(replace(record, time_s=factor * record.time_s) for record in declared.records)
    return replace(declared, records=records)


def _earthly(declared: Declared, name: str, shift_K: float) -> bool:
    middle = float(np.nanmedian(np.concatenate([r.values[name] for r in declared.records]))) + shift_K
    return EARTHLY_K[0] <= middle <= EARTHLY_K[1]


def _swaps(declared: Declared) -> Iterator[Variant]:
    spec = declared.spec
    loads = list(dict.fromkeys(load.channel for load in spec.loads if load.table is None))
    for kind, mistake, names in (("sensors", "swapped sensors", spec.sensors), ("loads", "swapped loads", loads)):
        for a, b in combinations([n for n in names if _recorded(declared, n)], 2):
            exchanged = {a: lambda r, b=b: r.values[b], b: lambda r, a=a: r.values[a]}
            yield Variant(
                mistake, (a, b), f"{kind} '{a}' and '{b}' are swapped", partial(_changed, declared, exchanged)
            )


def _misplaced(declared: Declared) -> Iterator[Variant]:
    """Yield loads at other nodes than declared."""
    body = dump_spec(declared.spec)
    loads = list(enumerate(declared.spec.loads))
    for (i, load), node in ((one, node.id) for node in declared.spec.nodes for one in loads):
        taken = {other.node for _, other in loads if other.channel == load.channel}
        if load.table is None and node not in taken and _recorded(declared, load.channel):
            moved = [{**own, "node": node} if j == i else own for j, own in enumerate(body["loads"])]
            words = f"power channel '{load.channel}' heats '{node}', not '{load.node}'"
            where = partial(_respecified, declared, {**body, "loads": moved})
            yield Variant("misplaced load", (load.channel, node), words, where)


def _held(declared: Declared) -> Iterator[Variant]:
    network = build_network(declared.spec, table_knots=declared.knots)
    values = told_values(network)
    columns = [column for record in declared.records for column in record.values.values()]
    rests = all(np.ptp(column[np.isfinite(column)]) == 0.0 for column in columns if np.isfinite(column).any())
    for p in network.parameters.parameters:
        if rests and p.unit == "J/K":  # what rests tells nothing of capacities
            continue
        if p.frozen and is_logarithmic(p.transform):
            words = f"{p.name}, held at {values[p.name]:.3g} {p.unit}".rstrip() + ", is wrong"
            yield Variant("held value", (p.name,), words, lambda: declared, p.name, 1)
    body = dump_spec(declared.spec)
    for name, boundary in declared.spec.boundaries.items():
        if boundary.value_K is not None and boundary.value_K > EARTHLY_K[0]:
            fresh = {**body, "boundaries": {**body["boundaries"], name: {"guess_K": boundary.value_K}}}
            words = f"the temperature of boundary '{name}', held at {boundary.value_K:g} K, is wrong"
            freed = partial(_respecified, declared, fresh)
            yield Variant("held value", (f"T:{name}",), words, freed, f"T:{name}", 1)


def _couplings(declared: Declared) -> Iterator[Variant]:
    spec, body = declared.spec, dump_spec(declared.spec)
    warm = [n for n, b in spec.boundaries.items() if b.value_K is None or b.value_K > EARTHLY_K[0]]
    nodes = [node.id for node in spec.nodes]
    joined = {frozenset(c.between) for c in spec.conductors}
    for a, b in [*combinations(nodes, 2), *((n, w) for n in nodes for w in warm)]:
        if frozenset((a, b)) in joined:
            continue
        fresh = {**body, "conductors": [*body.get("conductors", []), {"between": [a, b]}]}
        words = f"a coupling between '{a}' and '{b}' is missing"
        joined_up = partial(_respecified, declared, fresh)
        yield Variant("missing coupling", (a, b), words, joined_up, f"G:{a}|{b}", 1)


def _respecified(declared: Declared, body: Json) -> Declared:
    return replace(declared, spec=load_spec(body))


@dataclass(frozen=True)
class _Trial:
    """A declaration fitted coarsely."""

    problem: Problem
    optimum: Optimum
    score: float
    """What it costs in nats; lower is better."""

    @property
    def misfit(self) -> float:
        """Root mean square residual in units of the noise."""
        residual = np.concatenate(self.problem.residuals(self.optimum.fit))
        return float(np.sqrt(np.nanmean((residual / self.problem.noise_K) ** 2)))

    @property
    def parameters(self) -> ParameterSet:
        """The parameters at the end."""
        return self.problem.network.with_values(self.problem.values(self.optimum.unknowns)).parameters


def _fitted(
    variant: Variant, values: dict[str, float], independent: FloatArray | None, rounds: int = ROUNDS
) -> _Trial | None:
    """Return the best of coarse fits: from the balance at the guesses, and from given values if any."""
    problem = variant.undone().problem()
    network = problem.network
    if variant.released in network.parameters.index:
        network = _released(network, variant.released)
        problem = problem.with_network(network)
    begun = balance_starts(problem)[0]
    problem = problem.with_network(network.with_parameters(begun))
    kept = {n: v for n, v in values.items() if n != variant.released}
    starts = [begun] + ([begun.updated(kept)] if kept else [])
    states = problem.start()[problem.n_free :]
    found = [approach(problem, np.concatenate([start.free, states]), rounds=rounds) for start in starts]
    trials = [
        _Trial(problem, o, _score(problem, o, independent, variant.added)) for o in found if o.status != "no_solution"
    ]
    return min(trials, key=lambda t: t.score, default=None)


def _released(network: Network, name: str) -> Network:
    """Return a network one of whose parameters is free, with the flat prior of what nobody guessed."""
    free = tuple(
        replace(p, frozen=False, prior_std=NO_GUESS_LOG_STD if is_logarithmic(p.transform) else p.prior_std)
        if p.name == name
        else p
        for p in network.parameters.parameters
    )
    return network.with_parameters(ParameterSet(free))


def _score(problem: Problem, optimum: Optimum, independent: FloatArray | None, added: int) -> float:
    """Return the cost of a fit in nats: of its misfit, whose size is unknown, of its way from the guesses, and of freedom."""
    residual = np.concatenate(problem.residuals(optimum.fit))
    rms = np.sqrt(np.nanmean((residual / problem.noise_K) ** 2, axis=0))
    counts = _independent(problem, optimum) if independent is None else independent
    mean, std = problem.prior()
    way = (((optimum.unknowns - mean) / std)[: problem.n_free] ** 2).sum()
    freedom = 0.5 * added * np.log(counts.sum())
    return float((counts * np.log(np.maximum(rms, 1.0))).sum() + 0.5 * way + freedom)


def _independent(problem: Problem, optimum: Optimum) -> FloatArray:
    """Return how many readings of each sensor tell something new, (n_sensors,), by the colour of the misfit."""
    residual = np.concatenate(problem.residuals(optimum.fit))
    counts = []
    for column in residual.T:
        seen = float(np.isfinite(column).sum())
        colour = min(max(whiteness(column) or 0.0, 0.0), 1.0)
        counts.append(max(seen * (1.0 - colour) / (1.0 + colour), min(FEWEST_INDEPENDENT, seen)))
    return np.array(counts)


def suspicions(declared: Declared, values: dict[str, float] | None = None, *, deadline: float = NO_DEADLINE) -> Looked:
    """Return the mistakes that would explain a poor fit, and how many of those possible have been looked at.

    A look takes :data:`FIRST_CPU_S` of computing, a closer one at the best :data:`CLOSER_CPU_S`, whatever the network.

    Parameters
    ----------
    declared
        What was declared and recorded.
    values
        Calibrated values; None where the calibration found no solution.
    deadline
        On the clock of ``time.monotonic``: no suspicion is tried afterwards.
    """
    possible = variants(declared)
    base, independent, cost, tried, complete = None, None, np.inf, 0, False
    looked: list[tuple[float, Variant]] = []
    found: list[Suspicion] = []
    with suppress(TimeIsUpError), limited(deadline, FIRST_CPU_S):
        if values is not None:
            base = attempted(partial(_fitted, Variant("", (), "", lambda: declared), values, None), "as declared", [])
        if base is not None:
            independent, cost = _independent(base.problem, base.optimum), base.score
        for variant in possible[:MOST_TRIED]:
            check_time()
            first = attempted(partial(_fitted, variant, {}, independent, QUICK_ROUNDS), variant.words, [])
            tried += 1
            if first is not None:
                looked.append((first.score, variant))
    looked.sort(key=lambda item: item[0])
    with suppress(TimeIsUpError), limited(deadline, CLOSER_CPU_S):
        for _, variant in looked[:MOST_CLOSE]:
            check_time()
            trial = attempted(partial(_fitted, variant, values or {}, independent), variant.words, [])
            if trial is None or not cost - trial.score > LEAST_GAIN_NATS:
                continue
            gain = cost - trial.score if np.isfinite(cost) else -trial.score
            found.append(Suspicion(variant.mistake, variant.where, _told(variant, trial), trial.misfit, gain))
        complete = tried == len(possible)
    return Looked(sorted(found, key=lambda s: -s.gain_nats)[:MOST_TOLD], tried, len(possible), complete)


def _told(variant: Variant, trial: _Trial) -> str:
    """Return the mistake in words, with the value that a released parameter takes."""
    freed = next((p for p in trial.parameters.parameters if p.name == variant.released), None)
    if freed is None:
        return variant.words
    return f"{variant.words}: the data ask for {freed.value:.3g} {freed.unit}".rstrip()


def close_words(
    parameters: ParameterSet,
    guesses: dict[str, float],
    misfit: float,
    found: Sequence[Suspicion],
    told: Sequence[str] = (),
    *,
    complete: bool = True,
    left_out: str = "",
) -> list[str]:
    """Return what is odd about a fit, and what that usually means, most telling first.

    Parameters
    ----------
    parameters
        The calibrated set.
    guesses
        Name -> guess that was stated.
    misfit
        Root mean square residual in units of the noise.
    found
        Of :func:`suspicions`.
    told
        What has been said already.
    complete
        Whether all suspicions have been tried.
    left_out
        What was not looked at, in words.
    """
    far = [p for p in gone_far(parameters, guesses) if not any(f" {p.name};" in line for line in told)]
    said = [f"{p.name} ended {how_far(p, guesses[p.name])}" for p in far]
    if misfit > MANY_NOISES:
        said.append(f"the misfit is {misfit:.3g} times the sensors' noise")
    said += [f"perhaps {s.words}: {_what_it_would_mend(s, misfit)}" for s in found]
    if complete and not found:
        said.append(
            "no single wrong unit, sign, swapped pair, held value or missing coupling explains it: physics is missing, or"
            " several things are wrong at once"
        )
    return [*said, left_out] if left_out else said


def _what_it_would_mend(suspicion: Suspicion, misfit: float) -> str:
    if suspicion.misfit > SAME * misfit:
        return "the parameters would come nearer to their guesses"
    return f"the misfit would be {suspicion.misfit:.3g} times the noise, not {misfit:.3g}"


def is_odd(parameters: ParameterSet, guesses: dict[str, float], misfit: float) -> bool:
    """Return whether a fit is odd enough for suspicions: a parameter far from its guess, or a misfit of many noises."""
    return misfit > MANY_NOISES or bool(gone_far(parameters, guesses))
