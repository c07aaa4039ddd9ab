"""The bridge between a real Yamcs server and a real service: what arrives, what is published, and what breaks."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from replay.bridges.config import YamcsConfig
from replay.bridges.errors import Away, BridgeError
from replay.cli.main import main
from service.client import TwinClient
from tests.ground.yamcs import MISSING, PASSWORD, USER, Yamcs
from tests.service.server import Server

pytestmark = [
    pytest.mark.ground,
    pytest.mark.skipif(MISSING is not None, reason=MISSING or ""),
    # Yamcs' client leaves the socket of a subscription that broke off to the garbage collector.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

T0_MS = 1_772_323_200_000
STEP_MS = 10_000
TOP = "/THERMAL_TWIN/benchsat"


def px_degC(k: int) -> float:
    """Return a reading that leaps between 150 and 180."""
    return 17.0 + 0.001 * k + (9.0 * (k % 2) if 150 <= k < 180 else 0.0)


def feed(yamcs: Yamcs, first: int, stop: int, stream: str = "pp_realtime") -> None:
    """Play telemetry into Yamcs as a ground station would."""
    from replay.bridges.yamcs_gateway import Row, YamcsGateway

    rows = [
        Row(
            T0_MS + k * STEP_MS,
            {"/SAT/thermal/T_px": px_degC(k), "/SAT/thermal/T_tank": 15.0, "/SAT/eps/Q_px": 500.0},
        )
        for k in range(first, stop)
    ]
    with YamcsGateway(yamcs.url, "sat") as gateway:
        assert gateway.publish(stream, rows) == 3 * (stop - first)


def published(yamcs: Yamcs, name: str) -> list[tuple[int, Any]]:
    """Return what Yamcs' own client finds in the archive: generation time and value."""
    from yamcs.client import YamcsClient, YamcsError

    from replay.bridges.instants import to_datetime, to_ms

    span = {"start": to_datetime(0), "stop": to_datetime(4_000_000_000_000)}
    with closing(YamcsClient(yamcs.url)) as client:
        for _ in range(20):
            # A replay that is over before Yamcs has seen it begin ends as a server error now and then.
            with suppress(YamcsError):
                found = list(client.get_archive("sat").list_parameter_values(f"{TOP}/{name}", **span))
                return sorted((to_ms(value.generation_time), value.eng_value) for value in found)
    raise AssertionError(yamcs.log())


def events(yamcs: Yamcs) -> list[Any]:
    """Return the events of the twin."""
    from yamcs.client import YamcsClient

    with closing(YamcsClient(yamcs.url)) as client:
        return list(client.get_archive("sat").list_events(source="thermal-twin/benchsat"))


def make_bridge(
    config: YamcsConfig, yamcs: Yamcs, server: Server, heard: list[str] | None = None, **options: Any
) -> Any:
    from replay.bridges.yamcs_bridge import YamcsBridge
    from replay.bridges.yamcs_gateway import YamcsGateway

    tell = [] if heard is None else heard
    return YamcsBridge(
        config, lambda: YamcsGateway(yamcs.url, "sat", **options), server.client(), server.url, tell.append, poll_s=0.1
    )


@contextmanager
def running(bridge: Any) -> Iterator[Any]:
    """Run a bridge in a thread; what it raises is raised at the end."""
    raised: list[BaseException] = []

    def run() -> None:
        try:
            bridge.run()
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield bridge
    finally:
        bridge.stop()
        thread.join(120)
        assert not thread.is_alive()
    if raised:
        raise raised[0]


def until(condition: Callable[[], Any], what: str) -> None:
    """Wait until something is so."""
    for _ in range(3000):
        if condition():
            return
        time.sleep(0.1)
    raise AssertionError(f"never so: {what}")


def assert_once_each(rows: list[tuple[int, Any]], ks: range) -> None:
    """Check that every generation time of these samples is there, once."""
    assert [time_ms for time_ms, _ in rows] == [T0_MS + k * STEP_MS for k in ks]


