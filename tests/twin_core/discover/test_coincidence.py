"""An event where an input changes as nowhere else: told from one elsewhere, and from one beside changes like others; and one
where the record begins or ends."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twin_core._typing import FloatArray
from twin_core.discover import policy
from twin_core.discover.coincidence import FEWEST_BESIDE, N_BESIDE, at_an_end, coinciding_channel, lone_changes
from twin_core.discover.trial import Trial
from twin_core.effects import REGISTRY
from twin_core.effects.base import Effect
from twin_core.effects.onset import MARGIN
from twin_core.telemetry import Record

N, STEP_S = 400, 10.0
ONCE = np.where(np.arange(N) < 200, 9.0, 4.0)
OFTEN = np.where(np.arange(N) // 50 % 2 == 0, 9.0, 4.0)


def trial(*columns: FloatArray, name: str = "P") -> Trial:
    """Return what stands for a trial: a sensor that jumps wherever the channel does, and one record for each column."""
    spec = SimpleNamespace(channels=("T", name), sensors=("T",))
    records = [Record(STEP_S * np.arange(c.size), {"T": c, name: c}, None, "r") for c in columns]
    segments = [SimpleNamespace(record=r, valid=np.isfinite(r.values["T"])[:, None]) for r in records]
    fit = SimpleNamespace(network=SimpleNamespace(spec=spec), problem=SimpleNamespace(segments=segments))
    return cast(Trial, SimpleNamespace(fit=fit, present_effects=()))


def step_at(sample: float) -> Effect:
    clock: dict[str, Any] = {"begin_s": 0.0, "span_s": STEP_S * N, "width_s": STEP_S, "dated": False}
    return REGISTRY["heat_load_step"]({"node": "n1"}, {"Q_W": 1.0, "time": STEP_S * sample}, clock)


@pytest.mark.parametrize(
    ("column", "sample", "coincides"),
    [
        (ONCE, 199.5, True),
        (ONCE, 199.5 + N_BESIDE - 1, True),
        (ONCE, 199.5 + 4 * N_BESIDE, False),
        (OFTEN, 199.5, False),
        (np.linspace(4.0, 9.0, N), 199.5, False),
        (np.full(N, 4.0), 199.5, False),
        (ONCE + 0.3 * np.random.default_rng(0).standard_normal(N), 199.5, True),
        (ONCE + np.where(np.arange(N) > 300, 2.4, 0.0), 199.5, True),
        (ONCE + np.where(np.arange(N) > 300, 2.6, 0.0), 199.5, False),
        (np.where(np.abs(np.arange(N) - 198) < 2, np.nan, ONCE), 199.5, True),
        (ONCE + np.where(np.arange(N) > N - 1 - round(MARGIN * (N - 1)), 9.0, 0.0), 199.5, True),
        (ONCE + np.where(np.arange(N) > N - 2 - round(MARGIN * (N - 1)), 9.0, 0.0), 199.5, False),
        (np.full(N, np.nan), 199.5, False),
    ],
    ids=[
        "with the only switching",
        "just after it",
        "well after it",
        "with one of many",
        "beside a ramp",
        "beside a constant",
        "a noisy channel",
        "others half as large",
        "others larger than half",
        "a gap at the switching",
        "another at the end",
        "another near the end",
        "no reading",
    ],
)
def test_an_event_coincides_with_a_change_like_no_other(column: FloatArray, sample: float, *, coincides: bool) -> None:
    assert coinciding_channel(trial(column), [step_at(sample)]) == ("P" if coincides else None)


FIRST = MARGIN * (N - 1)


@pytest.mark.parametrize(
    ("sample", "is_at_an_end"),
    [
        (-3.5, True),
        (round(FIRST) - 1.5, True),
        (round(FIRST) - 0.5, False),
        (199.5, False),
        (N - 1 - round(FIRST) - 0.5, False),
        (N - 1 - round(FIRST) + 1.5, True),
        (N + 40.0, True),
    ],
    ids=[
        "before it",
        "at the beginning",
        "the first that is looked for",
        "within",
        "the last one",
        "at the end",
        "after it",
    ],
)
def test_an_event_at_an_end_of_the_record_may_have_been_so_all_along(sample: float, *, is_at_an_end: bool) -> None:
    assert at_an_end(trial(ONCE), [step_at(sample)]) == is_at_an_end


def test_unread_samples_tell_no_event_from_what_was_so_all_along() -> None:
    """A third of the record lies before the event, and nothing was read there but the first sample."""
    unread = np.where((np.arange(N) > FEWEST_BESIDE - 2) & (np.arange(N) < N // 3), np.nan, ONCE)
    assert at_an_end(trial(unread), [step_at(N // 3 - 0.5)])
    assert not at_an_end(trial(ONCE), [step_at(N // 3 - 0.5)])


def test_an_event_is_asked_where_open_loop_trajectories_put_it() -> None:
    asked = trial(ONCE)
    moved = SimpleNamespace(fit=asked.fit, present_effects=(step_at(-3.5),))
    assert at_an_end(cast(Trial, moved), [step_at(199.5)])
    elsewhere = SimpleNamespace(fit=asked.fit, present_effects=(replace(step_at(-3.5), where={"node": "n2"}),))
    assert not at_an_end(cast(Trial, elsewhere), [step_at(199.5)])


def test_what_has_no_instant_lies_at_no_end() -> None:
    load = REGISTRY["constant_heat_load"]({"node": "n1"}, {"Q_W": 1.0})
    assert not at_an_end(trial(ONCE), [load])


def test_what_has_no_instant_and_what_sensors_read_coincide_with_nothing() -> None:
    load = REGISTRY["constant_heat_load"]({"node": "n1"}, {"Q_W": 1.0})
    assert coinciding_channel(trial(ONCE), [load]) is None
    assert coinciding_channel(trial(ONCE, name="T"), [step_at(199.5)]) is None


def test_another_record_that_changes_as_much_tells_the_law() -> None:
    """Its clock does not reach the instant."""
    assert coinciding_channel(trial(ONCE, OFTEN[:150]), [step_at(199.5)]) is None
    assert coinciding_channel(trial(ONCE, np.full(150, 9.0)), [step_at(199.5)]) == "P"


@given(st.floats(1e-3, 1e3), st.floats(-1e3, 1e3), st.integers(0, N - 1))
def test_neither_unit_nor_zero_of_a_channel_matters(scale: float, zero: float, sample: int) -> None:
    assert coinciding_channel(trial(scale * ONCE + zero), [step_at(sample)]) == coinciding_channel(
        trial(ONCE), [step_at(sample)]
    )


@given(
    st.lists(st.lists(st.integers(0, 9), min_size=3, max_size=60), min_size=1, max_size=3),
    st.sampled_from(["off", "half", "double", ""]),
)
def test_lone_changes_are_those_of_a_plain_count(columns: list[list[int]], variant: str) -> None:
    """Stretch by stretch; off there are none."""
    about = policy.THRESHOLDS["LONE_CHANGE"]
    factor = getattr(about, variant) if variant else policy.LONE_CHANGE
    records = [Record(np.arange(float(len(c))), {"P": np.array(c, dtype=float)}, None, "r") for c in columns]
    changes = []
    for c in columns:
        left_out = min(max(round(MARGIN * (len(c) - 1)), FEWEST_BESIDE), len(c) - 1)
        within = [c[left_out]] * left_out + c[left_out : len(c) - left_out]  # held beyond where too little tells
        within += [within[-1]] * (len(c) - len(within))
        within = within[: len(c)]
        changes.append(
            [abs(within[min(i + N_BESIDE, len(c) - 1)] - within[max(i - N_BESIDE, 0)]) for i in range(len(c))]
        )
    expected = [
        [
            factor
            * max(
                (
                    value
                    for k, other in enumerate(changes)
                    for j, value in enumerate(other)
                    if k != which or abs(i - j) > 2 * N_BESIDE
                ),
                default=0.0,
            )
            < own[i]
            and factor < np.inf
            for i in range(len(own))
        ]
        for which, own in enumerate(changes)
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(policy, "LONE_CHANGE", factor)
        assert [found.tolist() for found in lone_changes(records, "P")] == expected
