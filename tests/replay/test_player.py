"""The player against a small service that keeps what it is sent."""

import json
from datetime import datetime
from typing import Any

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
        self.sent: list[str] = []
        self.most = 10**9

    def archive(self, start: str, stop: str, channels: str) -> dict[str, Any]:
        """Thin out what is too much, as the service does."""
        assert channels == "T_px"
        inside = sorted(time for time in self.rows if instant(start) <= instant(time) < instant(stop))
        thin = len(inside) > self.most
        kept = inside[:: len(inside) - 1] if thin else inside
        values = {"T_px": [self.rows[time] for time in kept]}
        return {"time": kept, "values": values, "units": {}, "samples": len(inside), "downsampled": thin}

    def __call__(self, request: httpx.Request) -> httpx.Response:
        first, last = min(self.rows, default=None), max(self.rows, default=None)
        if request.url.path.endswith("/telemetry") and request.method == "GET":
            return httpx.Response(200, json=self.archive(**dict(request.url.params)))
        if request.method == "GET":
            head = {"id": "t", "created": "x", "samples": 0, "first_time": first, "last_time": last}
            return httpx.Response(
                200, json={**head, "active_model": None, "seq": 0, "channels": [], "specification": {}}
            )
        if self.left:
            self.left -= 1
            return httpx.Response(503)
        self.left = self.failures
        body = json.loads(request.content)
        self.rows |= dict(zip(body["time"], body["values"]["T_px"], strict=True))
        self.sent += body["time"]
        self.sizes.append(len(body["time"]))
        report = {"accepted": len(body["time"]), "duplicates": 0, "rejected": [], "last_time": max(self.rows)}
        return httpx.Response(200, json=report)


def instant(text: str) -> datetime:
    return datetime.fromisoformat(text)


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


@pytest.mark.parametrize("most", [10**9, 3])
def test_resume_fills_gaps_and_brings_up_contradictions(most: int) -> None:
    recorder = Recorder()
    recorder.most = most
    with make_client(recorder) as client:
        play(ramp(30), client, "t")
        whole, recorder.sent = dict(recorder.rows), []
        times = list(whole)
        for lost in (0, 7, 8, 20):  # what the service holds needs not be the first part
            del recorder.rows[times[lost]]
        recorder.rows[times[11]] = None  # the instant came with another channel
        recorder.rows[times[13]] = 99.0
        assert play(ramp(30), client, "t", resume=True).sent == 6
    assert recorder.sent == [times[k] for k in (0, 7, 8, 11, 13, 20)]
    assert recorder.rows == whole


def test_resume_sends_what_is_older_than_all_that_the_service_holds() -> None:
    recorder = Recorder()
    with make_client(recorder) as client:
        recorder.rows["2026-02-01T00:00:00Z"] = 1.0
        assert play(ramp(10), client, "t", resume=True).sent == 10


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
