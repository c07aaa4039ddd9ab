"""Which parameters the data can see, in numbers and in words."""

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from twin_core._typing import FloatArray
from twin_core.network.model import Network
from twin_core.network.spec import TwinSpec
from twin_core.parameters.parameter import Parameter
from twin_core.parameters.transforms import FROM_ZERO, Bounded, LogInterval, Shifted, is_logarithmic
from twin_core.parameters.vector import ParameterSet
from twin_core.telemetry import Record

UNSEEN_STD = 1.0
"""A positive parameter whose ln is uncertain by more than this (a factor e) is not told by the data."""

LITTLE_LEARNED = 0.9
"""Nor is one whose uncertainty the data have reduced to no less than this share of its guess's."""

IDENTIFIED_STD = 1.0 / 3.0
"""A parameter whose standard deviation is below this share of its size is identified: signal-to-noise ratio of at least 3."""

NEAR = 1.5
"""A parameter within this factor of its guess is said to stay near it."""

FAR = 10.0
"""Beyond this factor a guess was no guess of the same thing: a prior of a factor e puts less than 3 % there."""

AT_BOUND, PULLED = 0.05, 2.0
"""Share of an interval (in ln) next to a bound that counts as the bound, and standard deviations of its prior by which the data
must have moved a parameter towards it: the prior pulls back as hard as the data pull beyond."""

OFF_LEVEL, MOST_OFF = 0.02, 0.1
"""Share of its range by which a sample lies off a level, and share of samples that may: slews are quick."""

TOGETHER = 0.5
"""Parameters of a weak direction are told together where their estimates are correlated by more than this."""

ANY_FACTOR = 20.0
"""A weak direction whose ln is uncertain by this (a factor 5e8) or more is held by nothing: its width is no measured number."""


def unseen_parameters(parameters: ParameterSet, std: FloatArray) -> list[str]:
    """Return names of free parameters that the data cannot see.

    Parameters
    ----------
    parameters
        The calibrated set.
    std : (n_free,)
        Posterior standard deviations in the solver's coordinate.

    Returns
    -------
    list of str
        Positive parameters uncertain by more than a factor e, others by more than their :func:`_size`, and any whose prior the
        data have hardly narrowed down.
    """
    names = []
    for position, index in enumerate(parameters.free_index):
        parameter = parameters.parameters[index]
        prior = np.inf if parameter.prior_std is None else LITTLE_LEARNED * parameter.prior_std
        slope = parameter.transform.slope(parameter.free)
        own = UNSEEN_STD if is_logarithmic(parameter.transform) else _size(parameter) / slope
        if not std[position] < max(min(own, prior), 1e-12):
            names.append(parameter.name)
    return names


def _size(parameter: Parameter) -> float:
    """Return what the uncertainty of a parameter is measured by, in its own unit: its value, where its zero is nothing at all.

    Kelvin and clocks have no such zero. A temperature is measured by the spread of its prior, a share or a place within an
    interval by that or by its interval, and what the solver counts in steps, such as an onset between two looks for it, by one.
    """
    transform = parameter.transform
    if isinstance(transform, Shifted):
        return transform.scale
    if isinstance(transform, Bounded) and transform.lower >= 0.0:
        widest = min(parameter.prior_std or np.inf, transform.upper - transform.lower)
        if np.isfinite(widest):
            return widest
    return abs(parameter.value)


def identified(parameters: ParameterSet, std: FloatArray) -> dict[str, bool]:
    """Return for each free parameter whether the data tell it to a third of its :func:`_size` or better.

    Parameters
    ----------
    parameters
        The calibrated set.
    std : (n_free,)
        Posterior standard deviations in the solver's coordinate.
    """
    slopes = parameters.slopes(parameters.free)
    sizes = np.array([_size(parameters.parameters[i]) for i in parameters.free_index], dtype=np.float64)
    told = std * slopes < IDENTIFIED_STD * np.maximum(sizes, 1e-300)
    return dict(zip(parameters.free_names, told.tolist(), strict=True))


def weakest_direction(parameters: ParameterSet, covariance: FloatArray) -> str | None:
    """Return in words the combination of free parameters that the data tell least; None if all is well told."""
    logarithmic = [k for k, i in enumerate(parameters.free_index) if is_logarithmic(parameters.parameters[i].transform)]
    if len(logarithmic) < 2:
        return None
    block = covariance[np.ix_(logarithmic, logarithmic)]
    spread, directions = np.linalg.eigh(block)
    if spread[-1] < 0.3**2:
        return None
    weights = directions[:, -1]
    strongest = np.argsort(-np.abs(weights))[:3]
    std = np.sqrt(np.maximum(np.diag(block), 1e-300))
    correlation = np.abs(block / np.outer(std, std)) - np.eye(std.size)
    heavy = [k for k in strongest if abs(weights[k]) > 0.2]
    names = [parameters.free_names[logarithmic[k]] for k in heavy if correlation[k, heavy].max() > TOGETHER]
    if len(names) < 2:  # parameters that the data do not tell at all are said elsewhere, one by one
        return None
    width = float(np.sqrt(spread[-1]))
    factor = f"a factor {np.exp(width):.3g}" if width < ANY_FACTOR else "any factor"
    return f"the data tell {' and '.join(names)} only together: they may move by {factor} as one"