def test_telemetry_goes_in_and_what_the_twin_knows_comes_out(
    yamcs: Yamcs, service: Server, client: TwinClient, config: YamcsConfig
) -> None:
    feed(yamcs, 0, 200)
    make_bridge(config, yamcs, service).run(once=True)
    held = client.archive("benchsat")
    assert held.samples == 200
    assert held.values["T_px"][7] == pytest.approx(px_degC(7) + 273.15)  # °C of the mission, K of the twin
    assert held.values["T_tank"][7] == 15.0
    assert held.values["Q_px"][7] == pytest.approx(0.5)  # mW and W
    assert dict(published(yamcs, "health"))  # without a model it says so
    assert {value for _, value in published(yamcs, "health")} == {"NO_MODEL"}

    client.wait("benchsat", client.calibrate("benchsat"))
    with running(make_bridge(config, yamcs, service)):
        feed(yamcs, 200, 230)
        until(lambda: len(published(yamcs, "T_px/residual")) == 230, "all residuals are there")
        until(lambda: len(events(yamcs)) >= 3, "the anomaly began and ended")
        until(lambda: published(yamcs, "T_px/forecast"), "a forecast is there")
    residuals = client.residuals("benchsat").model_dump()
    rows = published(yamcs, "T_px/residual")
    assert_once_each(rows, range(230))
    np.testing.assert_allclose([value for _, value in rows], residuals["residual_K"]["T_px"])
    np.testing.assert_allclose([v for _, v in published(yamcs, "T_px/residual_sigma")], residuals["std_K"]["T_px"])
    assert {value for _, value in published(yamcs, "model_version")} == {1}
    expected = published(yamcs, "T_px/forecast")
    times = [time_ms for time_ms, _ in expected]
    assert len(set(times)) == len(times) and max(times) > T0_MS + 229 * STEP_MS + 3_000_000
    low, high = (dict(published(yamcs, f"T_px/{q}")) for q in ("q05", "q95"))
    assert all(low[time_ms] < value < high[time_ms] for time_ms, value in expected)
    said = {event.event_type: event for event in events(yamcs)}
    assert said["ANOMALY"].severity == "WARNING" and "T_px" in said["ANOMALY"].message
    (anomaly, *_) = client.anomalies("benchsat")
    assert said["ANOMALY"].generation_time.isoformat() == anomaly.start.replace("Z", "+00:00")
    assert said["MODEL"].severity == "INFO"


def test_a_second_bridge_repeats_nothing(
    yamcs: Yamcs, service: Server, client: TwinClient, config: YamcsConfig
) -> None:
    feed(yamcs, 0, 200)
    make_bridge(config, yamcs, service).run(once=True)
    client.wait("benchsat", client.calibrate("benchsat"))
    until(lambda: not client.twin("benchsat").catching_up, "the model has followed")
    first = make_bridge(config, yamcs, service).run(once=True)
    before = {name: published(yamcs, name) for name in ("T_px/residual", "T_px/forecast", "nis")}
    second = make_bridge(config, yamcs, service).run(once=True)
    assert first.residual_rows == 200 and first.forecast_rows > 0 and first.events > 0
    assert (second.residual_rows, second.forecast_rows, second.events, second.accepted) == (0, 0, 0, 0)
    assert before == {name: published(yamcs, name) for name in before}
    assert len({event.extra["key"] for event in events(yamcs)}) == len(events(yamcs))


@pytest.mark.parametrize("crash", [False, True], ids=["stopped", "killed"])
def test_yamcs_goes_and_comes_back(
    yamcs: Yamcs, service: Server, client: TwinClient, config: YamcsConfig, crash: bool
) -> None:
    feed(yamcs, 0, 100)
    make_bridge(config, yamcs, service).run(once=True)
    client.wait("benchsat", client.calibrate("benchsat"))
    heard: list[str] = []
    with running(make_bridge(config, yamcs, service, heard)):
        until(lambda: len(published(yamcs, "nis")) == 100, "the first residuals are there")
        (yamcs.kill if crash else yamcs.stop)()
        until(lambda: any("Yamcs at" in sentence for sentence in heard), "the loss is told")
        values = {"T_px": [px_degC(k) + 273.15 for k in range(100, 120)], "T_tank": [15.0] * 20, "Q_px": [0.5] * 20}
        times = [(T0_MS + k * STEP_MS) / 1000 for k in range(100, 120)]
        client.ingest("benchsat", times, values)  # by another way, while Yamcs is away
        yamcs.start()
        feed(yamcs, 120, 140)
        until(lambda: len(published(yamcs, "nis")) >= 140, "all residuals are there")
    assert_once_each(published(yamcs, "nis"), range(140))
    assert_once_each(published(yamcs, "T_px/residual"), range(140))
    assert client.twin("benchsat").samples == 140


