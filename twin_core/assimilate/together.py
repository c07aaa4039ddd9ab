"""Many twins filtered together: what the filter of one twin does to each of them, at a fraction of the cost.

Where twins are of one design, what drives them is read from their telemetry together; where they have as many nodes and
steps, they go through one compiled loop whose innermost index is the twin; where they agree in network, sampling, mask and
covariance, their gains are computed once. What this does not cover (a first sample, a long gap, a relay, a balance that is
neither linear nor of fourth degree) is left to the filter of one twin.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import NamedTuple

import numpy as np

from twin_core._typing import FloatArray, IntArray, Json
from twin_core.assimilate import Assimilation, assimilate, process_noise_K2_per_s, readings_of
from twin_core.assimilate.lanes import Lanes, run
from twin_core.calibrate.result import CalibratedModel
from twin_core.constants import ZERO_CELSIUS_K
from twin_core.effects import effect_to_json
from twin_core.network.dynamics import fill_boundaries
from twin_core.network.model import Network
from twin_core.network.spec_io import dump_spec
from twin_core.network.surroundings import surround
from twin_core.network.terms import (
    Along,
    BoundaryConductor,
    ChannelLoad,
    Conductors,
    NodeRadiation,
    SinkRadiation,
    TableLoad,
)
from twin_core.simulate.forcing import Forcing, build_forcing
from twin_core.simulate.modes import Modes
from twin_core.simulate.rollout import LIMIT_K
from twin_core.simulate.splitting import STRETCH, Couplings, anchor_K, couplings, modes_of, symmetric
from twin_core.telemetry import GAP_STEPS, Record

PROPORTIONAL = (BoundaryConductor, ChannelLoad, Conductors, NodeRadiation, SinkRadiation, TableLoad)
"""Terms whose heat is the sum of their values times what the values do not change: one evaluation serves all siblings."""

CHUNK = 64
"""So many covariances go through the compiled loop at once: one matrix of nine nodes each takes 41 kB, the scratch stays in the
second-level cache."""
MOST_KNOWN = 64
"""So many linearisations and sampling intervals are remembered of each twin: some 100 kB at nine nodes."""
DIGITS = 13
"""Decimal digits of the largest element. Covariances that agree to so many are one: a filter that has settled still moves by the
last two or three of a double. The gains then agree to 1e-13, means to some 1e-12 K, of the 1e-9 K that are promised."""


@dataclass(frozen=True)
class Member:
    """A model made ready for the filter of many.

    Attributes
    ----------
    model, network
        Whose it is.
    values, own_J_per_K
        Its parameters (n_parameters,) and the capacities (n_nodes,).
    parts
        What is linear in T and T⁴; None where the balance has other parts.
    design
        What members share whose drives may be read together; empty where each is read alone.
    kind
        What members share whose covariances are the same, given the same sampling.
    """

    model: CalibratedModel
    network: Network
    values: FloatArray
    own_J_per_K: FloatArray
    parts: Couplings | None
    design: str
    kind: bytes
    _modes: dict[bytes, tuple[Modes, FloatArray]] = field(default_factory=dict, repr=False)
    _density: dict[float, FloatArray] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, model: CalibratedModel) -> "Member":
        """Make a model ready."""
        network = model.network()
        values = network.parameters.values
        own = values[network.capacity_index]
        try:
            parts = None if network.capacities else couplings(network, values, _somewhere(network))
        except Exception:  # a term that cannot be evaluated just anywhere is left to the filter of one twin
            parts = None
        if parts is None or parts.relays or parts.others:
            return cls(model, network, values, own, None, "", b"")
        parts = replace(parts, heat_W=np.zeros((0, own.size)))
        per_sensor = [[model.noise_K[s], model.misfit_K[s], model.misfit_length_s[s]] for s in model.spec.sensors]
        numbers = (own, parts.linear_W_per_K, parts.fourth_W_per_K4, np.array(per_sensor), network.sensor_node)
        return cls(model, network, values, own, parts, _design(model), b"".join(x.tobytes() for x in numbers))

    @property
    def is_linear(self) -> bool:
        """Whether nothing of the balance is of fourth degree, and none of it one-sided."""
        assert self.parts is not None
        slope = self.parts.linear_W_per_K
        return not self.parts.fourth_W_per_K4.any() and bool(np.array_equal(slope, slope.T))

    def density_K2_per_s(self, record: Record) -> FloatArray:
        """Return the process noise at the sampling of a record, (n_nodes,)."""
        sampling_s = float(np.median(np.diff(record.time_s)))
        if sampling_s not in self._density:
            if len(self._density) >= MOST_KNOWN:
                self._density.clear()
            self._density[sampling_s] = process_noise_K2_per_s(self.model, self.network, sampling_s)
        return self._density[sampling_s]

    def modes(self, state_K: FloatArray) -> tuple[Modes, FloatArray]:
        """Return the modes of A about a state (n_nodes,), and the linear rates beside it, (n_nodes, n_nodes)."""
        assert self.parts is not None
        about_K = anchor_K(state_K, None)
        key = b"" if self.is_linear else about_K.tobytes()
        if key not in self._modes:
            if len(self._modes) >= MOST_KNOWN:
                self._modes.clear()
            slope = symmetric(self.parts.slope_W_per_K(about_K))
            beside = (self.parts.linear_W_per_K - slope) / self.own_J_per_K[:, None]
            self._modes[key] = modes_of(slope, self.own_J_per_K), beside
        return self._modes[key]


class Question(NamedTuple):
    """A stretch of a twin's telemetry to be filtered from a state, see ``assimilate``."""

    member: Member
    record: Record
    state: Json | None


