"""Alarms as e-mail: webhooks of the service, Apprise itself as the relay, and a mail server that keeps what it is sent."""

import email
import email.policy
import http.server
import json
import socket
import threading
from collections.abc import Iterator
from email.message import EmailMessage
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

import aiosmtpd.controller
import apprise
import pytest

from service.running import dispatch
from tests.service.conftest import SPEC
from tests.service.fakes import FakeWorkbench
from tests.service.harness import until

# Apprise looks for a module that Python 3.13 no longer has.
pytestmark = pytest.mark.filterwarnings("ignore:'imghdr' is deprecated:DeprecationWarning")
TWIN = "/v1/twins/benchsat"
EXAMPLE = Path(__file__).parents[2] / "deploy" / "apprise" / "operators.yml"


class Mailbox:
    """What a mail server was sent; it refuses everything while ``is_full``."""

    def __init__(self) -> None:
        self.mails: list[EmailMessage] = []
        self.is_full = False
        self.refused = 0

    async def handle_DATA(self, server: Any, session: Any, envelope: Any) -> str:
        """Take one mail."""
        if self.is_full:
            self.refused += 1
            return "452 no room"
        made = email.message_from_bytes(envelope.content, policy=email.policy.default)
        assert isinstance(made, EmailMessage)
        self.mails.append(made)
        return "250 OK"


@pytest.fixture
def mailbox() -> Iterator[tuple[Mailbox, int]]:
    """A mail server on this machine, and its port."""
    box = Mailbox()
    with socket.socket() as probe:  # the controller connects to its own port at the start, so it must know it
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    server = aiosmtpd.controller.Controller(box, hostname="127.0.0.1", port=port)
    server.start()
    yield box, port
    server.stop()


@pytest.fixture
def relay(mailbox: tuple[Mailbox, int]) -> Iterator[str]:
    """The URL of what answers as Apprise's own server does: title, body and type go on, and 424 says that they did not."""
    relaying = apprise.Apprise()
    relaying.add(f"mailto://127.0.0.1:{mailbox[1]}?from=twin@example.org&to=team@example.org&mode=insecure")

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            sent = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            went = relaying.notify(sent.get("body"), title=sent.get("title", ""), notify_type=sent.get("type", "info"))
            self.send_response(200 if went else 424)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/notify/operators"
    server.shutdown()
    server.server_close()


def test_an_alarm_arrives_as_a_mail_and_waits_for_a_full_mailbox(
    make_client: Any, mailbox: tuple[Mailbox, int], relay: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dispatch, "LOOK_EVERY_S", 0.02)
    monkeypatch.setattr(dispatch, "FIRST_PAUSE_S", 0.01)
    box, _ = mailbox
    box.is_full = True
    client = make_client(FakeWorkbench)
    limits = {"red": [None, 295.0]}
    client.post("/v1/webhooks", json={"url": relay, "types": ["limit"]})
    limited = {**SPEC["channels"], "T_px": {**SPEC["channels"]["T_px"], "limits": limits}}
    client.post("/v1/twins", json={**SPEC, "channels": limited})
    client.post(f"{TWIN}/telemetry", json={"time": [0, 1, 2], "values": {"T_px": [296.0] * 3}})
    until(lambda: box.refused)
    box.is_full = False
    until(lambda: box.mails)
    (mail,) = box.mails
    assert mail["Subject"] == "benchsat: T_px is above its red limit of 295 K: 296 at worst"
    assert "team@example.org" in mail["To"] and "twin@example.org" in mail["From"]
    text = mail.get_body(("plain", "html"))
    assert text is not None and "T_px is above its red limit of 295 K" in text.get_content()
    until(lambda: client.get("/v1/webhooks/deliveries?state=delivered").json()["deliveries"])


def test_the_example_is_one_that_apprise_takes() -> None:
    config = apprise.AppriseConfig()
    assert config.add(str(EXAMPLE))
    (receiver,) = config.services()
    url = urlsplit(receiver.url())
    assert (url.scheme, url.hostname) == ("mailtos", "mail.example.org")
    assert unquote(url.path) == "/team@example.org" and parse_qs(url.query)["from"] == ["twin@example.org"]
