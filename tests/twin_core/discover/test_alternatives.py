"""Alternatives in a coarse network: each place is asked once, from its best fit, and weighed with its heat fitted if need be."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.twin_core.discover.stubs import CHANCE, JUST, NEEDED, judged, load, stub
from twin_core.discover import alternatives, trajectories
from twin_core.discover.alternatives import HOPELESS_NATS, _cost_of_explaining, add_coarse_alternatives
from twin_core.discover.evidence import Evidence
from twin_core.discover.judge import Finding, Search
from twin_core.discover.policy import ALTERNATIVE_NATS, LARGEST_NOISE, REPEATABLE_SHARE
from twin_core.discover.trial import Trial, explained
from twin_core.effects.base import Effect

BEFORE, LEFT, COST = 10.0, 2.0, 1e3
MOST_LEFT = LEFT + REPEATABLE_SHARE * (BEFORE - LEFT)


class Fits:
    """Fits of one effect at node ``b`` from both starts, what they leave, and their nats before and after settling."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, left: tuple[float, float], nats: tuple[float, float]) -> None:
        self.rough, self.fine = dict(zip(("bare", "fitted"), left, strict=True)), nats
        self.settled: list[float] = []
        self.tries: list[Any] = []
        self.near = nats[0]
        self.beside: list[str] = []
        self.likelier = self.least = -1e3
        self.status = "converged"
        self.again: Any = None
        self.simple: Any = stub(left=BEFORE)
        self.simple.present_effects, self.simple.calibration = (), lambda: "fitted"
        self.found = self.with_a(LEFT)
        for name, value in {
            "bare": lambda simple, found: "bare",
            "_near": lambda *given: [load("b")],
            "_near_before": lambda *given: [load("b")],
            "_near_beside_gradients": lambda *given: [load(node) for node in self.beside],
            "try_on_trajectories": self.tried,
            "resettled": self.resettled,
            "resettled_near": self.resettled_near,
            "weigh": lambda simple, rich, n_tried: Evidence(rich.nats, 0.0),
        }.items():
            monkeypatch.setattr(alternatives, name, value)
        monkeypatch.setattr(Search, "attempt_each", lambda state, works, *told: [work() for work, _ in works])

    def with_a(self, left: float) -> Any:
        found: Any = stub(load("a"), left=left)
        found.calibration = self.simple.calibration
        return found

    def trial(self, left: float, nats: float) -> Any:
        made: Any = stub(load("b"), left=left)
        made.nats = nats
        made.log_evidence = lambda: self.likelier
        optimum = SimpleNamespace(status=self.status, fit=SimpleNamespace(cost=COST))
        made.near, made.least_evidence = (optimum,), self.least
        return made

    def tried(self, simple: Trial, effects: tuple[Effect, ...], *starts: Any, goal: float) -> Any:
        self.tries.append(starts)
        if goal == COST:  # what explains enough, fitted from the simpler model as it was fitted
            if isinstance(self.again, Exception):
                raise self.again
            return self.again
        return self.trial(min(self.rough[str(start)] for start in starts), self.fine[0])

    def resettled(self, simple: Trial, rich: Any) -> Any:
        self.settled.append(rich.unexplained())
        return self.trial(rich.unexplained(), self.fine[1])

    def resettled_near(self, simple: Trial, rich: Any) -> Any:
        return self.trial(rich.unexplained(), self.near)

    def told(self) -> list[str]:
        finding = Finding(judged("a", 50.0))
        state = Search(self.found, self.simple, findings=[finding])
        made = add_coarse_alternatives(state, self.simple, finding, NEEDED)
        return [str(j.effects[0].where["node"]) for j in made.alternatives]


@pytest.mark.parametrize(
    ("nats", "near", "settles", "told"),
    [
        ((NEEDED + JUST, -9.0), -9.0, False, ["b"]),
        ((-133.0, -9.0), NEEDED + JUST, False, ["b"]),
        ((-133.0, NEEDED + JUST), NEEDED - HOPELESS_NATS, True, ["b"]),
        ((-133.0, NEEDED + JUST), NEEDED - HOPELESS_NATS - JUST, False, []),
        ((NEEDED, NEEDED), NEEDED, True, []),
    ],
    ids=["as it is", "by a heat fitted from the simpler model", "by a fitted heat only", "hopeless", "not supported"],
)
def test_an_alternative_is_weighed_with_its_heat_fitted_where_the_first_guess_speaks_against_it(
    monkeypatch: pytest.MonkeyPatch, nats: tuple[float, float], near: float, told: list[str], *, settles: bool
) -> None:
    """Beside a first guess a leak that leaves as little as radiation was less likely than nothing, by 134 nats."""
    fits = Fits(monkeypatch, (LEFT + 0.1, LEFT), nats)
    fits.near = near
    assert fits.told() == told
    assert fits.settled == ([LEFT] if settles else [])


@pytest.mark.parametrize(
    ("likelier", "tries"),
    [(-ALTERNATIVE_NATS, [("bare",), ("fitted",), ("fitted",)]), (-ALTERNATIVE_NATS + JUST, [("bare",), ("fitted",)])],
)
def test_a_place_as_likely_as_what_was_found_is_not_fitted_from_its_other_starts(
    monkeypatch: pytest.MonkeyPatch, likelier: float, tries: list[Any]
) -> None:
    """A load that begins some time was fitted fourteen times at the node of a constant one, each time to the same end."""
    fits = Fits(monkeypatch, (LEFT, LEFT), (9.0, 9.0))
    fits.likelier = likelier
    assert fits.told() == ["b"]
    assert fits.tries == tries


