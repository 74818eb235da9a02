"""rerun's viewer as a child process without network access.

Data are streamed to the viewer, which shows the first while the rest is still being read.
"""

import errno
import os
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.resources import files
from tempfile import TemporaryFile

from dmrl.errors import SettingError
from dmrl.viewer.session import log_show
from dmrl.viewer.settings import LOOPBACK
from dmrl.viewer.show import Show, open_stream

VIEWER_TIMEOUT_S = 60.0
"""Timeout for the viewer to listen, to load and to receive data, seconds."""
POLL_INTERVAL_S = 0.1

# CI=1 turns rerun's usage statistics off. Its look-up of newer versions has no switch, so its proxy
# is a closed port. RUST_LOG hides its warnings, which would be drawn over a screenshot.
UNREACHABLE_PROXY = f"http://{LOOPBACK}:9"
PROXY_VARIABLES = ("all_proxy", "http_proxy", "https_proxy")
QUIET_ENVIRONMENT = {
    name: UNREACHABLE_PROXY for lower in PROXY_VARIABLES for name in (lower, lower.upper())
} | {
    "CI": "1",
    "NO_PROXY": LOOPBACK,
    "RUST_LOG": "error",
}


class ViewerProcess:
    """rerun's viewer as a child process."""

    def __init__(self, command: list[str]) -> None:
        # Lives as long as the viewer.
        self._errors = TemporaryFile()  # noqa: SIM115
        self.process = subprocess.Popen(command, env=build_environment(), stderr=self._errors)
        self.ended = threading.Event()

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self.process.poll() is None

    @property
    def wanted(self) -> bool:
        """Whether the process runs and was not asked to end: `ended` is not set."""
        return self.alive and not self.ended.is_set()

    def wait(self) -> None:
        """Wait until the process ends or is asked to."""
        while self.wanted:
            self.ended.wait(POLL_INTERVAL_S)

    def collect_errors(self) -> str:
        """Read its messages on standard error."""
        self._errors.seek(0)
        return self._errors.read().decode(errors="replace")

    def close(self) -> None:
        """Stop the process."""
        self.process.kill()
        self.process.wait()
        self._errors.close()


@contextmanager
def run_viewer(words: list[str]) -> Iterator[ViewerProcess]:
    """Run a viewer until the end of the block."""
    viewer = ViewerProcess(words)
    try:
        yield viewer
    finally:
        viewer.close()


def wait_until_listening(viewer: ViewerProcess, host: str, port: int) -> bool:
    """Wait until the viewer listens; return False if it ends, is asked to end, or times out."""
    deadline = time.monotonic() + VIEWER_TIMEOUT_S
    while viewer.wanted and time.monotonic() < deadline:
        with suppress(OSError), socket.create_connection((host, port), timeout=1):
            return True
        time.sleep(0.02)
    return False


def stream_to(show: Show, viewer: ViewerProcess, port: int, host: str = LOOPBACK) -> None:
    """Send everything to the viewer, unless it ends or is asked to end before."""
    stream = open_stream()
    stream.connect_grpc(build_proxy_url(port, host), default_blueprint=show.blueprint)
    try:
        log_show(show, stream, wanted=lambda: viewer.wanted)
        if viewer.wanted:
            stream.flush(timeout_sec=VIEWER_TIMEOUT_S)
    except RuntimeError:
        if viewer.wanted:
            raise
    finally:
        stream.disconnect()


def build_command(bind: str, *arguments: str) -> list[str]:
    """Build the command line that starts the viewer."""
    program = files("rerun_cli").joinpath("rerun")
    return [str(program), "--bind", bind, "--hide-welcome-screen", *arguments]


def build_environment() -> dict[str, str]:
    """Build the environment variables of the viewer."""
    return os.environ | QUIET_ENVIRONMENT


def build_proxy_url(port: int, host: str = LOOPBACK) -> str:
    """Return the URL at which a viewer receives data."""
    return f"rerun+http://{host}:{port}/proxy"


def find_free_port(bind: str, wanted: int | None = None) -> int:
    """Find a free port, or make sure that the wanted one is free.

    Raises
    ------
    SettingError
        If the port is in use, or the address is not one of this computer's.
    """
    with socket.socket(socket.AF_INET6 if ":" in bind else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((bind, wanted or 0))
        except socket.gaierror:
            raise SettingError(f"{bind} is not an address. Try: --bind {LOOPBACK}") from None
        except OSError as e:
            why = f"cannot listen on {bind}, port {wanted or 0}: {e.strerror}"
            hint = f"Try: --bind {LOOPBACK}"
            if e.errno == errno.EADDRINUSE:
                why, hint = f"port {wanted} is in use", "Choose another --port, or leave it out"
            raise SettingError(f"{why}. {hint}") from None
        return int(probe.getsockname()[1])


def last_line(said: str) -> str:
    """Return the last line of a viewer's messages."""
    return said.strip().rpartition("\n")[2] or "it printed no message"
