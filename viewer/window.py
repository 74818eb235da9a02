"""rerun's viewer as a child process: a window, a web page, a picture without a screen.

It listens on 127.0.0.1 only, unless told otherwise, and reports to nobody. What it shows is
streamed to it, so that it can be looked at while the rest is read.
"""

import errno
import os
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Annotated, Any
from urllib.parse import quote

import numpy as np
from cyclopts import Parameter, validators
from rerun.experimental import ViewerClient

from dmrl.errors import OutputError, SettingError
from dmrl.output import partial_file
from dmrl.progress import say
from dmrl.viewer.selection import Settings
from dmrl.viewer.session import log, prepare, write
from dmrl.viewer.show import Show, stream_of

LOOPBACK = "127.0.0.1"
ANYWHERE = ("0.0.0.0", "::")
FRAME_PX = 700
PICTURE_SIZE = "1600x1000"
PATIENCE_S = 60.0

# CI=1 turns rerun's usage statistics off; its look-up of newer versions has no switch, so the
# web is put out of its reach, at a port where nobody listens. Its warnings would be drawn over
# a picture.
NOWHERE = f"http://{LOOPBACK}:9"
PROXIES = ("all_proxy", "http_proxy", "https_proxy")
QUIET = {name: NOWHERE for lower in PROXIES for name in (lower, lower.upper())} | {
    "CI": "1",
    "NO_PROXY": LOOPBACK,
    "RUST_LOG": "error",
}

# What rerun says when it cannot draw, and when it cannot open a window.
NO_VULKAN = "render context"
NO_SCREEN = "WAYLAND_DISPLAY"


@dataclass(frozen=True, slots=True)
class Web:
    """Where a page is served.

    Parameters
    ----------
    bind
        Address of the network to listen on. Only on 127.0.0.1 nobody else can look.
    port
        Of the page. None: any that is free.
    """

    bind: str = LOOPBACK
    port: Annotated[int | None, Parameter(validator=validators.Number(gte=1, lte=65535))] = None


WEB = Web()


def view(paths: Sequence[Path], settings: Settings) -> None:
    """Show recordings in a window, until it is closed. It opens while they are being read.

    Raises
    ------
    DatasetError, RecordingError
        If they cannot be read, or lack what the layout shows.
    SettingError
        If there is no screen, or nothing lies in the time asked for.
    """
    show = prepare(paths, settings)
    port = _free_port(LOOPBACK)
    with _viewer(_command(LOOPBACK, "--port", str(port))) as viewer:
        try:
            if _listens(viewer, LOOPBACK, port):
                _stream(show, viewer, port)
            viewer.process.wait()
        except KeyboardInterrupt:
            return
        said = viewer.said()
    if NO_SCREEN in said:
        raise SettingError("no screen for a window. Use --save, --screenshot or --serve")
    if viewer.process.returncode:
        raise SettingError(f"rerun's viewer stopped: {_last_line(said)}. Use --save")


def serve(paths: Sequence[Path], settings: Settings, web: Web = WEB) -> None:
    """Show recordings in a browser, until Ctrl-C. Prints the address.

    Raises
    ------
    DatasetError, RecordingError
        If they cannot be read, or lack what the layout shows.
    SettingError
        If nothing lies in the time asked for, or the port is in use.
    """
    with suppress(KeyboardInterrupt), page(paths, settings, web) as shown:
        say(f"{shown.url} (Ctrl-C ends it)")
        shown.fill()
        shown.wait()


@contextmanager
def page(paths: Sequence[Path], settings: Settings, web: Web = WEB) -> Iterator["Page"]:
    """A page with recordings that is served as long as the block lasts.

    Raises
    ------
    As `serve`.
    """
    opened = Page(paths, settings, web)
    try:
        yield opened
    finally:
        opened.close()


class Page:
    """A page with recordings, served until it is closed. A notebook shows it in the cell.

    Parameters
    ----------
    paths
        Recordings, or a dataset.
    settings
        What is shown.
    web
        Where it is served.

    Raises
    ------
    As `serve`.
    """

    def __init__(self, paths: Sequence[Path], settings: Settings, web: Web = WEB) -> None:
        self._show = prepare(paths, settings)
        self._data_port = _free_port(web.bind)
        port = web.port or _free_port(web.bind)
        _require_free(web.bind, port)
        host = socket.gethostname() if web.bind in ANYWHERE else web.bind
        source = quote(f"rerun+http://{host}:{self._data_port}/proxy", safe="")
        self.url = f"http://{host}:{port}?url={source}"
        ports = ("--port", str(self._data_port), "--web-viewer-port", str(port))
        allowed = ("--cors-allow-origin", f"http://{host}:{port}", "--server-memory-limit", "75%")
        command = _command(web.bind, "--serve-web", *ports, *allowed)
        self._host = LOOPBACK if web.bind in ANYWHERE else web.bind
        self._viewer = _Viewer(command)
        if not _listens(self._viewer, self._host, self._data_port):
            said = _last_line(self._viewer.said())
            self.close()
            raise SettingError(f"rerun's server stopped: {said}. Choose another --port or --bind")

    def fill(self) -> None:
        """Send everything that is shown; the page can be looked at meanwhile."""
        _stream(self._show, self._viewer, self._data_port, self._host)

    def wait(self) -> None:
        """Nothing, once the server has ended."""
        self._viewer.process.wait()

    def close(self) -> None:
        """End the server."""
        self._viewer.close()

    def _repr_html_(self) -> str:
        self.fill()
        return f'<iframe src="{self.url}" width="100%" height="{FRAME_PX}"></iframe>'