def words(
    parameters: ParameterSet, covariance: FloatArray, guesses: Mapping[str, float] = MappingProxyType({})
) -> list[str]:
    """Return plain statements about what the data cannot see, and how far from its guess each such parameter went.

    Parameters
    ----------
    parameters
        The calibrated set.
    covariance : (n_free, n_free)
        In the solver's coordinate.
    guesses
        Name -> guess that was stated.
    """
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    by_name = {p.name: p for p in parameters.parameters}
    unseen = unseen_parameters(parameters, std)
    declared = {name: by_name[name].at(guess) for name, guess in guesses.items() if name in by_name}
    held = {p.name: told for p in parameters.parameters if (told := _beyond_bound(p, declared.get(p.name)))}
    said = [
        f"the data do not determine {name}; {_whereabouts(by_name[name], guesses.get(name))}"
        for name in unseen
        if name not in held
    ]
    said += held.values()
    direction = weakest_direction(parameters, covariance)
    return said + ([direction] if direction else [])


def distance(parameter: Parameter, guess: float) -> float:
    """Return how far a parameter went from its guess: the factor (at least 1), or for one of either sign the difference."""
    if not is_logarithmic(parameter.transform):
        return abs(parameter.value - guess)
    return float(np.exp(min(abs(np.log(parameter.value / guess)), 700.0)))


def gone_far(parameters: ParameterSet, guesses: Mapping[str, float]) -> list[Parameter]:
    """Return the free positive parameters that ended beyond a factor :data:`FAR` of their stated guess, farthest first."""
    free = [parameters.parameters[i] for i in parameters.free_index]
    told = [p for p in free if p.name in guesses and is_logarithmic(p.transform)]
    far = [p for p in told if distance(p, guesses[p.name]) > FAR]
    return sorted(far, key=lambda p: -distance(p, guesses[p.name]))


def how_far(parameter: Parameter, guess: float) -> str:
    """Return in words how far a parameter went from its guess."""
    size, unit = distance(parameter, guess), f" {parameter.unit}".rstrip()
    way = "above" if parameter.value > guess else "below"
    if is_logarithmic(parameter.transform):
        return f"{size:.3g} times {way} its guess of {guess:.3g}{unit}"
    return f"{size:.3g}{unit} {way} its guess of {guess:.3g}{unit}"


def _beyond_bound(parameter: Parameter, declared: Parameter | None) -> str | None:
    """Return in words that the data pull a parameter beyond the bound at which it ended; None where they do not."""
    if parameter.frozen or parameter.tied_to is not None:
        return None
    transform, unit = parameter.transform, f" {parameter.unit}".rstrip()
    if transform == FROM_ZERO:
        at_zero = parameter.value <= 0.0
        return f"{parameter.name} ends at its bound of 0{unit}; the data pull below it" if at_zero else None
    if not isinstance(transform, LogInterval) or declared is None:
        return None
    share = np.log(parameter.value / transform.lower) / np.log(transform.upper / transform.lower)
    pull = (parameter.free - declared.free) / (parameter.prior_std or np.inf)
    for near, bound, way in (
        (share < AT_BOUND and pull < -PULLED, transform.lower, "below"),
        (share > 1.0 - AT_BOUND and pull > PULLED, transform.upper, "above"),
    ):
        if near:
            return f"{parameter.name} ends at its bound of {bound:.3g}{unit}; the data pull {way} it: widen it if it is not known"
    return None


def _whereabouts(parameter: Parameter, guess: float | None) -> str:
    if (
        isinstance(parameter.transform, LogInterval)
        and np.log(parameter.transform.upper / parameter.transform.lower) < UNSEEN_STD
    ):
        ends = f"{parameter.transform.lower:.3g} to {parameter.transform.upper:.3g} {parameter.unit}".rstrip()
        return f"its bounds of {ends} hold it: widen them if they are not known"
    if guess is None:
        return f"nobody guessed it, and {parameter.value:.3g} {parameter.unit}".rstrip() + " is one value of many"
    near = NEAR if is_logarithmic(parameter.transform) else 0.1 * abs(guess)
    if distance(parameter, guess) <= near:
        return "it stays near its guess"
    return f"it ended {how_far(parameter, guess)}"