def test_the_service_goes_and_comes_back(
    yamcs: Yamcs, service: Server, client: TwinClient, config: YamcsConfig
) -> None:
    feed(yamcs, 0, 100)
    make_bridge(config, yamcs, service).run(once=True)
    client.wait("benchsat", client.calibrate("benchsat"))
    port = service.url.rsplit(":", 1)[1]
    service._environment["TWIN_PORT"] = port
    with running(make_bridge(config, yamcs, service)):
        until(lambda: len(published(yamcs, "nis")) == 100, "the first residuals are there")
        service.kill()
        feed(yamcs, 100, 130)
        until(lambda: "SERVICE_AWAY" in [v for _, v in published(yamcs, "health")], "Yamcs hears that the twin is away")
        service.start()
        until(lambda: len(published(yamcs, "nis")) >= 130, "what came meanwhile is fetched and answered")
    assert_once_each(published(yamcs, "nis"), range(130))
    assert service.client().twin("benchsat").samples == 130


def test_a_server_that_hangs_gets_nothing_twice(
    yamcs: Yamcs, service: Server, client: TwinClient, config: YamcsConfig
) -> None:
    feed(yamcs, 0, 60)
    make_bridge(config, yamcs, service).run(once=True)
    client.wait("benchsat", client.calibrate("benchsat"))
    with running(make_bridge(config, yamcs, service, timeout_s=1.0)) as bridge:
        until(lambda: len(published(yamcs, "nis")) == 60, "the first residuals are there")
        feed(yamcs, 60, 90)
        yamcs.freeze()
        time.sleep(4.0)  # several requests run out of time meanwhile
        yamcs.thaw()
        feed(yamcs, 90, 100)
        until(lambda: len(published(yamcs, "nis")) >= 100, "all residuals are there")
        until(lambda: bridge.tally.residual_rows >= 40, "the bridge knows")
    assert_once_each(published(yamcs, "nis"), range(100))
    assert_once_each(published(yamcs, "T_px/residual"), range(100))


def test_what_is_dumped_late_fills_the_gap(
    yamcs: Yamcs, service: Server, client: TwinClient, config: YamcsConfig
) -> None:
    often = config.model_copy(update={"backfill": config.backfill.model_copy(update={"every_s": 1.0})})
    feed(yamcs, 0, 60)
    make_bridge(often, yamcs, service).run(once=True)
    client.wait("benchsat", client.calibrate("benchsat"))
    with running(make_bridge(often, yamcs, service)):
        feed(yamcs, 100, 120)
        until(lambda: client.twin("benchsat").samples == 80, "what comes after the gap is there")
        feed(yamcs, 60, 100, stream="pp_dump")  # the recorder is read out; the processor never sees this
        until(lambda: client.twin("benchsat").samples == 120, "the gap is filled")
        until(lambda: len(published(yamcs, "nis")) >= 120, "and so are the residuals")
    assert_once_each(published(yamcs, "nis"), range(120))


