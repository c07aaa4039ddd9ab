"""A family against the marginal likelihood maximised by brute force, and on models whose truth is known."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from twin_core.calibrate import CalibratedModel, calibrate
from twin_core.errors import ModelError
from twin_core.family import declared, pool
from twin_core.family.pool import _mean, _population, _posterior
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.telemetry_csv import read_csv


def draws(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return truths, information and estimates of siblings with two parameters, the second hardly seen by most."""
    generator = np.random.default_rng(seed)
    truth = np.array([1.0, -2.0]) + generator.normal(size=(count, 2)) * [0.1, 0.3]
    covariance = np.array([[[0.02, 0.01], [0.01, 0.05 if k % 4 == 0 else 2.0]] for k in range(count)])
    estimate = np.array([generator.multivariate_normal(t, c) for t, c in zip(truth, covariance, strict=True)])
    return truth, np.linalg.inv(covariance), estimate


def test_the_population_is_the_most_likely_one() -> None:
    _, information, estimate = draws(40, 0)
    vector = np.einsum("ijk,ik->ij", information, estimate)
    mean, spread = _population(information, vector)
    own = np.linalg.inv(information)

    def cost(x: np.ndarray) -> float:
        between = np.diag(np.exp(2 * x[2:]))
        return -sum(multivariate_normal.logpdf(e, x[:2], c + between) for e, c in zip(estimate, own, strict=True))

    def profiled(log_spread: np.ndarray) -> float:
        """Restricted likelihood, the population mean integrated out under a flat prior, times the spread."""
        between = np.diag(np.exp(2 * log_spread))
        weight = sum(np.linalg.inv(c + between) for c in own)
        told = sum(np.linalg.inv(c + between) @ e for e, c in zip(estimate, own, strict=True))
        best = np.linalg.solve(weight, told)
        return cost(np.concatenate([best, log_spread])) + 0.5 * float(np.linalg.slogdet(weight)[1]) - log_spread.sum()

    best = minimize(profiled, np.log([0.2, 0.2]), method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-10})
    np.testing.assert_allclose(spread, np.exp(best.x), rtol=2e-3)
    between = np.diag(spread**2)
    weights = [np.linalg.inv(c + between) for c in own]
    expected = np.linalg.solve(sum(weights), sum(w @ e for w, e in zip(weights, estimate, strict=True)))
    np.testing.assert_allclose(mean, expected, rtol=1e-5)


@pytest.mark.statistical
def test_siblings_are_known_better_together_and_their_intervals_hold() -> None:
    alone, together, inside = [], [], []
    for seed in range(40):
        truth, information, estimate = draws(30, seed)
        vector = np.einsum("ijk,ik->ij", information, estimate)
        mean, spread = _population(information, vector)
        where, covariance = _posterior(information, vector, mean, spread, _mean(information, vector, spread)[1])
        alone.append(estimate - truth)
        together.append(where - truth)
        inside.append(np.abs(where - truth) < 1.96 * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))
    ratio = np.sqrt(np.mean(np.square(alone), axis=(0, 1)) / np.mean(np.square(together), axis=(0, 1)))
    assert ratio[0] > 1.3 and ratio[1] > 3.0
    assert 0.91 < np.mean(inside) < 0.97


@pytest.fixture(scope="module")
def one(pair_declared: dict[str, Any], pair_telemetry: Callable[[int], str], tmp_path_factory: Any) -> CalibratedModel:
    path: Path = tmp_path_factory.mktemp("family") / "pair.csv"
    path.write_text(pair_telemetry(200))
    spec = load_spec(pair_declared)
    return calibrate(spec, [read_csv(path, spec)])


def siblings(one: CalibratedModel, count: int, odd: str | None = None) -> dict[str, CalibratedModel]:
    """Return models around one, each with its own error, which its covariance tells; one of them may be odd."""
    generator = np.random.default_rng(3)
    network = build_network(one.spec, one.effects)
    guess = {name: network.parameters.parameters[network.parameters.index[name]] for name in one.free_names}
    own = np.diag([0.03**2] * len(one.free_names))
    made = {}
    for k in range(count):
        seen = np.array([np.log(one.values[n]) for n in one.free_names])
        seen = seen + generator.normal(0, 0.02, seen.size) + generator.normal(0, 0.03, seen.size)
        if k == 0 and odd is not None:
            seen[one.free_names.index(odd)] -= 0.7
        weight = np.diag([(p.prior_std or np.inf) ** -2.0 for p in guess.values()])
        covariance = np.linalg.inv(np.linalg.inv(own) + weight)
        prior = np.array([p.free for p in guess.values()])
        estimate = covariance @ (np.linalg.inv(own) @ seen + weight @ prior)
        values = one.values | {n: float(np.exp(v)) for n, v in zip(one.free_names, estimate, strict=True)}
        made[f"s{k}"] = replace(one, values=values, covariance=covariance)
    return made


def test_an_odd_one_is_called_different_and_nobody_else(one: CalibratedModel) -> None:
    odd = next(name for name in one.free_names if name.startswith("G:"))
    family = pool(siblings(one, 20, odd))
    assert {name: set(member.differs) for name, member in family.members.items() if member.differs} == {"s0": {odd}}
    alike = pool(siblings(one, 20))
    assert not any(member.differs for member in alike.members.values())
    mean = dict(zip(alike.names, np.exp(alike.mean), strict=True))
    assert all(abs(np.log(mean[name] / one.values[name])) < 0.03 for name in one.free_names)


def test_a_new_sibling_begins_with_what_the_family_knows(one: CalibratedModel) -> None:
    family = pool(siblings(one, 10))
    network = build_network(declared(one.spec, family), ())
    for name, mean, spread, error in zip(family.names, family.mean, family.spread, family.mean_std, strict=True):
        parameter = network.parameters.parameters[network.parameters.index[name]]
        assert parameter.value == pytest.approx(np.exp(mean))
        assert parameter.prior_std == pytest.approx(np.hypot(spread, error))


def test_a_family_has_three_members_of_one_design(one: CalibratedModel) -> None:
    with pytest.raises(ModelError, match="three"):
        pool({"a": one, "b": one})
    other = replace(one, free_names=one.free_names[:-1], covariance=one.covariance[:-1, :-1])
    with pytest.raises(ModelError, match="c: "):
        pool({"a": one, "b": one, "c": other})