def strong_correlations(
    parameters: ParameterSet, covariance: FloatArray, least: float = 0.9, most: int = 5
) -> list[dict[str, Any]]:
    """Return the pairs of free parameters whose estimates are most strongly correlated, the strongest first.

    Parameters
    ----------
    parameters
        The calibrated set.
    covariance : (n_free, n_free)
        In the solver's coordinate.
    least, most
        Smallest correlation that is told, and how many pairs.
    """
    std = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    correlation = np.triu(covariance / np.outer(std, std), k=1)
    first, second = np.nonzero(np.abs(correlation) >= least)
    strongest = np.argsort(-np.abs(correlation[first, second]))[:most]
    names = parameters.free_names
    return [
        {"parameters": [names[first[k]], names[second[k]]], "correlation": float(correlation[first[k], second[k]])}
        for k in strongest
    ]


def unseen_nodes(spec: TwinSpec, joined: Sequence[Sequence[str]] = ()) -> list[str]:
    """Return a statement for every node that no chain of conductors, or of pairs ``joined`` besides, ties to a sensor."""
    pairs = [
        set(pair) for pair in (*(c.between for c in spec.conductors), *(r.between for r in spec.radiation), *joined)
    ]
    nodes = {node.id for node in spec.nodes}
    seen = {node.id for node in spec.nodes if node.sensors}
    for _ in nodes:
        seen |= {end for pair in pairs if pair <= nodes and pair & seen for end in pair}
    return [f"no sensor sees node '{n.id}': all that is said of it is a guess" for n in spec.nodes if n.id not in seen]


def untold_words(network: Network, records: Sequence[Record], positions: Iterable[int]) -> list[str]:
    """Return a statement for every free parameter, by its position among them, to which no reading and no prior answers.

    Most are knots of a table that its channel never comes near.
    """
    said = []
    for position in positions:
        name = network.parameters.free_names[position]
        channel = name.removeprefix("table:").partition("|")[0]
        seen = [r.values[channel] for r in records if name.startswith("table:") and channel in r.values]
        samples = np.concatenate([x[np.isfinite(x)] for x in seen] or [np.zeros(0)])
        why = "no reading answers to it"
        if samples.size:
            why = f"channel '{channel}' stays between {samples.min():.4g} and {samples.max():.4g} and never comes near that knot"
        said.append(f"the data do not determine {name}: {why}; leave it out, or calibrate on telemetry that gets there")
    return said


def blurred_levels(network: Network, records: Sequence[Record]) -> list[str]:
    """Return a statement for every channel that is declared with levels but mostly rests at none that was found."""
    said = []
    for channel, levels in {channel: knots for (channel, _), knots in network.layout.table_knots.items()}.items():
        samples = np.concatenate([r.values[channel] for r in records if channel in r.values] or [np.zeros(0)])
        samples = samples[np.isfinite(samples)]
        if samples.size == 0 or not levels:
            continue
        off = np.abs(samples[:, None] - np.array(levels)).min(axis=1) > OFF_LEVEL * np.ptp(samples)
        if off.mean() > MOST_OFF:
            said.append(
                f"channel '{channel}' is declared with levels, but {off.mean():.0%} of its samples lie at none of the "
                f"{len(levels)} that were found: if it changes continuously, declare knots instead"
            )
    return said


def resting_channels(spec: TwinSpec, records: Sequence[Record]) -> list[str]:
    """Return a statement for every sensor and input that never changes, and one where no power is recorded."""
    said = nothing_is_heated(spec, records)
    for name in resting([*spec.sensors, *dict.fromkeys(load.channel for load in spec.loads)], records):
        meaning = (
            "what rests tells nothing of capacities, and no effect is looked for beside it; if the sensor is stuck, take it out"
            if name in spec.sensors
            else "the record cannot tell its heat, if any, from other steady heat where it acts"
        )
        said.append(f"channel '{name}' never changes: {meaning}")
    return said


def resting(names: Iterable[str], records: Sequence[Record]) -> list[str]:
    """Return the channels that have samples and never change."""
    found = []
    for name in names:
        parts = [r.values[name][np.isfinite(r.values[name])] for r in records if name in r.values]
        samples = np.concatenate(parts) if parts else np.zeros(0)
        if samples.size and np.ptp(samples) == 0.0:
            found.append(name)
    return found


def nothing_is_heated(spec: TwinSpec, records: Sequence[Record]) -> list[str]:
    """Return in words that every power is zero throughout, where nothing else heats: what else seems wrong may come of that."""
    names = list(dict.fromkeys(load.channel for load in spec.loads))
    of_powers = all(name in spec.channels and spec.channels[name].kind == "power" for name in names)
    columns = [record.values.get(name) for record in records for name in names]
    if not columns or not of_powers or any(column is None or np.nan_to_num(column).any() for column in columns):
        return []
    channels = f"power channel '{names[0]}' is" if len(names) == 1 else f"all power channels ({', '.join(names)}) are"
    return [f"{channels} zero throughout: before anything else is believed, check whether powers were recorded"]


def nothing_moves(spec: TwinSpec, records: Sequence[Record]) -> bool:
    """Return whether no sensor ever changes: all are stuck or at rest, and no fit to them means anything."""
    return len(resting(spec.sensors, records)) == len(spec.sensors)
