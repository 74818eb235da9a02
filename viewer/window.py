"""rerun's viewer as a child process: a window, a web page, a picture without a screen.

It listens on 127.0.0.1 only and reports to nobody.
"""

import os
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import IO
from urllib.parse import quote

from rerun.experimental import ViewerClient

from dmrl.errors import OutputError, SettingError
from dmrl.output import partial_file
from dmrl.progress import say
from dmrl.viewer.selection import Selection, Settings, at_time, select
from dmrl.viewer.session import write

LOOPBACK = "127.0.0.1"
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


def view(paths: Sequence[Path], settings: Settings) -> None:
    """Show recordings in a window, until it is closed.

    Raises
    ------
    RecordingError
        If no recording has images, or one cannot be read.
    SettingError
        If there is no screen, or no image lies in the time asked for.
    """
    with _rrd(select(paths, settings), settings) as rrd, TemporaryFile() as errors:
        done = subprocess.run(_command("--port", "auto", rrd), env=_environment(), stderr=errors)
        said = _text(errors)
    if NO_SCREEN in said:
        raise SettingError("no screen for a window. Use --save, --screenshot or --serve")
    if done.returncode:
        raise SettingError(f"rerun's viewer stopped: {_last_line(said)}. Use --save")


def serve(paths: Sequence[Path], settings: Settings) -> None:
    """Show recordings in a browser of this computer, until Ctrl-C. Prints the address.

    Raises
    ------
    RecordingError
        If no recording has images, or one cannot be read.
    SettingError
        If no image lies in the time asked for.
    """
    data_port, page_port = _free_port(), _free_port()
    ports = ("--port", str(data_port), "--web-viewer-port", str(page_port))
    with _rrd(select(paths, settings), settings) as rrd:
        source = quote(_url(data_port), safe="")
        say(f"http://{LOOPBACK}:{page_port}?url={source} (Ctrl-C ends it)")
        with suppress(KeyboardInterrupt):
            subprocess.run(_command("--serve-web", *ports, rrd), env=_environment(), check=False)


def screenshot(
    paths: Sequence[Path], out: Path, settings: Settings, *, time_s: float | None = None
) -> float:
    """Write a PNG picture of what would be shown at a time; needs no screen.

    Parameters
    ----------
    paths
        Recordings.
    out
        Picture to write. Must not exist.
    settings
        What is shown.
    time_s
        Seconds from the start of the earliest recording: the nearest image is taken. None:
        the first image.

    Returns
    -------
    float
        Time of the image, seconds from the start.

    Raises
    ------
    OutputError
        If ``out`` exists, cannot be written, or there is no Vulkan driver to draw with.
    RecordingError
        If no recording has images, or one cannot be read.
    SettingError
        If no image lies in the time asked for.
    """
    moment = at_time(select(paths, settings), time_s)
    with partial_file(out) as unfinished, _rrd(moment, settings) as rrd:
        try:
            picture = _picture(rrd)
        except _ViewerStopped as e:
            raise OutputError(f"cannot draw {out}: {e}") from None
        unfinished.write_bytes(picture)
    return (moment.last_ns - moment.start_ns) / 1e9


def open_window(*, headless: bool = False) -> tuple[subprocess.Popen[bytes], str]:
    """An empty viewer, and the address where it listens.

    Parameters
    ----------
    headless
        Without a window.
    """
    port = _free_port()
    extra = ("--headless", "--window-size", PICTURE_SIZE) if headless else ()
    command = _command(*extra, "--port", str(port))
    # Its own session: Ctrl-C ends the recording, not the window.
    process = subprocess.Popen(
        command, env=_environment(), stderr=subprocess.DEVNULL, start_new_session=True
    )
    return process, _url(port)


class _ViewerStopped(Exception):
    """Why the viewer ended or hangs, and the way out."""


def _picture(rrd: str) -> bytes:
    port = _free_port()
    where = ("--headless", "--window-size", PICTURE_SIZE, "--port", str(port), rrd)
    with TemporaryFile() as errors:
        viewer = subprocess.Popen(_command(*where), env=_environment(), stderr=errors)
        try:
            if picture := _settled(viewer, port):
                return picture
        finally:
            viewer.kill()
            viewer.wait()
        said = _text(errors)
    if NO_VULKAN in said:
        raise _ViewerStopped("no Vulkan driver. Install one: apt-get install mesa-vulkan-drivers")
    raise _ViewerStopped(f"rerun's viewer stopped: {_last_line(said)}. Try: dmrl view --save")


def _settled(viewer: subprocess.Popen[bytes], port: int) -> bytes | None:
    deadline = time.monotonic() + PATIENCE_S
    previous = b""
    while time.monotonic() < deadline and viewer.poll() is None:
        # Until it listens, requests fail; until all is loaded and decoded, pictures differ.
        with suppress(OSError, RuntimeError):
            client = ViewerClient.connect(_url(port))
            state = client.get_state()
            if state.active_recording and not state.loading:
                picture = client.take_screenshot()
                if picture == previous:
                    return picture
                previous = picture
        time.sleep(0.05)
    return None


@contextmanager
def _rrd(selection: Selection, settings: Settings) -> Iterator[str]:
    with TemporaryDirectory(prefix="dmrl-view-") as folder:
        path = Path(folder) / "view.rrd"
        write(selection, path, settings)
        yield str(path)


def _command(*arguments: str) -> list[str]:
    program = files("rerun_cli").joinpath("rerun")
    return [str(program), "--bind", LOOPBACK, "--hide-welcome-screen", *arguments]


def _environment() -> dict[str, str]:
    return os.environ | QUIET


def _url(port: int) -> str:
    return f"rerun+http://{LOOPBACK}:{port}/proxy"


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def _text(stream: IO[bytes]) -> str:
    stream.seek(0)
    return stream.read().decode(errors="replace")


def _last_line(said: str) -> str:
    return said.strip().rpartition("\n")[2] or "it said nothing"