@pytest.mark.parametrize(("more", "told"), [(-JUST, ["b"]), (JUST, [])], ids=["closer", "less close"])
def test_an_alternative_is_fitted_from_the_simpler_model_too_and_the_closer_fit_is_weighed(
    monkeypatch: pytest.MonkeyPatch, more: float, told: list[str]
) -> None:
    """A sensor's lag of 19 s ended at 154 s from where a heater had been found, 70 nats below."""
    fits = Fits(monkeypatch, (LEFT, LEFT), (-133.0, -133.0))
    fits.near = -133.0
    fits.again = fits.trial(LEFT, NEEDED + JUST)
    fits.again.near[0].fit.cost = COST + more
    assert fits.told() == told


def test_a_failure_from_the_simpler_model_takes_nothing_from_the_first_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    fits = Fits(monkeypatch, (LEFT, LEFT), (9.0, 9.0))
    fits.again = np.linalg.LinAlgError("singular matrix")
    assert fits.told() == ["b"]


@pytest.mark.parametrize(
    ("left", "told"),
    [
        ((MOST_LEFT - JUST, BEFORE), ["b"]),
        ((MOST_LEFT + JUST, BEFORE), []),
        ((BEFORE, MOST_LEFT - JUST), ["b"]),
    ],
    ids=["enough", "too little", "from the model as it was fitted"],
)
def test_an_alternative_explains_all_but_a_tenth(
    monkeypatch: pytest.MonkeyPatch, left: tuple[float, float], told: list[str]
) -> None:
    assert Fits(monkeypatch, left, (9.0, 9.0)).told() == told


@pytest.mark.parametrize(
    ("likelier", "told"), [(-ALTERNATIVE_NATS, []), (-ALTERNATIVE_NATS + JUST, ["b"]), (90.0, ["b"])]
)
def test_an_alternative_that_the_readings_hardly_tell_from_what_was_found_may_explain_less(
    monkeypatch: pytest.MonkeyPatch, likelier: float, told: list[str]
) -> None:
    """Parameters make up for a neighbouring place along trajectories; beside gradients the right one was 75 nats likelier."""
    fits = Fits(monkeypatch, (BEFORE, BEFORE), (9.0, 9.0))
    fits.likelier = likelier
    assert fits.told() == told


@pytest.mark.parametrize(
    ("least", "told"),
    [(-ALTERNATIVE_NATS, []), (-ALTERNATIVE_NATS + JUST, ["b"])],
    ids=["too unlikely", "by wandering heat"],
)
def test_of_a_fit_that_was_given_up_wandering_heat_alone_is_asked(
    monkeypatch: pytest.MonkeyPatch, least: float, told: list[str]
) -> None:
    fits = Fits(monkeypatch, (BEFORE, BEFORE), (9.0, 9.0))
    fits.status, fits.likelier, fits.least = "given_up", 90.0, least
    assert fits.told() == told


@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.0, 0.9), noise=st.floats(0.1, 2.0))
def test_what_costs_more_than_the_goal_explains_too_little(seed: int, share: float, noise: float) -> None:
    """Whatever gradients take of what is left, however readings are spread over sensors, and whatever the noise is known to."""
    rng = np.random.default_rng(seed)
    n_sensors = int(rng.integers(1, 4))
    valid = rng.random((200, n_sensors)) < rng.random(n_sensors)
    valid[0] = True
    scaled = rng.lognormal(0.5) * rng.standard_normal((200, n_sensors)) * rng.lognormal(0.0, 1.0, n_sensors)
    mean_square = np.array([np.mean(scaled[valid[:, i], i] ** 2) for i in range(n_sensors)])
    left = float(np.mean(np.maximum(mean_square / min(noise, LARGEST_NOISE) ** 2 - 1.0, 0.0)))
    beside = left * rng.random()
    simple: Any = stub(left=BEFORE)
    simple.fit = SimpleNamespace(problem=SimpleNamespace(segments=[SimpleNamespace(valid=valid)]))
    found: Any = stub(load("a"), left=LEFT)
    found.share_of_gradients = lambda: share
    rich: Any = stub(load("b"), left=left)
    rich.left_beside = lambda share: (1.0 - share) * left + share * beside
    least = (1.0 - REPEATABLE_SHARE) * explained(simple, found)
    if 0.5 * float(np.sum(scaled[valid] ** 2)) > _cost_of_explaining(simple, found, least):
        assert explained(simple, rich, found) < least


def test_where_gradients_may_take_all_that_is_left_no_fit_is_given_up() -> None:
    found: Any = stub(load("a"), left=LEFT)
    found.share_of_gradients = lambda: 1.0
    assert _cost_of_explaining(stub(left=BEFORE), found, 1.0) == np.inf


def test_what_stands_out_beside_gradients_is_fitted_from_both_of_their_optima(monkeypatch: pytest.MonkeyPatch) -> None:
    fits = Fits(monkeypatch, (BEFORE, BEFORE), (9.0, 9.0))
    gradients = SimpleNamespace(problem="beside", optimum="gradients")
    fits.beside, fits.simple.beside_any_gradients = ["b"], lambda: gradients
    fits.rough["beside gradients"] = LEFT
    monkeypatch.setattr(trajectories, "replace", lambda calibration, problem, optimum: f"{problem} {optimum}")
    assert fits.told() == ["b"]
    fits.simple.beside_any_gradients = lambda: None
    assert fits.told() == []


@pytest.mark.parametrize("left", [CHANCE, CHANCE + JUST])
def test_where_only_chance_is_left_the_evidence_alone_tells(monkeypatch: pytest.MonkeyPatch, left: float) -> None:
    fits = Fits(monkeypatch, (left, left), (9.0, 9.0))
    fits.found = fits.with_a(left)
    assert fits.told() == ([] if left <= CHANCE else ["b"])
