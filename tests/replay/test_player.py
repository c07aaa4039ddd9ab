"""The player against a small service that keeps what it is sent."""

import json

import httpx
import numpy as np
import pytest

from replay.clock import Clock
from replay.errors import ReplayError
from replay.player import Tally, play
from replay.recording import Recording
from service.client import Retry, TwinClient

START_NS = 1_767_225_600_000_000_000


class Recorder:
    """Answers like the service; fails each request as often as ``failures`` says."""

    def __init__(self, failures: int = 0) -> None:
        self.failures, self.left = failures, failures
        self.rows: dict[str, float | None] = {}
        self.sizes: list[int] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        last = max(self.rows, default=None)
        if request.method == "GET":
            head = {"id": "t", "created": "x", "samples": 0, "first_time": None, "last_time": last}
            return httpx.Response(
                200, json={**head, "active_model": None, "seq": 0, "channels": [], "specification": {}}
            )
        if self.left:
            self.left -= 1
            return httpx.Response(503)
        self.left = self.failures
        body = json.loads(request.content)
        self.rows |= dict(zip(body["time"], body["values"]["T_px"], strict=True))
        self.sizes.append(len(body["time"]))
        report = {"accepted": len(body["time"]), "duplicates": 0, "rejected": [], "last_time": max(self.rows)}
        return httpx.Response(200, json=report)


def make_client(recorder: Recorder, attempts: int = 3) -> TwinClient:
    transport = httpx.MockTransport(recorder)
    return TwinClient("http://t", transport=transport, retry=Retry(attempts), sleep_s=lambda _: None)


def ramp(n: int) -> Recording:
    values = np.arange(n, dtype=float)
    values[1] = np.nan
    return Recording(START_NS + np.arange(n, dtype=np.int64) * 1_000_000_000, {"T_px": values})


def test_every_sample_arrives_once_in_batches() -> None:
    recorder = Recorder(failures=2)
    seen: list[Tally] = []
    with make_client(recorder) as client:
        tally = play(ramp(25), client, "t", batch=10, progress=seen.append)
    assert recorder.sizes == [10, 10, 5]
    assert [t.sent for t in seen] == [10, 20, 25]
    assert (tally.accepted, tally.last_time) == (25, "2026-01-01T00:00:24.000000Z")
    assert list(recorder.rows.values()) == [0.0, None, *map(float, range(2, 25))]


def test_resume_sends_only_what_is_missing() -> None:
    recorder = Recorder()
    with make_client(recorder) as client:
        play(ramp(10), client, "t")
        assert play(ramp(15), client, "t", resume=True).sent == 5
        assert play(ramp(15), client, "t", resume=True).sent == 0


def test_a_paced_replay_takes_its_time_and_sends_small_batches() -> None:
    now = [0.0]
    clock = Clock(lambda: now[0], lambda pause_s: now.__setitem__(0, now[0] + pause_s))
    recorder = Recorder()
    with make_client(recorder) as client:
        play(ramp(41), client, "t", rate=8.0, clock=clock)
    assert max(recorder.sizes) == 3  # a quarter of a second at rate 8 spans two steps of one second
    assert now[0] == pytest.approx((40 - 2) / 8.0)  # the pace starts when the first batch is complete


def test_giving_up_names_the_reason() -> None:
    with make_client(Recorder(failures=9)) as client, pytest.raises(ReplayError, match="503"):
        play(ramp(3), client, "t")
