"""A headless Chromium, driven by playwright."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest


_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
_FLAGS = (
    "--no-sandbox",
    "--enable-unsafe-swiftshader",  # WebGL without a graphics card
    "--disable-dev-shm-usage",
)


class Page:
    """One page: what it logged, what it asked the network for, and its controls.

    Attributes:
        errors: messages of the console at level error or warning, and exceptions.
        requests: addresses of all requests but that of the page itself.
    """

    def __init__(self, browser: Any):
        self._browser, self._page = browser, None
        self.errors: list[str] = []
        self.requests: list[str] = []

    def open(
        self, path: Path, width: int = 1000, height: int = 640, dark: bool = False
    ) -> None:
        """Opens a page from disk and waits until its programs say that it is ready."""
        if self._page is not None:
            self._page.context.close()
        self._page = page = self._browser.new_page(
            viewport={"width": width, "height": height},
            is_mobile=width < 600,
            has_touch=width < 600,
            color_scheme="dark" if dark else "light",
        )
        self.errors, self.requests = [], []
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("console", self._hear)
        page.on("request", self._note)
        page.goto(path.absolute().as_uri())
        page.wait_for_function("document.body.dataset.ready === 'yes'", timeout=60_000)
        self.settle()

    def run(self, script: str) -> Any:
        """The value of a JavaScript expression; promises are awaited."""
        assert self._page is not None
        return self._page.evaluate(script)

    def click(self, selector: str) -> None:
        """Clicks the first element, and waits for what it sets off to be drawn."""
        assert self._page is not None
        self._page.locator(selector).first.dispatch_event("click")
        self.settle()

    def settle(self) -> None:
        """Waits for a few drawn frames."""
        frame = "new Promise(done => requestAnimationFrame(done))"
        self.run(f"(async () => {{ for (let k = 0; k < 3; k++) await {frame}; }})()")

    def picture(self, path: Path) -> None:
        """Saves a PNG of what is seen."""
        assert self._page is not None
        self._page.screenshot(path=path)

    def _hear(self, message: Any) -> None:
        # A warning without arguments is the browser's own advice.
        if message.type == "error" or (message.type == "warning" and message.args):
            self.errors.append(message.text)

    def _note(self, request: Any) -> None:
        if request.resource_type != "document" and not request.url.startswith("data:"):
            self.requests.append(request.url)


@contextmanager
def browser() -> Iterator[Page]:
    """Starts Chromium; skips where it or playwright is missing."""
    playwright = pytest.importorskip("playwright.sync_api")
    found = next(filter(None, map(shutil.which, _NAMES)), None)
    if found is None:
        pytest.skip("no Chromium on this machine: the page was not looked at")
    with playwright.sync_playwright() as drivers:
        running = drivers.chromium.launch(executable_path=found, args=list(_FLAGS))
        try:
            yield Page(running)
        finally:
            running.close()
