"""Keys that change, the audit log, webhooks, backups: what an operator relies on for years."""

import asyncio
import hashlib
import hmac
import http.server
import json
import os
import signal
import sqlite3
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from replay.cli.main import main
from service.errors import Refusal
from service.http.auth import Gate
from service.keys import Key, Keys, Role
from service.live.silence import Silence
from service.monitoring.logs import JsonLines
from service.running import dispatch
from service.settings import SettingsError, read_settings
from service.store import audit, schema
from service.store.database import Database
from service.store.sqlite import copies
from tests.service.conftest import SPEC, Sql
from tests.service.fakes import FakeWorkbench
from tests.service.harness import AppClient, until
from tests.service.server import FAKE, Server
from tests.service.test_jobs import finish

TWIN = "/v1/twins/benchsat"


def ask(client: AppClient, key: str, method: str = "GET", path: str = "/v1/twins", **more: Any) -> Any:
    return client.request(method, path, headers={"Authorization": f"Bearer {key}"}, **more)


@pytest.fixture
def key_file(tmp_path: Path) -> Path:
    path = tmp_path / "keys"
    hashed = hashlib.sha256(b"anna-secret").hexdigest()
    path.write_text(
        f"# who\nanna operate sha256:{hashed}\nben ingest ben-secret\nold read old-secret 2001-01-01T00:00:00Z\n"
    )
    return path


