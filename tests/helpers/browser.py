"""A headless browser, spoken to over its debugging pipe; nothing but the browser itself is needed.

Protocol: https://chromedevtools.github.io/devtools-protocol/ (messages of JSON, each ended by a zero byte).
"""

import base64
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--remote-debugging-pipe",
)
PATIENCE_S = 60.0
ARTIFACTS = Path(__file__).resolve().parents[2] / "ci-artifacts"
"""Screenshots are kept here, out of reach of git."""


class Chromium:
    """A running browser."""

    def __init__(self, program: str, profile: Path) -> None:
        read_theirs, self._write = os.pipe()
        self._read, write_theirs = os.pipe()
        # The browser reads from descriptor 3 and writes to 4, whatever these numbers are here.
        shell = f'exec "$0" "$@" 3<&{read_theirs} 4>&{write_theirs}'
        self._process = subprocess.Popen(
            ["bash", "-c", shell, program, *OPTIONS, f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(read_theirs, write_theirs),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(read_theirs)
        os.close(write_theirs)
        self._buffer = b""
        self._count = 0
        self.events: list[dict[str, Any]] = []

    def call(self, method: str, session: str = "", **parameters: Any) -> dict[str, Any]:
        """Send a command and return its result; events that come meanwhile are kept in ``events``."""
        self._count += 1
        message: dict[str, Any] = {"id": self._count, "method": method, "params": parameters}
        if session:
            message["sessionId"] = session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._count:
                assert "error" not in answer, f"{method}: {answer['error']}"
                result: dict[str, Any] = answer["result"]
                return result
            self.events.append(answer)

    def wait_for(self, method: str) -> None:
        """Wait until an event has come."""
        while not any(event.get("method") == method for event in self.events):
            self.events.append(self._next())

    def close(self) -> None:
        """End the browser."""
        try:
            self.call("Browser.close")
            self._process.wait(PATIENCE_S)
        except (OSError, AssertionError, TimeoutError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        os.close(self._write)
        os.close(self._read)

    def _next(self) -> dict[str, Any]:
        stop = time.monotonic() + PATIENCE_S
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._read], [], [], max(0.0, stop - time.monotonic()))
            if not ready:
                raise TimeoutError("the browser does not answer")
            part = os.read(self._read, 1 << 20)
            if not part:
                raise TimeoutError("the browser has ended")
            self._buffer += part
        text, self._buffer = self._buffer.split(b"\0", 1)
        message: dict[str, Any] = json.loads(text)
        return message


@dataclass
class OpenPage:
    """A page in a window of given size, and what happened while it was opened."""

    browser: Chromium
    session: str
    complaints: list[str] = field(default_factory=list)
    fetched: list[str] = field(default_factory=list)

    def evaluate(self, expression: str) -> Any:
        """Value of an expression of JavaScript in the page."""
        found = self.browser.call(
            "Runtime.evaluate", self.session, expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def screenshot(self, name: str) -> Path:
        """The whole page as ``ci-artifacts/<name>.png``."""
        shot = self.browser.call("Page.captureScreenshot", self.session, captureBeyondViewport=True)
        ARTIFACTS.mkdir(exist_ok=True)
        path = ARTIFACTS / f"{name}.png"
        path.write_bytes(base64.b64decode(shot["data"]))
        return path


@contextmanager
def open_page(
    path: Path, profile: Path, *, width: int, height: int = 900, decode: bool = True
) -> Iterator[OpenPage]:
    """Open a file in a window of the given size and decode its images; skips the test where there is no browser."""
    program = next((found for found in map(shutil.which, NAMES) if found), None)
    if program is None:
        pytest.skip(f"no browser here (looked for {', '.join(NAMES)})")
    browser = Chromium(program, profile)
    try:
        target = browser.call("Target.createTarget", url="about:blank")["targetId"]
        session = browser.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            browser.call(f"{domain}.enable", session)
        browser.call(
            "Emulation.setDeviceMetricsOverride",
            session,
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        browser.events.clear()
        browser.call("Page.navigate", session, url=path.resolve().as_uri())
        browser.wait_for("Page.loadEventFired")
        page = OpenPage(browser, session)
        if decode:
            page.evaluate("Promise.all([...document.images].map(image => image.decode()))")
        for event in browser.events:
            _note(page, event)
        yield page
    finally:
        browser.close()


def check_page(path: Path, profile: Path, width: int, name: str) -> None:
    """Demand that a page opens without complaint, fetches nothing and fits into the window; keep a screenshot."""
    with open_page(path, profile, width=width) as page:
        page.screenshot(name)
        assert page.complaints == []
        assert page.fetched == [path.resolve().as_uri()]
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.evaluate("[...document.images].every(image => image.naturalWidth > 0)")
        size = "parseFloat(getComputedStyle(document.body).fontSize)"
        assert page.evaluate(size) >= 16.0, "readable without enlarging"


def _note(page: OpenPage, event: dict[str, Any]) -> None:
    method, parameters = event.get("method"), event.get("params", {})
    if method == "Runtime.exceptionThrown":
        page.complaints.append(str(parameters["exceptionDetails"]))
    elif method == "Log.entryAdded":
        page.complaints.append(str(parameters["entry"]))
    elif method == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "warning", "assert"):
        page.complaints.append(str(parameters["args"]))
    elif method == "Network.requestWillBeSent":
        url = parameters["request"]["url"]
        if not url.startswith("data:"):
            page.fetched.append(url)
