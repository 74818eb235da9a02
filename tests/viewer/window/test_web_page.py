"""The web page of the viewer draws in a headless browser."""

import base64
import json
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from dmrl.colours import RGB
from dmrl.images.codec import Rgb, decode
from dmrl.viewer import Page, Settings

Make = Callable[..., Path]
PATIENCE_S = 300.0
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--enable-unsafe-swiftshader",  # WebGL without a graphics card
    "--use-angle=swiftshader",
    "--window-size=1000,700",
)


class Browser:
    """Chromium, controlled by the WebDriver protocol."""

    def __init__(self, port: int, profile: Path) -> None:
        self.address = f"http://127.0.0.1:{port}"
        options = {"args": [*FLAGS, f"--user-data-dir={profile}"]}
        wanted = {"alwaysMatch": {"goog:chromeOptions": options, "pageLoadStrategy": "none"}}
        session = self.call("", {"capabilities": wanted})
        self.address += f"/session/{session['sessionId']}"

    def call(self, path: str, body: dict[str, Any] | None = None, method: str | None = None) -> Any:
        """Send a command; return its value."""
        where = self.address if "/session" in self.address else f"{self.address}/session"
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(where + path, data, method=method)
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
            return json.loads(answer.read())["value"]

    def take_screenshot(self) -> Rgb:
        """Return a screenshot."""
        return decode(base64.b64decode(self.call("/screenshot")))


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    """Return a browser with an empty profile, or skip where there is none."""
    program = shutil.which("chromedriver")
    if program is None:
        pytest.skip("no browser; apt-get install chromium chromium-driver")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    driver = subprocess.Popen([program, f"--port={port}"], stdout=subprocess.DEVNULL)
    try:
        _wait_for(f"http://127.0.0.1:{port}/status")
        opened = Browser(port, tmp_path / "profile")
        try:
            yield opened
        finally:
            opened.call("", method="DELETE")
    finally:
        driver.terminate()
        driver.wait()


def _wait_for(address: str) -> None:
    """Wait until an address is served."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            urllib.request.urlopen(address).close()
        except urllib.error.URLError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)
        else:
            return


def measure_share(rgb: Rgb, colour: tuple[int, int, int]) -> float:
    """Return the share of pixels that have nearly this colour."""
    return float((abs(rgb.astype(int) - colour).max(axis=2) < 12).mean())


@pytest.mark.slow
def test_a_browser_shows_the_flight(make_flight: Make, browser: Browser) -> None:
    page = Page([make_flight()], Settings())
    try:
        browser.call("/url", {"url": page.url})
        page.send_data()
        deadline = time.monotonic() + PATIENCE_S
        shown: dict[str, float] = {"nothing": 0.0}
        names = ("truth", "estimate", "detection", "range")
        while min(shown.values()) == 0 and time.monotonic() < deadline:
            # Software rendering may keep the browser too busy to answer.
            with suppress(urllib.error.HTTPError):
                rgb = browser.take_screenshot()
                shown = {name: measure_share(rgb, RGB[name]) for name in names}
        # Ranges are in the distance plot, boxes in the image, and all colours in the legends.
        assert min(shown.values()) > 0, shown
        assert "Rerun" in browser.call("/title")
    finally:
        page.close()