def screenshot(
    paths: Sequence[Path],
    out: Path,
    settings: Settings,
    *,
    time_s: float | None = None,
    rank: int = 1,
) -> str:
    """Write a PNG picture of what would be shown at a time; needs no screen.

    Parameters
    ----------
    paths
        Recordings, or a dataset.
    out
        Picture to write. Must not exist.
    settings
        What is shown.
    time_s
        Seconds from the start of the earliest recording: the nearest image is taken. None:
        the first image.
    rank
        Of a dataset: which row, from 1.

    Returns
    -------
    str
        What is seen, in words.

    Raises
    ------
    OutputError
        If ``out`` exists, cannot be written, or there is no Vulkan driver to draw with.
    DatasetError, RecordingError
        If they cannot be read, or lack what the layout shows.
    SettingError
        If nothing lies in the time asked for.
    """
    show = prepare(paths, settings, picture=True, time_s=time_s, rank=rank)
    with partial_file(out) as unfinished:
        try:
            picture = _picture(show)
        except _ViewerStopped as e:
            raise OutputError(f"cannot draw {out}: {e}") from None
        unfinished.write_bytes(picture)
    return show.moment


class _ViewerStopped(Exception):
    """Why the viewer ended or hangs, and the way out."""


def _picture(show: Show) -> bytes:
    port = _free_port(LOOPBACK)
    # From a file: a viewer that waits for a stream says so, across the picture.
    with TemporaryDirectory(prefix="dmrl-view-") as folder:
        path = Path(folder) / "view.rrd"
        write(show, path)
        where = ("--headless", "--window-size", PICTURE_SIZE, "--port", str(port), str(path))
        with _viewer(_command(LOOPBACK, *where)) as viewer:
            if picture := _settled(show, viewer, port):
                return picture
            said = viewer.said()
    if NO_VULKAN in said:
        raise _ViewerStopped("no Vulkan driver. Install one: apt-get install mesa-vulkan-drivers")
    raise _ViewerStopped(f"rerun's viewer stopped: {_last_line(said)}. Try: dmrl view --save")


def _settled(show: Show, viewer: "_Viewer", port: int) -> bytes | None:
    deadline = time.monotonic() + PATIENCE_S
    previous = b""
    while time.monotonic() < deadline and viewer.alive:
        # Until it listens, requests fail; until all is loaded and decoded, pictures differ.
        with suppress(OSError, RuntimeError):
            client: Any = ViewerClient.connect(_url(port))
            state = client.get_state()
            if state.active_recording and not state.loading:
                timeline, value = show.cursor
                client.set_time(timeline, play_state="paused", **{_kind(value): value})
                picture = bytes(client.take_screenshot())
                if picture == previous:
                    return picture
                previous = picture
        time.sleep(0.05)
    return None


def _kind(value: np.generic | int) -> str:
    if isinstance(value, np.datetime64):
        return "timestamp"
    return "duration" if isinstance(value, np.timedelta64) else "sequence"


class _Viewer:
    """rerun's viewer as a child process."""

    def __init__(self, command: list[str]) -> None:
        # Lives as long as the viewer.
        self._errors = TemporaryFile()  # noqa: SIM115
        self.process = subprocess.Popen(command, env=_environment(), stderr=self._errors)

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    def said(self) -> str:
        self._errors.seek(0)
        return self._errors.read().decode(errors="replace")

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._errors.close()


@contextmanager
def _viewer(command: list[str]) -> Iterator[_Viewer]:
    viewer = _Viewer(command)
    try:
        yield viewer
    finally:
        viewer.close()


def _listens(viewer: _Viewer, host: str, port: int) -> bool:
    """Whether the viewer is there to be talked to, or has ended."""
    deadline = time.monotonic() + PATIENCE_S
    while viewer.alive and time.monotonic() < deadline:
        with suppress(OSError), socket.create_connection((host, port), timeout=1):
            return True
        time.sleep(0.02)
    return False


def _stream(show: Show, viewer: _Viewer, port: int, host: str = LOOPBACK) -> None:
    """Send everything, unless the viewer is closed meanwhile."""
    stream = stream_of()
    stream.connect_grpc(_url(port, host), default_blueprint=show.blueprint)
    try:
        log(show, stream, wanted=lambda: viewer.alive)
        if viewer.alive:
            stream.flush(timeout_sec=PATIENCE_S)
    except RuntimeError:
        if viewer.alive:
            raise
    finally:
        stream.disconnect()


def _command(bind: str, *arguments: str) -> list[str]:
    program = files("rerun_cli").joinpath("rerun")
    return [str(program), "--bind", bind, "--hide-welcome-screen", *arguments]


def _environment() -> dict[str, str]:
    return os.environ | QUIET


def _url(port: int, host: str = LOOPBACK) -> str:
    return f"rerun+http://{host}:{port}/proxy"


def _free_port(bind: str) -> int:
    with _socket(bind) as probe:
        return _bound(probe, bind, 0)


def _require_free(bind: str, port: int) -> None:
    with _socket(bind) as probe:
        _bound(probe, bind, port)


def _socket(bind: str) -> socket.socket:
    return socket.socket(socket.AF_INET6 if ":" in bind else socket.AF_INET)


def _bound(probe: socket.socket, bind: str, port: int) -> int:
    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        probe.bind((bind, port))
    except socket.gaierror:
        raise SettingError(f"{bind} is no address. Try: --bind {LOOPBACK}") from None
    except OSError as e:
        if e.errno == errno.EADDRINUSE:
            raise SettingError(
                f"port {port} is in use. Choose another --port, or leave it out"
            ) from None
        raise SettingError(
            f"cannot listen on {bind}, port {port}: {e.strerror}. Try: --bind {LOOPBACK}"
        ) from None
    return int(probe.getsockname()[1])


def _last_line(said: str) -> str:
    return said.strip().rpartition("\n")[2] or "it said nothing"