def assimilate_together(questions: Sequence[Question]) -> list[Assimilation | Exception]:
    """Filter a stretch of telemetry of each of many twins.

    Parameters
    ----------
    questions
        Whose, which and from where; those of one design may hold different numbers of samples at different instants.

    Returns
    -------
    list
        For each question what ``assimilate`` returns, to 1e-9 K, or the error that it raises.
    """
    found: list[Assimilation | Exception | None] = [None] * len(questions)
    fit = [k for k, question in enumerate(questions) if _fits(question)]
    driven = [(k, drive) for group in _by_design(questions, fit) for k, drive in group]
    driven.sort(key=lambda one: one[1].shape)
    for _, same in groupby(driven, key=lambda one: one[1].shape):
        for chunk in _chunks([(k, questions[k], drive) for k, drive in same]):
            for k, done in chunk.filtered():
                found[k] = done
    return [_alone(question) if done is None else done for question, done in zip(questions, found, strict=True)]


def _alone(question: Question) -> Assimilation | Exception:
    try:
        return assimilate(question.member.model, question.record, question.state)
    except Exception as error:  # one twin's telemetry is no concern of the others
        return error


def _somewhere(network: Network) -> Along:
    """Return two points at which the couplings can be told: these hold at any input and any temperature."""
    spec, two = network.spec, np.ones(2)
    channels = (*spec.channels, *spec.orbit_channels, *spec.derived)
    nowhere = np.full((2, len(network.layout.boundaries)), ZERO_CELSIUS_K)
    state = np.full((2, len(network.nodes)), ZERO_CELSIUS_K)
    return Along(np.zeros(2), state, nowhere, dict.fromkeys(channels, two), two, derivatives=False)


def _design(model: CalibratedModel) -> str:
    """Return what siblings have in common; empty where time itself, or a term of another kind, drives the network."""
    spec, network = model.spec, model.network()
    by_date = spec.orbit_channels or spec.derived or spec.exclude or any(load.solar for load in spec.loads)
    changed = network.boundary_terms or network.readings or network.dated is not None
    if by_date or changed or not all(isinstance(term, PROPORTIONAL) for term in network.terms):
        return ""
    shape = {name: part for name, part in dump_spec(spec).items() if name != "twin"}
    knots = sorted((*place, *levels) for place, levels in model.table_knots.items())
    return json.dumps([shape, [effect_to_json(e) for e in model.effects], knots, model.max_step_s], sort_keys=True)


