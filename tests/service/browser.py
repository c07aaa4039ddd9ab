"""A headless Chromium, spoken to over its own debugging protocol."""

import contextlib
import json
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any, Self

import httpx
from websockets.sync.client import connect

BINARY = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --disable-dev-shm-usage --remote-debugging-port=0"
).split()

TOASTS = """
window.toasts = [];
new MutationObserver((changes) => changes.forEach((change) => change.addedNodes.forEach((node) => {
  if (node.classList?.contains("toast")) window.toasts.push(node.textContent);
}))).observe(document, {childList: true, subtree: true});
"""
"""Remembers what a page says in passing: on a busy machine a toast has gone before anybody looks."""

DRAWN = """
window.drawn = new Set();
const write = CanvasRenderingContext2D.prototype.fillText;
CanvasRenderingContext2D.prototype.fillText = function (text, ...place) {
  window.drawn.add(String(text));
  return write.call(this, text, ...place);
};
"""
"""Remembers what is written on canvases, which nobody can ask afterwards."""


class Browser:
    """One page. Console errors and uncaught exceptions of the page are collected in ``troubles``."""

    def __init__(self, folder: Path, width: int = 1400, height: int = 1500) -> None:
        """Keep the profile in ``folder``."""
        self._folder, self._size = folder, (width, height)
        self._number = 0
        self.troubles: list[str] = []

    def __enter__(self) -> Self:
        """Start the browser."""
        assert BINARY is not None
        self._process = subprocess.Popen(
            [BINARY, *FLAGS, f"--user-data-dir={self._folder}", f"--window-size={self._size[0]},{self._size[1]}"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self._stack = contextlib.ExitStack()
        self._stack.callback(self._end)
        try:
            self._socket = self._stack.enter_context(connect(self._find_page(), max_size=None))
        except BaseException:
            self._stack.close()
            raise
        for domain in ("Page", "Runtime", "Log"):
            self.send(f"{domain}.enable")
        self.send("Page.addScriptToEvaluateOnNewDocument", source=TOASTS + DRAWN)
        self.resize(*self._size)
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        self._stack.close()

    def _end(self) -> None:
        self._process.terminate()
        self._process.wait(60)

    def _find_page(self) -> str:
        note = self._folder / "DevToolsActivePort"
        for _ in range(600):
            with contextlib.suppress(OSError, ValueError, LookupError, httpx.TransportError, StopIteration):
                port = int(note.read_text().splitlines()[0])
                pages = httpx.get(f"http://127.0.0.1:{port}/json", trust_env=False, timeout=60.0).json()
                page = next(item for item in pages if item["type"] == "page")
                return str(page["webSocketDebuggerUrl"])
            time.sleep(0.1)
        raise AssertionError("the browser does not start")

    def send(self, method: str, **parameters: Any) -> Any:
        """Send one command and return its result."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=60))
            if message.get("id") == self._number:
                assert "error" not in message, message
                return message["result"]
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        parameters = message.get("params", {})
        if message.get("method") == "Runtime.exceptionThrown":
            self.troubles.append(json.dumps(parameters["exceptionDetails"])[:500])
        elif message.get("method") == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.troubles.append(f"{parameters['entry']['text']} {parameters['entry'].get('url', '')}")
        elif message.get("method") == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "warning"):
            self.troubles.append(json.dumps(parameters["args"])[:500])

    def resize(self, width: int, height: int) -> None:
        """Change the size of the page."""
        self.send(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )

    def open(self, url: str) -> None:
        """Go to a page."""
        self.send("Page.navigate", url=url)
        self.until("document.readyState === 'complete'")

    def evaluate(self, expression: str) -> Any:
        """Return the value of an expression in the page."""
        found = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def until(self, expression: str, timeout_s: float = 60.0) -> None:
        """Return once an expression is true."""
        deadline_s = time.monotonic() + timeout_s
        while not self.evaluate(f"Boolean({expression})"):
            assert time.monotonic() < deadline_s, f"never true: {expression}; troubles: {self.troubles}"
            time.sleep(0.1)

    def until_told(self, text: str) -> None:
        """Return once a toast has said something."""
        self.until(f"window.toasts.some((toast) => toast.includes({json.dumps(text)}))")

    def until_drawn(self, text: str) -> None:
        """Return once something is written on a canvas."""
        self.until(f"window.drawn.has({json.dumps(text)})")

    def box(self, selector: str) -> tuple[float, float, float, float]:
        """Return left, top, width and height of an element."""
        x, y, width, height = self.evaluate(
            f"(() => {{const r = document.querySelector({json.dumps(selector)}).getBoundingClientRect();"
            " return [r.x, r.y, r.width, r.height]})()"
        )
        return x, y, width, height

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Send one mouse event."""
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, selector: str) -> None:
        """Click in the middle of an element with a real mouse event; again if the page moved it away just then."""
        found = f"document.querySelector({json.dumps(selector)})"
        self.until(found)
        for _ in range(50):
            self.evaluate(f"{found}.scrollIntoView({{block: 'center'}})")
            self.evaluate(
                "window.hit = false; document.addEventListener('click', (e) => "
                f"{{ window.hit ||= Boolean(e.target.closest({json.dumps(selector)})); }}, {{once: true, capture: true}})"
            )
            x, y, width, height = self.box(selector)
            for kind in ("mousePressed", "mouseReleased"):
                self.mouse(kind, x + width / 2, y + height / 2, button="left", clickCount=1)
            if self.evaluate("window.hit"):
                return
            time.sleep(0.1)
        raise AssertionError(f"{selector} cannot be clicked")

    def drag(self, selector: str, start: float, stop: float) -> None:
        """Drag over an element, between two shares of its width."""
        left, top, width, height = self.box(selector)
        y = top + height / 2
        first, middle, last = (left + share * width for share in (start, (start + stop) / 2, stop))
        self.mouse("mouseMoved", first, y)
        self.mouse("mousePressed", first, y, button="left", clickCount=1)
        for x in (middle, last):
            self.mouse("mouseMoved", x, y, button="left", buttons=1)
        self.mouse("mouseReleased", last, y, button="left", clickCount=1)

    def press(self, key: str) -> None:
        """Press and release a key."""
        self.send("Input.dispatchKeyEvent", type="keyDown", key=key, text=key if len(key) == 1 else "")
        self.send("Input.dispatchKeyEvent", type="keyUp", key=key)

    def text(self, selector: str) -> str:
        """Return what an element says."""
        return str(self.evaluate(f"document.querySelector({json.dumps(selector)}).innerText"))
