"""Screening: the linear response of the sensors to every candidate against rollouts with a little of it in place."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.helpers import every_term_network
from twin_core.calibrate.problem import Problem, build_problem
from twin_core.calibrate.undeclared.model import HeatFit, UndeclaredHeat, linearise
from twin_core.discover import screen as screening_module
from twin_core.discover.metric import beside_heat
from twin_core.discover.screen import (
    projected_responses,
    responses,
    screen,
    screen_sizes,
    survey_of,
)
from twin_core.effects import REGISTRY, Effect, Survey
from twin_core.network.model import build_network
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

N_TIMES = 60


def orbit(start_s: float, seed: int) -> Record:
    rng = np.random.default_rng(seed)
    time_s = start_s + 90.0 * np.arange(N_TIMES)
    values = {
        "T_room": 290.0 + 3.0 * np.sin(time_s / 800.0),
        "Q_a": np.repeat(rng.choice([5.0, 40.0, 80.0], N_TIMES // 5), 5),
        "Q_sun": 60.0 * np.maximum(np.sin(time_s / 900.0), 0.0),
        "H": np.repeat(rng.uniform(0.0, 100.0, N_TIMES // 6), 6),
        "pitch": 90.0 + 40.0 * np.sin(time_s / 2000.0),
        "mode": np.repeat(rng.integers(0, 3, N_TIMES // 5), 5).astype(float),
        "T_a": 280.0 + rng.normal(0.0, 0.1, N_TIMES),
        "T_b": 285.0 + rng.normal(0.0, 0.1, N_TIMES),
    }
    return Record(time_s, values, epoch_ns=1_700_000_000_000_000_000)


def problem() -> Problem:
    """Two segments of a network with every term, whose readings are its own rollouts with noise."""
    p = build_problem(every_term_network(), [orbit(0.0, 1), orbit(1e5, 2)], np.full(2, 0.1), 30.0)
    rng = np.random.default_rng(3)
    read = [clean + rng.normal(0.0, 0.1, clean.shape) for clean in p.solve(p.start()).predicted_K]
    return replace(p, segments=tuple(replace(s, measured_K=r) for s, r in zip(p.segments, read, strict=True)))


def fit_of(p: Problem) -> HeatFit:
    """Return the problem linearised about its own rollouts, with a little undeclared heat."""
    values = p.network.parameters.values
    nominals = []
    for segment in p.segments:
        path = rollout(p.network, values, segment.start_prior_K, segment.forcing)
        states = np.vstack([path.start_K, path.stages_K[:, 1]])
        nominals.append(linearise(p, values, segment, states, np.zeros((segment.forcing.n_steps, p.n_nodes))))
    return HeatFit(p, p.network.parameters.free, UndeclaredHeat(np.full(3, 0.5), 600.0), tuple(nominals), 0.0)


def readings_with(p: Problem, effects: list[Effect]) -> list[np.ndarray]:
    network = build_network(p.network.spec, effects, table_knots=p.network.layout.table_knots)
    network = network.with_parameters(network.parameters.updated(p.network.parameters.as_dict()))
    extended = p.with_network(network)
    found = []
    for before, after in zip(p.segments, extended.segments, strict=True):
        start = np.concatenate([before.start_prior_K, after.start_prior_K[len(before.start_prior_K) :]])
        path = rollout(network, network.parameters.values, start, before.forcing)
        read = path.at_samples(before.forcing.sample_step)[:, network.sensor_node]
        for term in network.readings:
            part = term.evaluate(before.record.clock_s, network.parameters.values[network.term_index(term)])
            read[:, part.sensor] += part.offset_K
        found.append(read)
    return found


def read_with(p: Problem, effect: Effect) -> Problem:
    """Return a problem whose readings hold an effect too."""
    read = [
        after + s.measured_K - before
        for after, before, s in zip(readings_with(p, [effect]), readings_with(p, []), p.segments, strict=True)
    ]
    return replace(p, segments=tuple(replace(s, measured_K=r) for s, r in zip(p.segments, read, strict=True)))


APPROXIMATE = {"hidden_mass": 0.05}
"""A mass is screened as the lag of its node from the first stage on, not from the start itself."""
LINEAR = [name for name in REGISTRY if name not in ("sensor_lag", "boundary_lag")]  # a lag is screened at its own size


@pytest.mark.parametrize("name", LINEAR)
def test_responses_are_those_of_the_network_with_the_effect(name: str) -> None:
    p = problem()
    fit = fit_of(p)
    survey = survey_of(fit)
    kind = REGISTRY[name]
    starts = (list(kind.starts(where, survey)) for where in kind.places(survey.layout))
    effect = next(found for found in starts if found)[-1]
    columns = list(zip(effect.unit_heats(survey), effect.unit_readings(survey), strict=True))
    found = responses(fit, survey, columns)
    plain = readings_with(p, [])
    for k in range(len(effect.amplitudes)):
        step = min(1e-4, 0.05 / max(float(np.abs(block[:, :, k]).max()) for block in found))
        little = np.full(len(effect.amplitudes), 1e-9)
        little[k] = step
        moved = effect.with_amplitudes(little)
        if moved is None:  # it cannot move alone: all move together
            little[:] = step
            moved = effect.with_amplitudes(little)
        assert moved is not None
        for segment, (after, before) in enumerate(zip(readings_with(p, [moved]), plain, strict=True)):
            expected = (after - before) / step
            scale = max(float(np.abs(expected).max()), 1e-3)
            # A first difference is off by its share of the curvature.
            tolerance = APPROXIMATE.get(name, 2e-3)
            np.testing.assert_allclose(found[segment] @ (little / step), expected, atol=tolerance * scale)


def test_a_late_reading_is_the_lag_of_its_node() -> None:
    p = problem()
    fit = fit_of(p)
    survey = survey_of(fit)
    for effect in REGISTRY["sensor_lag"].starts({"sensor": "T_a"}, survey):
        (block, _) = responses(
            fit, survey, list(zip(effect.unit_heats(survey), effect.unit_readings(survey), strict=True))
        )
        tau = effect.settings["start_s"]
        moved = effect.with_amplitudes(np.array([tau]))
        assert moved is not None
        change = readings_with(p, [moved])[0] - readings_with(p, [])[0]
        scale = float(np.abs(change).max())
        np.testing.assert_allclose(tau * block[5:, :, 0], change[5:], atol=0.1 * scale)


def test_a_lag_starts_at_a_length_that_its_response_can_have() -> None:
    """The change per second of a short lag, scaled to a long one, told of 275 s in place of 19 s."""
    p = problem()
    lag = REGISTRY["sensor_lag"]({"sensor": "T_a"}, {"tau_s": 900.0})
    fit = fit_of(read_with(p, lag))
    survey = survey_of(fit)
    starts = list(REGISTRY["sensor_lag"].starts({"sensor": "T_a"}, survey))
    probes = screen(fit, survey, starts).probes
    found, residual = projected_responses(fit, survey, [probe.start for probe in probes])
    assert probes[0].effect.values["tau_s"] == pytest.approx(900.0, rel=0.4)
    scaled = 0
    for probe, response in zip(probes, found, strict=True):
        tau_s = probe.effect.values["tau_s"]
        assert tau_s <= 2.0 * probe.start.settings["start_s"] * (1.0 + 1e-12)
        left = residual - response[:, 0] * tau_s  # the gain is what the lag gains at that length
        assert probe.gain == pytest.approx(0.5 * float(residual @ residual - left @ left), rel=1e-6)
        scaled += np.linalg.lstsq(response, residual, rcond=None)[0][0] > tau_s * 1.001
    assert scaled


def test_a_late_sink_is_the_lag_of_its_channel() -> None:
    p = problem()
    fit = fit_of(p)
    survey = survey_of(fit)
    for effect in REGISTRY["boundary_lag"].starts({"boundary": "room"}, survey):
        (block, _) = responses(fit, survey, [(effect.unit_heats(survey)[0], [])])
        tau = effect.settings["start_s"]
        moved = effect.with_amplitudes(np.array([tau]))
        assert moved is not None
        change = readings_with(p, [moved])[0] - readings_with(p, [])[0]
        scale = float(np.abs(change).max())
        np.testing.assert_allclose(tau * block[:, :, 0], change, atol=0.05 * scale)


def test_the_residual_is_projected_off_what_parameters_can_mimic() -> None:
    fit = fit_of(problem())
    metric = beside_heat(fit)
    basis, residual = metric.basis, metric.residual
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-9)
    np.testing.assert_allclose(basis.T @ residual, 0.0, atol=1e-9)


def test_the_gain_is_that_of_least_squares() -> None:
    """What a candidate adds to the log-likelihood: half the fall of the squared residual when it joins the parameters."""
    p = problem()
    truth = REGISTRY["input_gain"]({"channel": "Q_a"}, {"g": 1.3})
    fit = fit_of(read_with(p, truth))
    survey = survey_of(fit)
    candidates = [
        REGISTRY["input_gain"]({"channel": "Q_sun"}, {"g": 1.0}),
        REGISTRY["input_gain"]({"channel": "Q_a"}, {"g": 1.0}),
        REGISTRY["leak_to_boundary"]({"node": "a", "boundary": "room"}, {"G_W_per_K": 0.0}),
        REGISTRY["missing_conductor"]({"nodes": ["a", "c"]}, {"G_W_per_K": 0.0}),
    ]
    screening = screen(fit, survey, candidates)
    metric = beside_heat(fit)
    basis, residual = metric.basis, metric.residual
    assert screening.n_tried == 4
    assert screening.probes[0].effect.where == {"channel": "Q_a"}
    assert screening.probes[0].effect.values["g"] == pytest.approx(1.3, abs=0.1)
    found, same_residual = projected_responses(fit, survey, [probe.start for probe in screening.probes])
    np.testing.assert_array_equal(same_residual, residual)
    for probe, response in zip(screening.probes, found, strict=True):
        amount, *_ = np.linalg.lstsq(response, residual, rcond=None)
        left = residual - response @ amount
        assert probe.gain == pytest.approx(0.5 * float(residual @ residual - left @ left), rel=1e-6)
        np.testing.assert_allclose(basis.T @ response, 0.0, atol=1e-8 * np.abs(response).max())
    gains = [probe.gain for probe in screening.probes]
    assert gains == sorted(gains, reverse=True)


def test_nothing_to_screen_is_no_error() -> None:
    fit = fit_of(problem())
    assert screen(fit, survey_of(fit), []).probes == ()


def test_a_long_record_is_screened_in_portions_with_the_same_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """No more columns at once than fit into memory, but for an effect that has more of its own; nothing else changes."""
    fit = fit_of(problem())
    survey = survey_of(fit)
    effects = [
        e for kind in REGISTRY.values() for where in kind.places(survey.layout) for e in kind.starts(where, survey)
    ]
    at_once: list[int] = []

    def counted(fit: HeatFit, survey: Survey, columns: Sequence[Any]) -> list[np.ndarray]:
        at_once.append(len(columns))
        return responses(fit, survey, columns)

    monkeypatch.setattr(screening_module, "responses", counted)
    whole = screen_sizes(fit, (1.0, 0.1), survey, effects)
    n_rows = sum(n.segment.measured_K.size for n in fit.nominals)
    at_once.clear()
    monkeypatch.setattr(screening_module, "VALUES_AT_ONCE", 7.5 * n_rows)
    parts = screen_sizes(fit, (1.0, 0.1), survey, iter(effects))
    assert max(at_once) <= max(7, max(len(e.amplitudes) for e in effects)) and len(at_once) > len(effects) / 8
    for one, other in zip(whole, parts, strict=True):
        assert one.n_tried == other.n_tried == len(effects)
        gains = {id(p.start): p.gain for p in other.probes}
        assert len(gains) == len(one.probes)
        for probe in one.probes:
            assert gains[id(probe.start)] == pytest.approx(probe.gain, rel=1e-9, abs=1e-9)


def test_a_response_that_is_no_number_leaves_out_its_candidate_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    fit = fit_of(problem())
    survey = survey_of(fit)
    candidates = [REGISTRY["leak_to_boundary"]({"node": n, "boundary": "room"}, {"G_W_per_K": 0.0}) for n in "abc"]
    sound = {probe.start.label: probe.gain for probe in screen(fit, survey, candidates[1:]).probes}

    def overflowing(*arguments: Any) -> list[np.ndarray]:
        blocks = responses(*arguments)
        for block in blocks:
            block[5, :, 0] = np.inf
        return blocks

    monkeypatch.setattr(screening_module, "responses", overflowing)
    with np.errstate(invalid="ignore"):
        found = {probe.start.label: probe.gain for probe in screen(fit, survey, candidates).probes}
    assert found == pytest.approx(sound)
