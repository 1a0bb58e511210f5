"""A headless Chromium over its debugging pipe; needs nothing but the browser itself."""

import base64
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest


_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",  # WebGL without a graphics card
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-extensions",
    "--disable-dev-shm-usage",
    "--remote-debugging-pipe",
)


class Page:
    """One open page: what it logged, what it asked the network for, and its controls.

    Attributes:
        errors: messages of the console at level error or warning, and exceptions.
        requests: addresses of all requests but that of the page itself.
    """

    def __init__(self, to_browser: int, from_browser: int):
        self._out, self._in = to_browser, from_browser
        self._buffer, self._count = b"", 0
        self._session: str | None = None
        self.errors: list[str] = []
        self.requests: list[str] = []

    def open(
        self, path: Path, width: int = 1000, height: int = 640, dark: bool = False
    ) -> None:
        """Opens a page from disk and waits until its programs say that it is ready."""
        if self._session is None:
            target = self._call("Target.createTarget", url="about:blank")["targetId"]
            answer = self._call("Target.attachToTarget", targetId=target, flatten=True)
            self._session = answer["sessionId"]
            for domain in ("Page", "Runtime", "Log", "Network"):
                self._call(f"{domain}.enable")
        self.errors, self.requests = [], []
        self._call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self._call("Emulation.setEmulatedMedia", features=[scheme])
        self._call("Page.navigate", url=path.absolute().as_uri())
        self.wait("document.body && document.body.dataset.ready === 'yes'")
        self.settle()

    def run(self, script: str) -> Any:
        """The value of a JavaScript expression; promises are awaited."""
        answer = self._call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in answer:
            raise AssertionError(f"{script}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def wait(self, condition: str, seconds: float = 60.0) -> None:
        """Waits until a JavaScript condition holds."""
        end = time.monotonic() + seconds
        while not self.run(f"Boolean({condition})"):
            if time.monotonic() > end:
                raise AssertionError(f"never true: {condition}; {self.errors}")
            time.sleep(0.05)

    def click(self, selector: str) -> None:
        """Clicks the first element, and waits for what it sets off to be drawn."""
        self.run(
            f"document.querySelector({json.dumps(selector)}).dispatchEvent("
            "new MouseEvent('click', {bubbles: true, cancelable: true}))"
        )
        self.settle()

    def settle(self) -> None:
        """Waits for a few drawn frames."""
        frame = "new Promise(done => requestAnimationFrame(done))"
        self.run(f"(async () => {{ for (let k = 0; k < 3; k++) await {frame}; }})()")

    def picture(self, path: Path, whole: bool = False) -> None:
        """Saves a PNG of what is seen, or of the whole page."""
        shot = self._call(
            "Page.captureScreenshot", format="png", captureBeyondViewport=whole
        )
        path.write_bytes(base64.b64decode(shot["data"]))

    def _call(self, method: str, **params: Any) -> dict[str, Any]:
        self._count += 1
        message: dict[str, Any] = {
            "id": self._count,
            "method": method,
            "params": params,
        }
        if self._session is not None:
            message["sessionId"] = self._session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self._out, data) :]
        while True:
            answer = self._read()
            if answer.get("id") == self._count:
                if "error" in answer:
                    raise AssertionError(f"{method}: {answer['error']}")
                return answer["result"]
            self._note(answer.get("method"), answer.get("params", {}))

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            block = os.read(self._in, 1 << 20)
            if not block:
                raise AssertionError("the browser went away")
            self._buffer += block
        text, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(text)

    def _note(self, event: str | None, params: dict[str, Any]) -> None:
        if event == "Runtime.exceptionThrown":
            self.errors.append(str(params["exceptionDetails"]))
        elif event == "Runtime.consoleAPICalled":
            if params["type"] in ("error", "warning", "assert"):
                self.errors.append(str([a.get("value") for a in params["args"]]))
        elif event == "Log.entryAdded":
            if params["entry"]["level"] == "error":
                self.errors.append(params["entry"]["text"])
        elif event == "Network.requestWillBeSent":
            url = params["request"]["url"]
            if params.get("type") != "Document" and not url.startswith("data:"):
                self.requests.append(url)


@contextmanager
def browser(folder: Path) -> Iterator[Page]:
    """Starts Chromium with an empty profile in `folder`; skips where there is none."""
    found = next(filter(None, map(shutil.which, _NAMES)), None)
    if found is None:
        pytest.skip("no Chromium on this machine: the page was not looked at")
    command_read, command_write = os.pipe()
    answer_read, answer_write = os.pipe()
    # Chromium reads its orders from descriptor 3 and answers on descriptor 4.
    start = (
        f"import os, sys; os.dup2({command_read}, 3); os.dup2({answer_write}, 4);"
        "os.execv(sys.argv[1], sys.argv[1:])"
    )
    command = [sys.executable, "-I", "-S", "-c", start, found]
    process = subprocess.Popen(
        [*command, *_FLAGS, f"--user-data-dir={folder}"],
        pass_fds=(command_read, answer_write),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(command_read)
    os.close(answer_write)
    try:
        yield Page(command_write, answer_read)
    finally:
        process.terminate()
        process.wait(timeout=30)
        os.close(command_write)
        os.close(answer_read)
