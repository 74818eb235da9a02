"""A browser controlled by chromedriver's HTTP protocol (W3C WebDriver)."""

import json
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib import request

MISSING = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]


class Browser:
    """A session of chromedriver."""

    def __init__(self, address: str, options: dict[str, Any]) -> None:
        self.address = address
        wanted = {"capabilities": {"alwaysMatch": {"goog:chromeOptions": options}}}
        self.address = f"{address}/session/{self._send('POST', '/session', wanted)['sessionId']}"

    def _send(self, method: str, path: str, body: Any = None) -> Any:
        """Send a command; return its value."""
        data = None if body is None else json.dumps(body).encode()
        asked = request.Request(self.address + path, data, method=method)
        asked.add_header("Content-Type", "application/json")
        with request.urlopen(asked, timeout=60) as answer:
            return json.loads(answer.read())["value"]

    def open(self, page: Path) -> None:
        """Load a page."""
        self._send("POST", "/url", {"url": page.as_uri()})

    def run(self, script: str) -> Any:
        """Run the body of a JavaScript function; return its value."""
        return self._send("POST", "/execute/sync", {"script": script, "args": []})

    def find(self, selector: str) -> str:
        """Return the identifier of an element."""
        found = self._send("POST", "/element", {"using": "css selector", "value": selector})
        return str(next(iter(found.values())))

    def click(self, selector: str) -> None:
        """Click on an element."""
        self._send("POST", f"/element/{self.find(selector)}/click", {})

    def press(self, key: str) -> None:
        """Press and release a key."""
        keys = [{"type": "keyDown", "value": key}, {"type": "keyUp", "value": key}]
        self._send(
            "POST", "/actions", {"actions": [{"type": "key", "id": "keys", "actions": keys}]}
        )

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press, move and release the pointer; positions are pixels of the window."""

        def move(at: tuple[float, float]) -> dict[str, Any]:
            return {"type": "pointerMove", "duration": 50, "x": round(at[0]), "y": round(at[1])}

        down, up = {"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}
        steps = [move(start), down, move(end), up]
        pointer = {"type": "pointer", "id": "mouse", "actions": steps}
        self._send("POST", "/actions", {"actions": [pointer]})

    def screenshot(self, out: Path) -> None:
        """Write a screenshot as PNG."""
        import base64  # noqa: PLC0415

        out.write_bytes(base64.b64decode(self._send("GET", "/screenshot")))

    def close(self) -> None:
        """End the session."""
        self._send("DELETE", "")


@contextmanager
def open_browser(downloads: Path, width_px: int = 1200, height_px: int = 900) -> Iterator[Browser]:
    """Open a headless browser whose downloads go to a folder."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    driver = subprocess.Popen(
        ["chromedriver", f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        address = f"http://127.0.0.1:{port}"
        until = time.monotonic() + 60
        while True:
            try:
                request.urlopen(f"{address}/status", timeout=5).close()
                break
            except OSError:
                assert time.monotonic() < until
                time.sleep(0.1)
        arguments = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
        options: dict[str, Any] = {
            "args": [*arguments, f"--window-size={width_px},{height_px}"],
            "prefs": {
                "download.default_directory": str(downloads),
                "profile.default_content_setting_values.automatic_downloads": 1,
            },
        }
        if width_px < 500:  # narrower than a window can be
            size = {"width": width_px, "height": height_px, "pixelRatio": 2.0}
            options["mobileEmulation"] = {"deviceMetrics": size}
        browser = Browser(address, options)
        try:
            yield browser
        finally:
            browser.close()
    finally:
        driver.terminate()
        driver.wait()


def wait_for(path: Path) -> bytes:
    """Wait for a download; return its content."""
    until = time.monotonic() + 60
    while not path.exists():
        assert time.monotonic() < until, path
        time.sleep(0.1)
    return path.read_bytes()
