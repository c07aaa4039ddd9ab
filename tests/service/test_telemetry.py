"""Ingest and archive through HTTP."""

import gzip
import json

import pytest

from tests.service.harness import AppClient

ROUTE = "/v1/twins/benchsat/telemetry"


def send(client: AppClient, time: list, **values: list) -> dict:
    response = client.post(ROUTE, json={"time": time, "values": values})
    assert response.status_code == 200, response.text
    return response.json()


def test_columns_come_back_as_they_went_in(registered: AppClient) -> None:
    report = send(registered, ["2026-01-01T00:00:00Z", 1767225610.25], T_px=[290.5, None], T_tank=[-3, 4.125])
    assert report == {"accepted": 2, "duplicates": 0, "rejected": [], "last_time": "2026-01-01T00:00:10.250000Z"}
    archive = registered.get(ROUTE).json()
    assert archive["time"] == ["2026-01-01T00:00:00Z", "2026-01-01T00:00:10.250000Z"]
    assert archive["values"] == {"T_px": [290.5, None], "T_tank": [-3.0, 4.125], "Q_px": [None, None]}
    assert archive["units"] == {"T_px": "K", "T_tank": "degC", "Q_px": "W"}


@pytest.mark.parametrize(
    "spelling",
    [
        "2026-01-01T00:00:00.500000Z",
        "2026-01-01t00:00:00.5z",
        "2026-01-01 01:00:00.500+01:00",
        "2025-12-31T23:30:00.5000001-00:30",
        1767225600.5,
        1767225600.5000002,
    ],
)
def test_one_instant_in_any_spelling_is_one_sample(registered: AppClient, spelling: str | float) -> None:
    send(registered, ["2026-01-01T00:00:00.5Z"], T_px=[290])
    assert send(registered, [spelling], T_px=[290.0])["duplicates"] == 1
    assert send(registered, [spelling], T_px=[291.0])["rejected"] == [{"index": 0, "reason": "conflict"}]
    assert registered.get(ROUTE).json()["values"]["T_px"] == [290.0]


def test_a_microsecond_apart_is_another_sample(registered: AppClient) -> None:
    assert send(registered, [1767225600.000001, 1767225600.000002], T_px=[1, 1])["accepted"] == 2


def test_late_and_unordered_samples_are_taken_in(registered: AppClient) -> None:
    assert send(registered, [50, 10, 30], T_px=[5, 1, 3])["last_time"] == "1970-01-01T00:00:50Z"
    assert send(registered, [20, 40, 10], T_px=[2, 4, 1]) == {
        "accepted": 2,
        "duplicates": 1,
        "rejected": [],
        "last_time": "1970-01-01T00:00:50Z",
    }
    assert registered.get(ROUTE).json()["values"]["T_px"] == [1, 2, 3, 4, 5]


def test_a_repeated_instant_within_a_body(registered: AppClient) -> None:
    report = send(registered, [10, 10, 10, 20], T_px=[1, 1, 2, 3])
    assert (report["accepted"], report["duplicates"]) == (2, 1)
    assert report["rejected"] == [{"index": 2, "reason": "conflict"}]


def test_channels_of_one_instant_may_come_apart(registered: AppClient) -> None:
    send(registered, [10], T_px=[1])
    assert send(registered, [10], Q_px=[7])["accepted"] == 1
    assert send(registered, [10], T_px=[1], Q_px=[7])["duplicates"] == 1
    archive = registered.get(ROUTE).json()
    assert (archive["samples"], archive["values"]["T_px"], archive["values"]["Q_px"]) == (1, [1.0], [7.0])
    assert registered.get("/v1/twins/benchsat").json()["samples"] == 1


def test_frames_line_by_line_and_gzipped(registered: AppClient) -> None:
    lines = [{"time": 10, "values": {"T_px": 1}}, {"time": "1970-01-01T00:00:20Z", "values": {"Q_px": 7, "T_px": None}}]
    body = "\n".join(map(json.dumps, lines)).encode() + b"\n\n"
    headers = {"content-type": "application/x-ndjson"}
    assert registered.post(ROUTE, content=body, headers=headers).json()["accepted"] == 2
    headers |= {"content-encoding": "gzip"}
    assert registered.post(ROUTE, content=gzip.compress(body), headers=headers).json()["duplicates"] == 2


