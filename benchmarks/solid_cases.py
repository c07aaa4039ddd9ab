"""Cases of the second finite-element world: a spacecraft of solid bodies whose lumped model misses by one to two noises.

The noise of every case is drawn from what the declared network leaves on the healthy record, so that no spacecraft of the
suite is a lumped network in disguise; the size of an effect is found by its trace.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from benchmarks.case import Case, Truth, trace_of
from benchmarks.declared_fit import DeclaredFit, calibrated
from benchmarks.worlds.declaration import declare, true_values
from benchmarks.worlds.hidden import EFFECTS, Draft, Effect, Scene
from benchmarks.worlds.spacecraft import Spacecraft, draw_spacecraft
from twin_core.telemetry import Record

MISFIT_K = (0.008, 0.3)
"""What the declared network may leave on a healthy record; stiffer or softer bodies are drawn until it does."""
MISFIT_OVER_NOISE = (1.0, 2.0)
MEASURED_WITH_K = 0.01
"""Noise of the record on which the misfit is measured: readings without any would count as frozen."""
MOST_TRACE = 30.0
LEAST_OVER_MISFIT = 3.0
LEAST_BEYOND_OVER_MISFIT = 1.5
"""Least trace, over the misfit, of what no change of the declared parameters imitates."""
MOST_PLACES = 5
"""Places tried on one spacecraft; then the next one is drawn."""
REDRAWN = 100_000
MOST_SPACECRAFT = 8
FINER = {"conductance_temperature": 0.4, "capacity_temperature": 0.4}
"""Effects too weak for usual sensors: the misfit that is aimed at, and with it the noise, is scaled by so much."""
GUESSED = (0.4, 4.5)
"""Guesses over the values at which the declared network fits the healthy record best."""
EPOCH_NS = 1_772_323_200 * 10**9


class NotTold(ArithmeticError):
    """No case of this kind can be made of this spacecraft."""


@dataclass(frozen=True)
class Healthy:
    """A spacecraft without effect: what its sensors see, and what the declared network makes of it.

    Attributes
    ----------
    craft
        The spacecraft.
    fine_K : (n_steps + 1, n_nodes)
        Temperatures at the sensors after every step.
    fit
        The declared network calibrated to the training part.
    noise_K, ratio
        Noise of the sensors, and misfit over it.
    """

    craft: Spacecraft
    fine_K: np.ndarray
    fit: DeclaredFit
    noise_K: float
    ratio: float

    @property
    def read_K(self) -> np.ndarray:
        """Temperatures at the sensors at the samples, (n_samples, n_nodes)."""
        return self.fine_K[:: self.craft.per_sample]


@lru_cache(maxsize=2)
def healthy(seed: int, finer: float = 1.0) -> Healthy:
    """Return the spacecraft of a seed; its conductivities are scaled until its misfit is one that sensors have.

    ``finer`` scales the misfit that is aimed at: weak effects show themselves to fine sensors on stiff bodies only.
    """
    rng = np.random.default_rng([seed, 74])
    wanted = finer * float(np.exp(rng.uniform(np.log(0.05), np.log(0.2))))
    stiffness, tried = 10.0 / finer, []
    for _ in range(6):
        craft = draw_spacecraft(seed, stiffness)
        fine = craft.read()
        fit = calibrated(declare(craft, true_values(craft)), _record(craft, fine[:: craft.per_sample], rng))
        misfit = float(np.sqrt(max(fit.misfit_K**2 - MEASURED_WITH_K**2, 0.0)))
        tried.append((stiffness, misfit))
        if MISFIT_K[0] <= misfit <= MISFIT_K[1] * finer:
            ratio = float(rng.uniform(*MISFIT_OVER_NOISE))
            return Healthy(craft, fine, fit, misfit / ratio, ratio)
        stiffness *= float(np.clip(misfit / wanted, 0.2, 6.0))
    raise NotTold(f"seed {seed}: no stiffness gives a usual misfit: {tried}")


def _record(craft: Spacecraft, read_K: np.ndarray, rng: np.random.Generator) -> Record:
    """Return the record with little noise and without gaps."""
    noisy = read_K + rng.normal(0.0, MEASURED_WITH_K, read_K.shape)
    return Record(craft.time_s, _inputs(craft) | {f"T_{n}": noisy[:, i] for i, n in enumerate(craft.nodes)})


def _inputs(craft: Spacecraft) -> dict[str, np.ndarray]:
    """Return the channels that drive the spacecraft, as they are, over the record."""
    series = {**craft.power_W, **craft.auxiliary} | {f"T_{b}": t for b, t in craft.boundaries_K.items()}
    return {channel: column[craft.n_lead :] for channel, column in series.items()}


def solid_case(effect: str | None, seed: int) -> Case:
    """Return a seeded case with one effect hidden in the field; None hides nothing.

    A spacecraft on which no size of the effect can be told, or whose declared network misses too much or too little at any
    stiffness, gives way to the next, with finer sensors.
    """
    for k in range(MOST_SPACECRAFT):
        try:
            return _case(effect, seed + k * REDRAWN, FINER.get(effect or "", 1.0) * 0.6**k)
        except NotTold as error:
            last = error
    raise last


def _case(effect: str | None, seed: int, finer: float) -> Case:
    base = healthy(seed, finer)
    rng = np.random.default_rng([seed, 75, *(effect or "").encode()])
    read_K = base.read_K
    truths: tuple[Truth, ...] = ()
    if effect is not None:
        found, read_K, trace, beyond = _hide(effect, base, rng)
        truths = (Truth(effect, found.where, found.parameters, found.onset_s, trace, beyond),)
    return _telemetry(base, read_K, truths, rng)


def _hide(effect: str, base: Healthy, rng: np.random.Generator) -> tuple[Effect, np.ndarray, float, float]:
    """Return the effect, what the sensors read, its trace, and the part of it that no declared parameter imitates."""
    scene = Scene(rng, base.craft, base.fine_K)
    least = (max(2.0, LEAST_OVER_MISFIT * base.ratio), max(2.0, LEAST_BEYOND_OVER_MISFIT * base.ratio))
    told = []
    for _ in range(MOST_PLACES):
        draft = EFFECTS[effect](scene)
        wanted = float(np.exp(rng.uniform(np.log(1.1 * least[0]), np.log(0.9 * MOST_TRACE))))
        size = float(np.clip(draft.first * np.exp(rng.uniform(-0.7, 0.7)), draft.least, draft.most))
        for trial in range(4):
            try:
                made, read_K = _with(base, draft, size)
            except ArithmeticError:
                break
            moved_K = read_K - base.read_K
            trace, beyond = trace_of(moved_K, base.noise_K), _rms(base.fit.beyond(moved_K)) / base.noise_K
            told.append((made.where, made.parameters, trace, beyond))
            if trace * draft.most / size < 0.5 * least[0]:
                break  # even the largest size would leave too little
            near = trial > 0 or 0.8 < trace / wanted < 1.25
            if near and least[0] <= trace <= MOST_TRACE and beyond >= least[1]:
                return made, read_K, trace, beyond
            wanted = max(wanted, min(1.1 * trace * least[1] / max(beyond, 1e-6), 0.95 * MOST_TRACE))
            scaled = float(np.clip(size * np.clip(wanted / max(trace, 1e-6), 0.05, 20.0), draft.least, draft.most))
            if abs(np.log(scaled / size)) < 0.02:
                break
            size = scaled
    raise NotTold(f"{effect}: no place and size is told by a trace of {least[0]:.1f} to {MOST_TRACE:.0f}: {told}")


def _with(base: Healthy, draft: Draft, size: float) -> tuple[Effect, np.ndarray]:
    """Return an effect of one size, and what the sensors read with it at the samples, (n_samples, n_nodes)."""
    craft, made = base.craft, draft.make(size)
    if made.reading is not None:
        times = np.arange(base.fine_K.shape[0]) * craft.drive.step_s
        return made, made.reading(times, base.fine_K)[:: craft.per_sample]
    drive = craft.drive if made.drive is None else made.drive(craft.drive)
    return made, craft.read(made.acting, drive)[:: craft.per_sample]


def _rms(moved_K: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(moved_K**2)))


def _telemetry(base: Healthy, read_K: np.ndarray, truths: tuple[Truth, ...], rng: np.random.Generator) -> Case:
    """Return the case: readings with noise, quanta and gaps, one node perhaps without sensor, guesses far off."""
    craft, n = base.craft, base.craft.n_samples
    quantum = float(rng.uniform(0.3, 0.9) * np.sqrt(12.0) * base.noise_K) if rng.random() < 0.3 else 0.0
    white = float(np.sqrt(base.noise_K**2 - quantum**2 / 12.0))
    seen = read_K + rng.normal(0.0, white, read_K.shape)
    if quantum:
        seen = quantum * np.round(seen / quantum)
    gaps = int(rng.integers(1, 4)) if rng.random() < 0.3 else 0
    for _ in range(gaps):
        first, length = int(rng.integers(0, n)), int(rng.integers(n // 200 + 2, n // 30 + 3))
        seen[first : first + length] = np.nan
    touched = {str(v) for t in truths for v in np.ravel(list(t.where.values())).tolist()}
    # A node that the network misses more than others stays read: its sensor is where the misfit of the case is seen.
    little = dict(zip(craft.nodes, np.nanmean(base.fit.residual_K**2, axis=0) <= base.fit.misfit_K**2, strict=True))
    loose = [node for node in craft.nodes if little[node] and node not in touched and f"T_{node}" not in touched]
    unread = str(rng.choice(loose)) if loose and rng.random() < 0.3 else None
    values = _inputs(craft)
    boundary_noise = float(rng.uniform(0.02, 0.05)) if rng.random() < 0.5 else 0.0
    for boundary in craft.boundaries_K:
        values[f"T_{boundary}"] = values[f"T_{boundary}"] + rng.normal(0.0, boundary_noise, n)
    values |= {f"T_{node}": seen[:, i] for i, node in enumerate(craft.nodes) if node != unread}
    guesses = {k: _fitted(base, k, v) * _guess(rng) for k, v in true_values(craft).items()}
    epoch = EPOCH_NS if rng.random() < 0.7 else None
    facts = {
        "kind": f"{craft.kind}, {craft.orbit.kind}",
        "misfit_over_noise": base.ratio,
        "quantum_K": quantum,
        "n_gaps": gaps,
        "unread": unread,
        "boundary_noise_K": boundary_noise,
        "sample_s": craft.sample_s,
        "n_vertices": craft.field.n,
        "n_steps": craft.drive.n_steps,
    }
    spec = declare(craft, guesses, unread=unread)
    return Case(spec, Record(craft.time_s, values, epoch, "solid"), truths, read_K, base.noise_K, facts)


def _fitted(base: Healthy, key: str, nominal: float) -> float:
    """Return a parameter at its best for the healthy record, unless the fit has lost it."""
    return float(np.clip(base.fit.values[key], nominal / 3.0, 3.0 * nominal))


def _guess(rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(*np.log(GUESSED))))
