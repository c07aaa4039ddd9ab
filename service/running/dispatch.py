"""Sends what webhooks want to hear, signed, again and again until somebody takes it or it is given up."""

import asyncio
import contextlib
import hashlib
import hmac
import logging
import time
from collections import defaultdict
from typing import Any

from service.fleet.ownership import Ownership
from service.instants import now_us
from service.store import webhooks
from service.store.database import Database
from service.store.webhooks import Delivery, Webhook

log = logging.getLogger("service.webhooks")

LOOK_EVERY_S = 1.0
TIMEOUT_S = 10.0
FIRST_PAUSE_S, LONGEST_PAUSE_S = 5.0, 3600.0
ATTEMPTS = 12
"""Within some eight hours; then a delivery is dead."""
AT_ONCE = 50


def signature(secret: str, time_s: int, body: str) -> str:
    """Return the header ``Twin-Signature``: when it was signed, and the HMAC-SHA256 of that, a full stop and the body."""
    digest = hmac.new(secret.encode(), f"{time_s}.{body}".encode(), hashlib.sha256).hexdigest()
    return f"t={time_s},v1={digest}"


def pause_s(attempts: int) -> float:
    """Return how long to wait after so many attempts."""
    return float(min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2.0 ** (attempts - 1)))


class Dispatch:
    """Looks for deliveries and sends them; one that waits long holds up only others of its webhook."""

    def __init__(self, database: Database, ownership: Ownership) -> None:
        """Begin at once."""
        self._database, self._ownership = database, ownership
        self._http: Any = None
        self._task = asyncio.create_task(self._run())

    async def close(self) -> None:
        """Stop; what was not sent waits in the store."""
        self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task
        if self._http is not None:
            await self._http.aclose()

    async def _run(self) -> None:
        while True:
            try:
                found = await self._database.read(webhooks.due, AT_ONCE) if self._ownership.leads else []
                if found:
                    await self._send_all(found)
            except Exception as error:  # such as a full disk: what waits goes on waiting
                log.warning("webhooks are held up", extra={"reason": f"{type(error).__name__}: {error}"})
            await asyncio.sleep(LOOK_EVERY_S)

    async def _send_all(self, found: list[tuple[Delivery, Webhook]]) -> None:
        if self._http is None:
            import httpx

            self._http = httpx.AsyncClient(timeout=TIMEOUT_S, trust_env=False, follow_redirects=False)
        lines = defaultdict(list)
        for delivery, hook in found:
            lines[hook.id].append((delivery, hook))
        await asyncio.gather(*(self._send_in_order(line) for line in lines.values()))

    async def _send_in_order(self, line: list[tuple[Delivery, Webhook]]) -> None:
        for delivery, hook in line:
            reason = await self._send(delivery, hook)
            attempts = delivery.attempts + 1
            if not reason:
                outcome: tuple[Any, ...] = ("delivered", "", None)
            elif attempts >= ATTEMPTS:
                outcome = ("dead", reason, None)
                log.error("a webhook is given up", extra={"delivery": delivery.id, "url": hook.url, "reason": reason})
            else:
                outcome = ("waiting", reason, now_us() + round(1e6 * pause_s(attempts)))
            await self._database.write(webhooks.settle, delivery.id, *outcome)

    async def _send(self, delivery: Delivery, hook: Webhook) -> str:
        """Send one message; return what went wrong, empty if nothing did."""
        headers = {
            "Content-Type": "application/json",
            "User-Agent": "thermal-twin",
            "Twin-Event": delivery.type,
            "Twin-Delivery": str(delivery.id),
            "Twin-Signature": signature(hook.secret, int(time.time()), delivery.body),
        }
        try:
            response = await self._http.post(hook.url, content=delivery.body, headers=headers)
        except Exception as error:
            return f"{type(error).__name__}: {error}"[:300]
        return "" if response.is_success else f"answered {response.status_code}"