def _fits(question: Question) -> bool:
    """Whether a question goes on from a known state without a gap, over not too many steps."""
    member, record, state = question
    if member.parts is None or state is None or state["nodes"] != list(member.network.nodes) or record.time_s.size < 2:
        return False
    interval_s, most_s = np.diff(record.time_s), member.model.max_step_s
    return bool(interval_s.max() <= GAP_STEPS * most_s and np.ceil(interval_s / most_s).sum() <= STRETCH)


@dataclass(frozen=True)
class _Drive:
    """What drives one twin over its stretch.

    ``given_K_per_s`` (n_steps, 2, n_nodes), ``reading_K`` (n_times, n_sensors), ``at`` (n_times,): steps before each sample.
    """

    step_s: FloatArray
    given_K_per_s: FloatArray
    reading_K: FloatArray
    at: IntArray
    is_linear: bool
    node: tuple[int, ...]

    @property
    def shape(self) -> tuple[object, ...]:
        """What twins share that go through the loop together."""
        return (*self.given_K_per_s.shape, self.is_linear, self.node)


def _by_design(questions: Sequence[Question], fit: Sequence[int]) -> Iterable[list[tuple[int, _Drive]]]:
    """Yield the drives of the questions that fit, those of one design together."""
    keys = {k: _company(questions[k]) for k in fit}
    for key, group in groupby(sorted(fit, key=lambda k: keys[k]), key=lambda k: keys[k]):
        for together in [list(group)] if key[0] else [[k] for k in group]:
            try:
                yield list(zip(together, _drives([questions[k] for k in together]), strict=True))
            except Exception:  # some record lacks what its model needs: the filter of one twin says which, and what
                continue


def _company(question: Question) -> tuple[str, tuple[str, ...], bool]:
    """Return what stretches share that may be read as one record: every channel is known where each of them begins, and
    where it ends if it is linear in between."""
    member, record, _ = question
    channels, boundaries = member.model.spec.channels, member.model.spec.boundaries.values()
    driving = tuple(sorted(c for c in record.values if c in channels and channels[c].kind != "temperature"))
    driving += tuple(boundary.channel for boundary in boundaries if boundary.channel is not None)
    is_known = all(
        name in record.values
        and bool(np.isfinite(record.values[name][0]))
        and (channels[name].is_held or bool(np.isfinite(record.values[name][-1])))
        for name in driving
    )
    return (member.design if is_known else "", driving, record.epoch_ns is None)


def _drives(questions: Sequence[Question]) -> list[_Drive]:
    """Return what drives twins of one design: their records are read as one, a step apart, and cut again."""
    members, records = [q.member for q in questions], [q.record for q in questions]
    first = members[0]
    most_s, network = first.model.max_step_s, first.network
    sizes = np.array([record.time_s.size for record in records])
    stops = np.cumsum(sizes)
    if len(questions) == 1:
        joined = records[0]
    else:
        lengths = np.array([record.time_s[-1] - record.time_s[0] for record in records])
        begins = np.cumsum(lengths + most_s) - (lengths + most_s)
        time_s = np.concatenate([r.time_s - r.time_s[0] + b for r, b in zip(records, begins, strict=True)])
        names = records[0].values.keys() & set.intersection(*(set(r.values) for r in records))
        names |= {s for s in first.model.spec.sensors if any(s in r.values for r in records)}
        values = {name: np.concatenate([_column(r, name) for r in records]) for name in names}
        joined = Record(time_s, values, records[0].epoch_ns, "several twins")
    forcing = build_forcing(network, joined, most_s)
    at = forcing.sample_step
    readings = np.split(readings_of(first.model, network, joined), stops[:-1])
    owner = np.repeat(np.arange(len(records)), sizes)[np.searchsorted(at, np.arange(forcing.n_steps), side="right") - 1]
    given = _given_K_per_s(members, forcing, owner)
    drives = []
    for k, (member, record, reading) in enumerate(zip(members, records, readings, strict=True)):
        own = at[stops[k] - sizes[k] : stops[k]]
        steps = slice(own[0], own[-1])
        reading = reading.copy()
        reading[0] = np.nan  # the state knows this sample already
        # Differences of shifted instants are rounded otherwise than those of a record's own.
        counts = np.diff(own)
        step_s = np.repeat(np.diff(record.time_s) / counts, counts)
        node = tuple(member.network.sensor_node.tolist())
        drives.append(_Drive(step_s, given[steps], reading, own - own[0], member.is_linear, node))
    return drives


