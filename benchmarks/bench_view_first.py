"""Measure the time until `dmrl view` shows the first image of a long recording.

Run as ``python benchmarks/bench_view_first.py RECORDING [--times 5]``, with a recording as
described in ``bench_view.py``. The command runs with a viewer without a screen, and a screenshot is
taken every 0.1 s. The time starts with the process, so it includes imports. Each layout is measured
with the recording in the page cache, and with it on disk only (Linux), in turns. Use an idle
computer; on a busy one only the CPU seconds can be compared.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
import psutil

from dmrl.images.codec import Rgb, decode, encode_png
from dmrl.viewer.window import desktop, viewer_process

SHOWS_COLOURS = 2000
"""Number of colours above which a screenshot shows an image, not only empty panels."""
LOOK_EVERY_S, PATIENCE_S = 0.1, 120.0


# Runs `dmrl view` with a viewer without a screen at a known port; prints "sent" when all is sent.
COMMAND = """
import sys
from dmrl.cli import main
from dmrl.viewer.window import desktop as window
port, command, stream_to = int(sys.argv.pop(1)), window.build_command, window.stream_to
size = ("--headless", "--window-size", window.SCREENSHOT_SIZE)
def streamed(*arguments):
    stream_to(*arguments)
    print("sent", flush=True)
window.find_free_port = lambda bind: port
window.build_command = lambda bind, *rest: command(bind, *size, *rest)
window.stream_to = streamed
main()
"""


def measure_first_image(path: Path, layout: str, *, kept: Path | None) -> dict[str, float]:
    """Return the seconds until the first image and until all is sent, and CPU seconds.

    Parameters
    ----------
    path
        Recording.
    layout
        Layout of the viewer.
    kept
        Path to write the first screenshot with an image; None: it is not written.
    """
    port = viewer_process.find_free_port(viewer_process.LOOPBACK)
    words = [sys.executable, "-c", COMMAND, str(port), "view", str(path), "--layout", layout]
    begun = time.monotonic()
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as running:
        try:
            picture = _wait_for_image(running, port)
            found = {"first_s": time.monotonic() - begun}
            found |= {f"{name}_cpu_s": s for name, s in _cpu_s(running.pid).items()}
            assert running.stdout is not None
            assert running.stdout.readline() == "sent\n"
            found["sent_s"] = time.monotonic() - begun
        finally:
            running.terminate()
    if kept is not None:
        kept.write_bytes(encode_png(picture))
    return found


def _wait_for_image(running: subprocess.Popen[str], port: int) -> Rgb:
    """Wait until the viewer shows an image; return its screenshot."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline and running.poll() is None:
        try:
            client = desktop.ViewerClient.connect(viewer_process.build_proxy_url(port))
            rgb = decode(client.take_screenshot())
        except (OSError, RuntimeError):
            rgb = np.zeros((1, 1, 3), np.uint8)
        if len(np.unique(rgb[::4, ::4].reshape(-1, 3), axis=0)) > SHOWS_COLOURS:
            return rgb
        time.sleep(LOOK_EVERY_S)
    raise SystemExit(f"the viewer showed no image within {PATIENCE_S:g} s")


def _cpu_s(pid: int) -> dict[str, float]:
    """Return the CPU seconds of dmrl and of its viewer."""
    own = psutil.Process(pid)
    used = {"dmrl": own.cpu_times(), "viewer": own.children()[0].cpu_times()}
    return {name: times.user + times.system for name, times in used.items()}


def load_to_cache(path: Path) -> None:
    """Read the file, so that it is in the page cache."""
    with path.open("rb") as stream:
        while stream.read(1 << 24):
            pass


def drop_from_cache(path: Path) -> None:
    """Drop the file from the page cache."""
    with path.open("rb") as stream:
        os.fsync(stream.fileno())
        os.posix_fadvise(stream.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


PLACES: dict[str, Callable[[Path], None]] = {"memory": load_to_cache, "disk": drop_from_cache}


def main() -> None:
    """Print a line for each layout and place of the recording."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--times", type=int, default=5)
    parser.add_argument("--layouts", nargs="+", default=["image", "flight"])
    parser.add_argument("--keep", type=Path, help="folder for the first screenshots")
    given = parser.parse_args()
    rows: dict[tuple[str, str], list[dict[str, float]]] = {}
    for number in range(given.times):
        for layout in given.layouts:
            for place, prepare in PLACES.items():
                prepare(given.recording)
                name = f"{layout}-{place}-{number}.png"
                kept = None if given.keep is None else given.keep / name
                found = measure_first_image(given.recording, layout, kept=kept)
                rows.setdefault((layout, place), []).append(found)
    print(f"{given.times} runs each; all in seconds")
    print("first image: median and worst; CPU time until then: dmrl and viewer; all data sent")
    print(f"{'layout':<8}{'from':<8}{'median':>8}{'worst':>8}{'dmrl':>8}{'viewer':>8}{'sent':>8}")
    for (layout, place), runs in rows.items():
        keys = ("first_s", "dmrl_cpu_s", "viewer_cpu_s", "sent_s")
        first, dmrl, viewer, sent = (median(run[key] for run in runs) for key in keys)
        worst = max(run["first_s"] for run in runs)
        cells = (first, worst, dmrl, viewer, sent)
        print(f"{layout:<8}{place:<8}" + "".join(f"{cell:8.1f}" for cell in cells))


if __name__ == "__main__":
    main()
