"""Pacing with a clock that only a test moves."""

import pytest

from replay.clock import Clock, Pace


class FakeTime:
    def __init__(self) -> None:
        self.now = 100.0

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def test_ten_recorded_seconds_at_rate_four_take_two_and_a_half() -> None:
    fake = FakeTime()
    pace = Pace(4.0, Clock(lambda: fake.now, fake.sleep))
    for second in range(11):
        pace.wait_for(second * 10**9)
    assert fake.now == pytest.approx(102.5)


def test_late_replay_does_not_wait() -> None:
    fake = FakeTime()
    pace = Pace(1.0, Clock(lambda: fake.now, fake.sleep))
    pace.wait_for(0)
    fake.now += 60.0
    pace.wait_for(10**9)
    assert fake.now == 160.0


def test_no_rate_never_waits() -> None:
    fake = FakeTime()
    Pace(None, Clock(lambda: fake.now, fake.sleep)).wait_for(10**18)
    assert fake.now == 100.0


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan")])
def test_rate_must_be_positive(rate: float) -> None:
    with pytest.raises(ValueError, match="rate must be positive"):
        Pace(rate)