def _column(record: Record, name: str) -> FloatArray:
    return record.values[name] if name in record.values else np.full(record.time_s.size, np.nan)


def _given_K_per_s(members: Sequence[Member], forcing: Forcing, owner: IntArray) -> FloatArray:
    """Return the rates that no temperature changes, (n_steps, 2, n_nodes), for the owner (n_steps,) of each step."""
    first, n_points = members[0], 2 * forcing.n_steps
    network, n_nodes = first.network, len(first.network.nodes)
    values = np.stack([member.values for member in members])
    of_point = np.repeat(owner, 2)
    boundaries = fill_boundaries(network, first.values, forcing.boundaries_flat_K(0, forcing.n_steps))
    for column, index in enumerate(network.boundary_index):
        if index >= 0:
            boundaries[:, column] = values[of_point, index]
    about = np.full((n_points, n_nodes), ZERO_CELSIUS_K)
    is_shared = len(members) > 1
    along = replace(forcing.along(about, boundaries, 0, forcing.n_steps), derivatives=is_shared)
    heat = np.zeros((n_points, n_nodes))
    seen = surround(network, first.values, along).along
    for term, index in zip(network.terms, network.term_indices, strict=True):
        part = term.evaluate(seen, first.values[index])
        if is_shared:
            for entry in part.d_values:
                heat[:, entry.node] += values[of_point, index[entry.item]] * entry.series
        else:
            heat[:, list(part.nodes)] += part.heat_W
    own, held = np.stack([m.own_J_per_K for m in members]), np.empty((len(members), n_nodes))
    for k, member in enumerate(members):
        assert member.parts is not None
        held[k] = member.parts.linear_W_per_K @ about[0] + member.parts.fourth_W_per_K4 @ about[0] ** 4
    return ((heat - held[of_point]) / own[of_point]).reshape(forcing.n_steps, 2, n_nodes)