def test_what_is_live_does_not_wait_for_the_archive(
    yamcs: Yamcs, service: Server, client: TwinClient, config: YamcsConfig
) -> None:
    from replay.bridges.yamcs_bridge import YamcsBridge
    from replay.bridges.yamcs_gateway import Row, YamcsGateway

    class SlowArchive(YamcsGateway):
        """Reads its archive slowly; notes which residuals are published meanwhile."""

        is_reading = False
        meanwhile: ClassVar[set[int]] = set()

        def history(self, *span: Any) -> Iterator[Row]:
            self.is_reading = True
            for row in super().history(*span):
                time.sleep(0.05)
                yield row
            self.is_reading = False

        def publish(self, stream: str, rows: Sequence[Row]) -> int:
            if self.is_reading:
                self.meanwhile.update(row.time_ms for row in rows if f"{TOP}/model_version" in row.values)
            return super().publish(stream, rows)

    often = config.model_copy(update={"backfill": config.backfill.model_copy(update={"every_s": 1.0})})
    feed(yamcs, 0, 60)
    make_bridge(often, yamcs, service).run(once=True)
    client.wait("benchsat", client.calibrate("benchsat"))
    slow = YamcsBridge(
        often, lambda: SlowArchive(yamcs.url, "sat"), service.client(), service.url, lambda _: None, poll_s=0.1
    )
    with running(slow):
        until(lambda: len(published(yamcs, "nis")) == 60, "the first residuals are there")
        for k in range(60, 100):
            feed(yamcs, k, k + 1)
            time.sleep(0.2)
        until(lambda: len(published(yamcs, "nis")) >= 100, "all residuals are there")
        until(lambda: SlowArchive.meanwhile, "residuals are published while the archive is read")
    assert_once_each(published(yamcs, "nis"), range(100))
    assert client.twin("benchsat").samples == 100