def test_a_gzip_body_may_have_several_members(registered: AppClient) -> None:
    lines = [b'{"time": %d, "values": {"T_px": 1}}\n' % number for number in range(300)]
    body = b"".join(map(gzip.compress, lines))  # as `cat a.gz b.gz` writes it
    headers = {"content-type": "application/x-ndjson", "content-encoding": "gzip"}
    assert registered.post(ROUTE, content=body, headers=headers).json()["accepted"] == 300


def test_what_the_archive_answers_can_be_sent_again(registered: AppClient) -> None:
    send(registered, ["2026-01-01T00:00:00Z", 1767225610.25], T_px=[290.5, None], T_tank=[-3, 4.125])
    for parameters in ({}, {"channels": "T_tank"}, {"max_points": 2}):
        answer = registered.get(ROUTE, params=parameters)
        again = registered.post(ROUTE, content=answer.content, headers={"content-type": "application/json"})
        assert again.json() == {
            "accepted": 0,
            "duplicates": 2,
            "rejected": [],
            "last_time": "2026-01-01T00:00:10.250000Z",
        }


def test_a_sample_without_a_value_is_a_sample_in_either_form(registered: AppClient) -> None:
    headers = {"content-type": "application/x-ndjson"}
    lines = b'{"time": 50, "values": {}}\n{"time": 60, "values": {"T_px": null}}\n{"time": 70, "values": {"T_px": 1}}'
    for outcome in ("accepted", "duplicates"):
        report = registered.post(ROUTE, content=lines, headers=headers).json()
        assert (report[outcome], report["rejected"]) == (3, [])
        assert send(registered, [150, 160, 170], T_px=[None, None, 1])[outcome] == 3
        assert send(registered, [250])[outcome] == 1
    assert send(registered, [60], T_px=[2])["accepted"] == 1
    archive = registered.get(ROUTE).json()
    assert archive["time"] == [f"1970-01-01T00:0{t // 60}:{t % 60:02}Z" for t in (50, 60, 70, 150, 160, 170, 250)]
    assert archive["values"]["T_px"] == [None, 2, 1, None, None, 1, None]


def test_lines_are_counted_as_an_editor_does(registered: AppClient) -> None:
    for line, field in (
        (b'{"time": "x", "values": {}}', "line 3: time"),
        (b'{"time": 1, "values": {"T_px": "1"}}', "line 3: values.T_px"),
        (b'{"time": 1, "values": {"T_no": 1}}', "line 3: values.T_no"),
        (b'{"time": 1}', "line 3: values"),
        (b"{", "line 3"),
    ):
        headers = {"content-type": "application/x-ndjson"}
        body = b'{"time": 1, "values": {}}\n\n' + line + b"\n"
        assert registered.post(ROUTE, content=body, headers=headers).json()["errors"][0]["field"] == field


def test_plausible_limits_read_well(registered: AppClient) -> None:
    refusal = registered.post(ROUTE, json={"time": [1], "values": {"T_px": [-5]}}).json()
    assert refusal["detail"].endswith("plausible is 0 to 5000 K")


def test_archive_of_a_part(registered: AppClient) -> None:
    send(registered, list(range(100)), T_px=list(range(100)), Q_px=[0] * 100)
    part = registered.get(ROUTE, params={"start": "1970-01-01T00:00:10Z", "stop": 13, "channels": "T_px"}).json()
    assert part["values"] == {"T_px": [10, 11, 12]}
    plot = registered.get(ROUTE, params={"max_points": 12}).json()
    assert plot["downsampled"] and len(plot["time"]) <= 12
    assert plot["values"]["T_px"][0] == 0 and plot["values"]["T_px"][-1] == 99


def test_no_samples_is_a_valid_batch(registered: AppClient) -> None:
    assert send(registered, []) == {"accepted": 0, "duplicates": 0, "rejected": [], "last_time": None}


def test_many_small_requests_are_compacted_without_loss(registered: AppClient) -> None:
    for number in range(150):
        send(registered, [number * 7 % 150], T_px=[number])
    archive = registered.get(ROUTE).json()
    assert archive["samples"] == 150
    assert [value * 7 % 150 for value in archive["values"]["T_px"]] == list(range(150))
    assert send(registered, [7.0], T_px=[1.0])["duplicates"] == 1