def test_keys_have_names_expire_and_change_without_a_restart(
    make_client: Any, key_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.keys.LOOK_EVERY_S", 0.0)
    client = make_client(api_keys_file=key_file, api_keys="read:r-key")
    assert [ask(client, key).status_code for key in ("anna-secret", "ben-secret", "r-key")] == [200, 200, 200]
    assert [ask(client, key).status_code for key in ("old-secret", "sha256:", "")] == [401, 401, 401]
    assert ask(client, "anna-secret", "POST", json=SPEC).status_code == 201
    assert ask(client, "ben-secret", "POST", json=SPEC).status_code == 403
    key_file.write_text("carla read carla-secret\n")
    assert [ask(client, key).status_code for key in ("carla-secret", "anna-secret")] == [200, 401]
    key_file.write_text("nonsense\n")
    assert ask(client, "carla-secret").status_code == 200  # what cannot be read changes nothing


@pytest.mark.parametrize(
    "line", ["a b c", "a read", "a read k 3 4", "a read k never", "a read sha256:xyz", "a read k\nb read k"]
)
def test_a_malformed_file_of_keys_is_refused_without_showing_them(tmp_path: Path, line: str) -> None:
    (tmp_path / "keys").write_text(line)
    with pytest.raises(SettingsError, match=r"TWIN_API_KEYS_FILE: .*line \d") as caught:
        read_settings(api_keys_file=tmp_path / "keys").keys  # noqa: B018
    assert " k" not in str(caught.value).partition("line")[2].replace(" key", "").replace("keys", "")


def test_every_change_and_every_refused_key_is_on_record(make_client: Any, key_file: Path) -> None:
    client = make_client(api_keys_file=key_file)
    ask(client, "anna-secret", "POST", json=SPEC)
    ask(client, "ben-secret", "POST", f"{TWIN}/telemetry", json={"time": [1], "values": {"T_px": [290.0]}})
    ask(client, "ben-secret", "DELETE", TWIN)
    ask(client, "guessed", path="/v1/twins?access_token=guessed")
    assert "'old' has expired" in ask(client, "old-secret").json()["detail"]
    ask(client, "anna-secret", "DELETE", f"{TWIN}/telemetry", params={"start": 0})
    assert ask(client, "ben-secret", path="/v1/audit").status_code == 403
    lines = ask(client, "anna-secret", path="/v1/audit").json()["audit"]
    told = [(line["who"], line["method"], line["path"], line["status"]) for line in reversed(lines)]
    assert told == [
        ("anna", "POST", "/v1/twins", 201),
        ("ben", "DELETE", TWIN, 403),
        ("unknown", "GET", "/v1/twins", 401),
        ("old", "GET", "/v1/twins", 401),
        ("anna", "DELETE", f"{TWIN}/telemetry", 200),
        ("ben", "GET", "/v1/audit", 403),
    ]
    assert lines[1]["detail"] == "start=0" and "guessed" not in json.dumps(lines)
    older = ask(client, "anna-secret", path="/v1/audit", params={"limit": 1, "before": lines[0]["id"]}).json()["audit"]
    assert older == lines[1:2]


def test_the_audit_says_what_was_changed(client: AppClient) -> None:
    changed = {**SPEC, "channels": {**SPEC["channels"], "T_new": {"kind": "temperature", "unit": "K"}}}
    client.post("/v1/twins", json=SPEC)
    client.post("/v1/twins", json=changed)  # refused: another one under its id
    client.request("PUT", TWIN, json=changed)
    client.request("PUT", TWIN, json=changed)
    client.request("PUT", f"{TWIN}/retention", json={"samples_days": 30, "jobs": 9})
    client.request("PUT", f"{TWIN}/retention", json={"samples_days": 1})
    hook = {"url": "https://u:p4ss@chat.example.org:8443/h/t0ken", "types": ["limit", "stale"], "secret": "s" * 20}
    number = client.post("/v1/webhooks", json=hook).json()["id"]
    client.delete(f"/v1/webhooks/{number}")
    lines = client.get("/v1/audit").json()["audit"]
    assert [line["detail"] for line in reversed(lines)] == [
        "benchsat, revision 1",
        "benchsat",
        "benchsat, revision 2",
        "benchsat, revision 2 as before",
        "samples_days all -> 30, jobs all -> 9",
        "samples_days 30 -> 1, jobs 9 -> all",
        f"webhook {number} at chat.example.org: limit, stale",
        f"webhook {number} at chat.example.org: limit, stale",
    ]


def test_the_audit_says_which_model_and_which_job(make_client: Any) -> None:
    client = make_client(FakeWorkbench)
    client.post("/v1/twins", json=SPEC)
    values = {"T_px": [296.0] * 30, "T_tank": [15.0] * 30, "Q_px": [0.5] * 30}
    client.post(f"{TWIN}/telemetry", json={"time": list(range(30)), "values": values})
    jobs = []
    for _ in range(2):
        made = client.post(f"{TWIN}/calibrations", json={"activate": False})
        jobs.append(f"calibration {made.json()['id']}")
        finish(client, made.headers["Location"])
    for version in (1, 2):
        client.post(f"{TWIN}/models/{version}/activate")
    lines = client.get("/v1/audit").json()["audit"]
    told = ["version none -> 1", "version 1 -> 2"]
    assert [line["detail"] for line in reversed(lines)][1:] == [*jobs, *told]


def test_strangers_cannot_fill_the_audit_log(make_client: Any) -> None:
    client = make_client(api_keys="operate:o")
    for _ in range(200):
        ask(client, "guess")
    assert 1 < len(ask(client, "o", path="/v1/audit", params={"limit": 1000}).json()["audit"]) <= 121


def test_keys_in_queries_are_not_logged() -> None:
    import logging

    record = logging.LogRecord(
        "uvicorn.error", 20, "", 0, '%s - "WebSocket %s" 403', ("1.2.3.4", "/x?access_token=k"), None
    )
    assert "access_token" not in JsonLines().format(record) and "WebSocket /x?" in JsonLines().format(record)


@pytest.mark.e2e
def test_a_hangup_reads_the_keys_again_and_ends_nothing(tmp_path: Path, key_file: Path) -> None:
    with Server(tmp_path, api_keys_file=str(key_file)) as server:
        assert server.client("anna-secret").register(SPEC).id == "benchsat"
        key_file.write_text("dora operate dora-secret\n")
        os.kill(server.process.pid, signal.SIGHUP)
        until(lambda: "dora" in server.log())
        assert server.client("dora-secret").twin("benchsat").id == "benchsat"
        assert server.process.poll() is None


class Receiver:
    """A server that keeps what it is sent, and answers as it is told to."""

    def __init__(self) -> None:
        self.heard: list[tuple[dict[str, str], bytes]] = []
        self.status = 200
        outer = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                outer.heard.append((dict(self.headers), body))
                self.send_response(outer.status)
                self.end_headers()

            def log_message(self, *_: Any) -> None:
                pass

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/hook"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    made = Receiver()
    yield made
    made.server.shutdown()
    made.server.server_close()


def test_webhooks_are_signed_tried_again_and_given_up(
    make_client: Any, receiver: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dispatch, "LOOK_EVERY_S", 0.02)
    monkeypatch.setattr(dispatch, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(dispatch, "ATTEMPTS", 3)
    client = make_client(FakeWorkbench)
    made = client.post("/v1/webhooks", json={"url": receiver.url}).json()
    assert "secret" not in client.get("/v1/webhooks").json()["webhooks"][0]
    client.post("/v1/twins", json={**SPEC, "twin": "another"})
    client.post("/v1/webhooks", json={"url": receiver.url, "twins": ["another"]})
    client.post("/v1/webhooks", json={"url": receiver.url, "types": ["job_failed"]})
    limits = {"yellow": [None, 295.0]}
    limited = {**SPEC, "channels": {**SPEC["channels"], "T_px": {**SPEC["channels"]["T_px"], "limits": limits}}}
    client.post("/v1/twins", json=limited)
    values = {"T_px": [296.0] * 30, "T_tank": [15.0] * 30, "Q_px": [0.5] * 30}
    client.post(f"{TWIN}/telemetry", json={"time": list(range(30)), "values": values})
    until(lambda: receiver.heard)
    headers, body = receiver.heard[0]
    sent = json.loads(body)
    assert (sent["event"], sent["twin"], sent["type"]) == ("limit", "benchsat", "warning")
    assert "yellow limit of 295 K" in sent["body"] and sent["message"]["alarm"]["channel"] == "T_px"
    stamp, _, digest = headers["Twin-Signature"].partition(",v1=")
    text = f"{stamp.removeprefix('t=')}.".encode() + body
    assert digest == hmac.new(made["secret"].encode(), text, hashlib.sha256).hexdigest()

    receiver.status = 503
    finish(client, client.post(f"{TWIN}/calibrations", json={}).headers["Location"])
    dead = "/v1/webhooks/deliveries?state=dead"
    until(lambda: client.get(dead).json()["deliveries"])
    (delivery,) = client.get(dead).json()["deliveries"]
    assert (delivery["event"], delivery["attempts"], delivery["reason"]) == ("model", 3, "answered 503")
    receiver.status = 204
    n_heard = len(receiver.heard)
    assert client.post(f"/v1/webhooks/deliveries/{delivery['id']}/retry").json()["state"] == "waiting"
    until(lambda: not client.get(dead).json()["deliveries"] and len(receiver.heard) > n_heard)
    assert json.loads(receiver.heard[-1][1])["title"] == "benchsat: model version 1 (calibration) is active"
    assert client.delete("/v1/webhooks/1").status_code == 204
    assert client.delete("/v1/webhooks/1").status_code == 404
    assert client.get("/v1/webhooks/deliveries").json()["deliveries"] == []


NO_URLS = [
    "ftp://x/y",
    "nowhere",
    "http://",
    "http://a b",
    "http://a/b c",
    "http://a:x",
    "http://[::1",
    "https:a",
    "http:///x",
]


@pytest.mark.parametrize("url", NO_URLS)
def test_webhooks_lead_somewhere(client: AppClient, url: str) -> None:
    refused = client.post("/v1/webhooks", json={"url": url})
    assert refused.status_code == 422 and [error["field"] for error in refused.json()["errors"]] == ["url"]


def test_webhooks_hear_of_twins_that_exist(registered: AppClient) -> None:
    hook = {"url": "http://127.0.0.1:9/hook?a=b"}
    refused = registered.post("/v1/webhooks", json={**hook, "twins": ["benchsat", "nope"]})
    assert refused.status_code == 422 and [error["field"] for error in refused.json()["errors"]] == ["twins[1]"]
    assert "'nope'" in refused.json()["detail"]
    for none in ({"twins": []}, {"types": []}):
        assert registered.post("/v1/webhooks", json=hook | none).status_code == 422
    made = registered.post("/v1/webhooks", json={**hook, "twins": ["benchsat"]})
    assert made.status_code == 201 and made.json()["url"] == hook["url"]


def test_silence_is_told_once_and_ends(registered: AppClient, sql: Sql) -> None:
    service = registered.app.state.service

    async def look() -> None:
        silence = Silence(service.registry, service.live, service.hub)
        await silence.close()
        entry = service.registry.get("benchsat")
        now = time.time()
        for _ in range(2):
            await silence.look(entry)
        await service.intake.store(entry, batch(now))
        await silence.look(entry)
        await silence.look(entry)

    def batch(now: float) -> Any:
        import numpy as np

        from service.store.batch import Batch

        return Batch(np.array([int(now * 1e6)]), np.array([[290.0], [15.0], [1.0]]))

    registered.post(f"{TWIN}/telemetry", json={"time": [1, 2], "values": {"T_px": [290.0, 290.0]}})
    service.live._pulses.clear()
    sql("UPDATE chunk SET received = time")  # as if it had been received long ago
    registered.portal.call(look)
    rows = [json.loads(body) for (body,) in sql("SELECT body FROM event WHERE type = 'stale' ORDER BY seq")]
    assert [(row["state"], row["channels"]) for row in rows] == [("stale", ["T_px"]), ("live", ["T_px"])]
    assert rows[0]["text"].startswith("no telemetry of T_px for")


def test_inputs_that_fall_silent_are_told_as_well_but_no_setting_that_was_sent_once(
    registered: AppClient, sql: Sql
) -> None:
    service = registered.app.state.service

    async def look() -> None:
        silence = Silence(service.registry, service.live, service.hub)
        await silence.close()
        await silence.look(service.registry.get("benchsat"))

    now = time.time()
    for times in ([now - 200.0], [now - 198.0, now - 199.0]):
        registered.post(f"{TWIN}/telemetry", json={"time": times, "values": {"Q_px": [0.5] * len(times)}})
        service.live._pulses.clear()
        sql("UPDATE chunk SET received = time")
        registered.portal.call(look)
        rows = [json.loads(body) for (body,) in sql("SELECT body FROM event WHERE type = 'stale' ORDER BY seq")]
        assert [row["channels"] for row in rows] == ([] if len(times) == 1 else [["Q_px"]])
    assert rows[0]["text"].startswith("no telemetry of Q_px for 3 min")


@pytest.mark.e2e
def test_a_backup_is_taken_while_serving_and_can_be_restored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "twin.sqlite3"
    copy = tmp_path / "copy.sqlite3"
    with Server(tmp_path, command=FAKE) as server:
        client = server.client()
        client.register(SPEC)
        done = threading.Event()
        sent = []

        def send() -> None:
            while not done.is_set():
                first = len(sent)
                client.ingest("benchsat", [float(first)], {"T_px": [290.0]})
                sent.append(first)

        thread = threading.Thread(target=send)
        thread.start()
        until(lambda: len(sent) > 50)
        before = len(sent)
        assert main(["backup", str(copy), "--database", str(path), "--json"]) == 0
        taken = json.loads(capsys.readouterr().out)
        done.set()
        thread.join()
        assert before <= taken["samples"] <= len(sent)
        assert main(["backup", str(copy), "--database", str(path)]) == 2  # nothing is written over
        assert (
            main(["restore", str(copy), "--database", str(path)]) == 2 and "another server" in capsys.readouterr().err
        )
        assert (
            main(["migrate", "--rehearse", "--database", str(path)]) == 0 and "nothing to do" in capsys.readouterr().out
        )
    assert main(["restore", str(copy), "--database", str(path), "--json"]) == 0
    former = Path(json.loads(capsys.readouterr().out)["former"])
    assert former.exists()
    with Server(tmp_path, command=FAKE) as server:
        assert server.client().twin("benchsat").samples == taken["samples"]
        assert server.client().ingest("benchsat", [0.0], {"T_px": [290.0]}).duplicates == 1
    copy.write_bytes(copy.read_bytes()[:-8192])
    assert main(["restore", str(copy), "--database", str(path)]) == 2 and "damaged" in capsys.readouterr().err


def test_a_migration_is_rehearsed_and_leaves_the_file_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "twin.sqlite3"
    with sqlite3.connect(path, isolation_level=None) as connection:
        connection.execute("CREATE TABLE migration (name TEXT PRIMARY KEY, at TEXT DEFAULT CURRENT_TIMESTAMP)")
        for name, script in schema.STEPS[:3]:
            connection.executescript(script)
            connection.execute("INSERT INTO migration (name) VALUES (?)", (name,))
    connection.close()
    held = path.read_bytes()
    assert main(["migrate", "--rehearse", "--database", str(path), "--json"]) == 0
    tried = json.loads(capsys.readouterr().out)
    assert tried["steps"] == [name for name, _ in schema.STEPS[3:]] and tried["rehearsed"]
    assert path.read_bytes() == held
    assert main(["migrate", "--database", str(path)]) == 0
    capsys.readouterr()
    assert main(["migrate", "--rehearse", "--database", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == []
    assert main(["migrate", "--database", str(tmp_path / "none.sqlite3")]) == 2


def test_only_the_owner_reads_the_database_and_its_copies(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, copy, elsewhere = (tmp_path / name for name in ("twin.sqlite3", "copy.sqlite3", "elsewhere.sqlite3"))
    former = os.umask(0o022)
    try:
        database = Database(path)
        database.submit(audit.append, 1, "anna", "POST", "/v1/twins", 201, "", "").result()
        copies.backup(path, copy)
        made = [path, *(path.with_name(path.name + suffix) for suffix in ("-wal", "-shm", ".lock")), copy]
        assert [oct(one.stat().st_mode & 0o777) for one in made] == [oct(0o600)] * len(made)
        database.close()
        copies.restore(copy, elsewhere)
        assert elsewhere.stat().st_mode & 0o777 == 0o600 and not caplog.records
        path.chmod(0o640)
        Database(path).close()  # somebody may have meant it
        assert path.stat().st_mode & 0o777 == 0o640
    finally:
        os.umask(former)
    (told,) = caplog.records
    assert "webhooks" in told.message and told.mode == "0640"  # type: ignore[attr-defined]


@pytest.mark.parametrize("url", ["sqlite:///:memory:", "sqlite:///file:x?mode=memory"])
def test_a_database_in_memory_is_refused(url: str) -> None:
    with pytest.raises(SettingsError, match="TWIN_DATABASE_URL: must name a file"):
        read_settings(database_url=url)


@pytest.mark.e2e
def test_a_specification_is_registered_and_changed_from_a_shell(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import yaml

    spec = tmp_path / "spec.yaml"
    spec.write_text(yaml.safe_dump(SPEC))
    with Server(tmp_path, command=FAKE) as server:
        assert main(["register", str(spec), "--url", server.url]) == 0
        assert "benchsat: revision 1, 3 channels" in capsys.readouterr().out
        grown = {**SPEC, "channels": {**SPEC["channels"], "Q_new": {"kind": "power", "unit": "W"}}}
        spec.write_text(yaml.safe_dump(grown))
        assert main(["register", str(spec), "--url", server.url]) == 2 and "--update" in capsys.readouterr().err
        assert main(["register", str(spec), "--url", server.url, "--update", "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["revision"] == 2
    assert main(["register", str(spec), "--url", "http://127.0.0.1:1"]) == 2


def test_refusals_know_no_http() -> None:
    assert not hasattr(Refusal("x"), "status")


@pytest.mark.parametrize(("expires_us", "role"), [(None, Role.operate), (1, None)])
def test_an_expired_key_carries_no_role_to_what_is_open(expires_us: int | None, role: Role | None) -> None:
    seen: list[Any] = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        seen.append(scope["state"]["role"])

    key = Key("anna", Role.operate, hashlib.sha256(b"secret").digest(), expires_us)
    scope = {"type": "http", "path": "/healthz", "headers": [(b"authorization", b"Bearer secret")]}
    asyncio.run(Gate(app, Keys([key]))(scope, None, None))  # type: ignore[arg-type]
    assert seen == [role]