def test_wrong_credentials_are_told_and_right_ones_pass(
    make_yamcs: Callable[..., Yamcs],
    service: Server,
    config_file: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    yamcs = make_yamcs(guarded=True)
    command = ["bridge", "yamcs", "--url", yamcs.url, "--instance", "sat", "--config", str(config_file), "--once"]
    command += ["--service", service.url, "--user", USER]
    monkeypatch.setenv("YAMCS_PASSWORD", "wrong")
    assert main(command) == 2
    assert "refuses the credentials" in capsys.readouterr().err
    assert main(command[:-2]) == 2  # nobody
    assert "refuses the credentials" in capsys.readouterr().err
    monkeypatch.setenv("YAMCS_PASSWORD", PASSWORD)
    assert main([*command, "--json"]) == 0
    assert '"connections": 1' in capsys.readouterr().out


def test_every_fault_of_the_wiring_is_told_at_once(yamcs: Yamcs, service: Server, config: YamcsConfig) -> None:
    wrong = {"T_px": "/SAT/thermal/T_pz", "T_tank": "/SAT/eps/V_bus", "Q_px": "/SAT/eps/raw", "nobody": "/SAT/eps/Q_px"}
    bad = YamcsConfig.model_validate(config.model_dump() | {"parameters": wrong})
    with pytest.raises(BridgeError) as raised:
        make_bridge(bad, yamcs, service).run()
    told = str(raised.value)
    assert "/SAT/thermal/T_pz is unknown to the mission database" in told
    assert "/SAT/eps/V_bus is in V, channel 'T_tank' in degC" in told
    assert "/SAT/eps/raw has no unit in the mission database" in told
    assert "'nobody' is none of the twin" in told
    stated = {**wrong, "T_px": "/SAT/thermal/T_px", "T_tank": "/SAT/thermal/T_tank"}
    stated |= {"Q_px": {"name": "/SAT/eps/raw", "unit": "kW"}}
    del stated["nobody"]
    make_bridge(YamcsConfig.model_validate(config.model_dump() | {"parameters": stated}), yamcs, service).run(once=True)


def test_without_the_xtce_of_the_bridge_nothing_begins(yamcs: Yamcs, service: Server, config: YamcsConfig) -> None:
    elsewhere = config.model_copy(update={"system": "/ELSEWHERE"})
    with pytest.raises(BridgeError, match=r"such as /ELSEWHERE.* are unknown .* twin bridge xtce"):
        make_bridge(elsewhere, yamcs, service).run(once=True)


def test_nobody_there_is_one_line(service: Server, config_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["bridge", "yamcs", "--url", "http://127.0.0.1:9", "--instance", "sat", "--config", str(config_file)]
    assert main([*command, "--service", service.url, "--once"]) == 2
    told = capsys.readouterr().err
    assert "does not answer" in told and told.count("\n") == 1


def test_limits_of_the_mission_become_limits_of_the_twin(
    yamcs: Yamcs, config_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import yaml

    from tests.service.conftest import SPEC
    from twin_core.network.spec_io import load_spec

    (tmp_path / "sat.yaml").write_text(yaml.safe_dump(SPEC))
    command = ["bridge", "limits", "--url", yamcs.url, "--instance", "sat", "--config", str(config_file)]
    assert main([*command, "--spec", str(tmp_path / "sat.yaml"), "--out", str(tmp_path / "new.yaml")]) == 0
    spec = load_spec(tmp_path / "new.yaml")
    limits = spec.channels["T_px"].limits
    assert limits is not None
    assert limits.yellow == (263.15, 313.15) and limits.red == (253.15, 323.15)  # the twin's unit is K
    assert spec.channels["T_tank"].limits is None
    assert "WATCH not taken" in capsys.readouterr().err


def test_a_forecast_beyond_a_limit_is_an_alarm_of_yamcs(
    yamcs: Yamcs, service: Server, client: TwinClient, config: YamcsConfig
) -> None:
    """The twin's red limit, 320 K, stands in the XTCE of the bridge: Yamcs itself checks what is published."""
    from yamcs.client import YamcsClient

    from replay.bridges.yamcs_gateway import Row, YamcsGateway

    with YamcsGateway(yamcs.url, "sat") as gateway:
        gateway.publish(
            "pp_realtime", [Row(T0_MS, {f"{TOP}/T_px/forecast": 300.0}), Row(T0_MS + 1, {f"{TOP}/T_px/q95": 330.0})]
        )
    with closing(YamcsClient(yamcs.url)) as reader:
        alarms = reader.get_processor("sat", "realtime")
        until(lambda: list(alarms.list_alarms()), "there is an alarm")
        assert {(alarm.name, alarm.severity) for alarm in alarms.list_alarms()} == {(f"{TOP}/T_px/q95", "CRITICAL")}


def test_limits_exceeded_and_forecast_are_events(
    yamcs: Yamcs, service: Server, client: TwinClient, config: YamcsConfig
) -> None:
    """The workbench of these tests expects that the last reading stays; the red limit is 320 K, and 320 K is not beyond it."""
    from replay.bridges.yamcs_gateway import Row, YamcsGateway

    def send(first: int, stop: int, reading_K: float) -> None:
        other = {"/SAT/thermal/T_tank": 15.0, "/SAT/eps/Q_px": 500.0}
        rows = [
            Row(T0_MS + k * STEP_MS, {"/SAT/thermal/T_px": reading_K - 273.15, **other}) for k in range(first, stop)
        ]
        with YamcsGateway(yamcs.url, "sat") as gateway:
            gateway.publish("pp_realtime", rows)

    send(0, 59, 320.0)
    make_bridge(config, yamcs, service).run(once=True)
    client.wait("benchsat", client.calibrate("benchsat"))
    with running(make_bridge(config, yamcs, service)):
        send(59, 60, 320.0)
        until(lambda: "LIMIT_FORECAST" in {event.event_type for event in events(yamcs)}, "the forecast is told")
        assert "LIMIT" not in {event.event_type for event in events(yamcs)}
        send(60, 63, 321.0)
        until(lambda: "LIMIT" in {event.event_type for event in events(yamcs)}, "the limit is told")
        send(63, 66, 300.0)
        until(lambda: {"LIMIT_ENDED", "LIMIT_FORECAST_ENDED"} <= {e.event_type for e in events(yamcs)}, "both end")
    said = {event.event_type: event for event in events(yamcs)}
    assert said["LIMIT_FORECAST"].severity == "DISTRESS" and said["LIMIT"].severity == "CRITICAL"
    assert said["LIMIT"].generation_time.timestamp() * 1000 == T0_MS + 60 * STEP_MS
    assert said["LIMIT_ENDED"].severity == "INFO"


def test_the_service_may_be_away_at_first(yamcs: Yamcs, service: Server, config: YamcsConfig) -> None:
    service.kill()
    with pytest.raises(Away):
        make_bridge(config, yamcs, service).run(once=True)