@dataclass(frozen=True)
class _Chunk:
    """Twins of one shape, ``leader`` (n_twins,) saying whose covariance is theirs."""

    twins: list[tuple[int, Question, _Drive]]
    leader: IntArray

    def filtered(self) -> Iterable[tuple[int, Assimilation]]:
        """Yield what becomes of each twin that the loop can follow."""
        drives = [drive for _, _, drive in self.twins]
        states = [question.state or {} for _, question, _ in self.twins]
        members = [question.member for _, question, _ in self.twins]
        n_nodes, is_linear = len(members[0].network.nodes), drives[0].is_linear
        twin = np.flatnonzero(np.diff(self.leader, prepend=-1))
        means = [np.array(state["mean_K"], dtype=np.float64) for state in states]
        modes = [member.modes(mean) for member, mean in zip(members, means, strict=True)]
        n_steps, n_sensors = drives[0].step_s.size, len(drives[0].node)
        reading = np.full((n_steps + 1, n_sensors, len(drives)), np.nan)
        for b, drive in enumerate(drives):
            reading[drive.at, :, b] = drive.reading_K
        scaled = [(member.parts, member.own_J_per_K) for member in members]
        density = [members[b].density_K2_per_s(self.twins[b][1].record) for b in twin]
        lanes = Lanes(
            _lanes([drive.step_s for drive in drives]),
            _lanes([mode.rate_per_s for mode, _ in modes]),
            _lanes([mode.outward for mode, _ in modes]),
            _lanes([mode.inward for mode, _ in modes]),
            _lanes([beside for _, beside in modes]),
            _lanes([parts.fourth_W_per_K4 / own[:, None] for parts, own in scaled if parts is not None]),
            _lanes([drive.given_K_per_s for drive in drives]),
            _lanes(means),
            self.leader,
            twin,
            _lanes([_covariance(states[b], n_nodes) for b in twin]),
            _lanes(density),
            _lanes([members[b].model.noise_vector_K() ** 2 for b in twin]),
            np.array(drives[0].node, dtype=np.int64),
            reading[1:],
        )
        first_std = np.stack(
            [np.sqrt(lanes.covariance_K2[node, node] + lanes.noise_K2[s]) for s, node in enumerate(lanes.node)]
        )
        innovation, deviation, nis, left = run(lanes, is_linear, *LIMIT_K)
        means_after = np.ascontiguousarray(lanes.mean_K.T)
        covariances = np.ascontiguousarray(lanes.covariance_K2.transpose(2, 0, 1))
        for b, (k, question, drive) in enumerate(self.twins):
            covariance = covariances[self.leader[b]]
            if left[b] or not (np.isfinite(means_after[b]).all() and np.isfinite(covariance).all()):
                continue
            after = drive.at[1:] - 1
            yield (
                k,
                Assimilation(
                    question.record.time_s,
                    question.member.model.spec.sensors,
                    np.concatenate([np.full((1, n_sensors), np.nan), innovation[after, :, b]]),
                    np.concatenate([first_std[None, :, self.leader[b]], deviation[after, :, self.leader[b]]]),
                    np.concatenate([[np.nan], nis[after, b]]),
                    question.member.network.nodes,
                    means_after[b],
                    covariance.copy(),
                ),
            )


def _chunks(twins: Sequence[tuple[int, Question, _Drive]]) -> Iterable[_Chunk]:
    """Yield chunks of twins of one shape, each with all that follow one of its leaders."""
    if not twins[0][2].is_linear:  # every transition is that of a state of its own
        for start in range(0, len(twins), CHUNK):
            part = list(twins[start : start + CHUNK])
            yield _Chunk(part, np.arange(len(part)))
        return
    keys = [_gains(question, drive) for _, question, drive in twins]
    order = sorted(range(len(twins)), key=lambda b: keys[b])
    groups = [list(group) for _, group in groupby(order, key=lambda b: keys[b])]
    for start in range(0, len(groups), CHUNK):
        led = groups[start : start + CHUNK]
        leader = np.repeat(np.arange(len(led)), [len(group) for group in led])
        yield _Chunk([twins[b] for group in led for b in group], leader)


def _gains(question: Question, drive: _Drive) -> bytes:
    """Return what twins share whose gains are the same: network, sampling, mask and covariance."""
    covariance = _covariance(question.state or {}, len(question.member.network.nodes))
    rounded = np.round(covariance / np.abs(covariance).max(), DIGITS)
    mask = np.isnan(drive.reading_K)
    return question.member.kind + b"".join(x.tobytes() for x in (drive.step_s, drive.at, mask, rounded))


def _covariance(state: Json, n_nodes: int) -> FloatArray:
    return np.array(state["covariance_K2"], dtype=np.float64).reshape(n_nodes, n_nodes)


def _lanes(rows: Sequence[FloatArray]) -> FloatArray:
    """Return arrays of one shape as one array whose last index is theirs."""
    return np.ascontiguousarray(np.moveaxis(np.stack(rows), 0, -1))
