"""Show recordings in rerun's desktop viewer, and take screenshots without a screen."""

import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rerun.experimental import ViewerClient

from dmrl.atomic_output import atomic_file
from dmrl.errors import OutputError, SettingError
from dmrl.guards.temporary_folder import find_system_folder
from dmrl.images.codec import decode, encode_png
from dmrl.terminal.signals import set_on_signal
from dmrl.viewer.session import prepare_show, write_rrd
from dmrl.viewer.settings import LOOPBACK, Settings
from dmrl.viewer.show import Show
from dmrl.viewer.window.viewer_process import (
    VIEWER_TIMEOUT_S,
    ViewerProcess,
    build_command,
    build_environment,
    build_proxy_url,
    find_free_port,
    last_line,
    run_viewer,
    stream_to,
    wait_until_listening,
)

TOP_BAR_PX = 36
"""Height of the empty bar above rerun's panels, which holds the buttons of a window."""
SCREENSHOT_SIZE = f"1600x{1000 + TOP_BAR_PX}"

# Parts of rerun's error messages without a Vulkan driver, and without a screen.
NO_VULKAN_MESSAGE = "render context"
NO_SCREEN_MESSAGE = "WAYLAND_DISPLAY"


def show_in_window(paths: Sequence[Path], settings: Settings) -> None:
    """Show recordings in a window until it is closed. It opens while they are still being read.

    Raises
    ------
    DatasetError, RecordingError
        If they cannot be read, or have nothing for the layout.
    SettingError
        If there is no screen, or the recordings are empty at the requested time.
    """
    port = find_free_port(LOOPBACK)
    # The viewer starts while the recording's index is read.
    with run_viewer(build_command(LOOPBACK, "--port", str(port))) as viewer:
        show = prepare_show(paths, settings)
        with set_on_signal(viewer.ended):
            if wait_until_listening(viewer, LOOPBACK, port):
                stream_to(show, viewer, port)
            viewer.wait()
        said = viewer.collect_errors()
    if viewer.ended.is_set():
        return
    if NO_SCREEN_MESSAGE in said:
        raise SettingError("no screen for a window. Use --save, --screenshot or --serve")
    if viewer.process.returncode:
        raise SettingError(f"rerun's viewer stopped: {last_line(said)}. Use --save")


def write_screenshot(
    paths: Sequence[Path],
    out: Path,
    settings: Settings,
    *,
    time_s: float | None = None,
    rank: int = 1,
) -> str:
    """Write a PNG screenshot of the viewer at a time; needs no screen.

    Parameters
    ----------
    paths
        Recordings, or a dataset.
    out
        Image to write. Must not exist.
    settings
        Selects images and layout.
    time_s
        Seconds from the start of the earliest recording; the nearest image is shown. None: the
        first image.
    rank
        Row of a dataset, from 1.

    Returns
    -------
    str
        The time or row that is shown, in words.

    Raises
    ------
    OutputError
        If ``out`` exists, cannot be written, or there is no Vulkan driver to draw with.
    DatasetError, RecordingError
        If they cannot be read, or have nothing for the layout.
    SettingError
        If the recordings are empty at the requested time.
    """
    show = prepare_show(paths, settings, picture=True, time_s=time_s, rank=rank)
    with atomic_file(out) as unfinished:
        try:
            picture = _take_screenshot(show)
        except _ViewerStopped as e:
            raise OutputError(f"cannot draw {out}: {e}") from None
        unfinished.write_bytes(picture)
    return show.moment


def open_window(*, headless: bool = False) -> tuple[subprocess.Popen[bytes], str]:
    """Start an empty viewer, and return its process and its address.

    Parameters
    ----------
    headless
        Without a window.
    """
    port = find_free_port(LOOPBACK)
    extra = ("--headless", "--window-size", SCREENSHOT_SIZE) if headless else ()
    words = build_command(LOOPBACK, *extra, "--port", str(port))
    # Its own session: Ctrl-C ends the recording, not the window.
    environment = build_environment() | {"TMPDIR": str(find_system_folder())}
    process = subprocess.Popen(
        words, env=environment, stderr=subprocess.DEVNULL, start_new_session=True
    )
    return process, build_proxy_url(port)


class _ViewerStopped(Exception):
    """The viewer ended or hangs; the message has the reason and a way out."""


def _take_screenshot(show: Show) -> bytes:
    port = find_free_port(LOOPBACK)
    # From a file: a viewer that waits for a stream draws a message over the panels.
    with TemporaryDirectory(prefix="dmrl-view-") as folder:
        path = Path(folder) / "view.rrd"
        with path.open("wb") as file:
            write_rrd(show, file)
        where = ("--headless", "--window-size", SCREENSHOT_SIZE, "--port", str(port), str(path))
        with run_viewer(build_command(LOOPBACK, *where)) as viewer:
            if picture := _wait_for_screenshot(show, viewer, port):
                return _crop_top_bar(picture)
            said = viewer.collect_errors()
    if NO_VULKAN_MESSAGE in said:
        raise _ViewerStopped("no Vulkan driver. Install one: apt-get install mesa-vulkan-drivers")
    raise _ViewerStopped(f"rerun's viewer stopped: {last_line(said)}. Try: dmrl view --save")


def _crop_top_bar(picture: bytes) -> bytes:
    """Remove the rows above the panels from a screenshot, if they are empty."""
    rgb = decode(picture, "rerun's picture")
    # The corners of the window are round.
    bar = rgb[:TOP_BAR_PX, TOP_BAR_PX:-TOP_BAR_PX]
    return encode_png(rgb[TOP_BAR_PX:]) if (bar == bar[:, :1]).all() else picture


def _wait_for_screenshot(show: Show, viewer: ViewerProcess, port: int) -> bytes | None:
    deadline = time.monotonic() + VIEWER_TIMEOUT_S
    previous = b""
    while time.monotonic() < deadline and viewer.alive:
        # Requests fail until the viewer listens; screenshots differ until all data is decoded.
        with suppress(OSError, RuntimeError):
            client: Any = ViewerClient.connect(build_proxy_url(port))
            state = client.get_state()
            if state.active_recording and not state.loading:
                timeline, value = show.cursor
                client.set_time(timeline, play_state="paused", **{_time_argument(value): value})
                picture = bytes(client.take_screenshot())
                if picture == previous:
                    return picture
                previous = picture
        time.sleep(0.05)
    return None


def _time_argument(value: np.generic | int) -> str:
    if isinstance(value, np.datetime64):
        return "timestamp"
    return "duration" if isinstance(value, np.timedelta64) else "sequence"
