"""Screenshots, windows and web pages of the viewer."""

import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import OutputError, SettingError
from dmrl.images.codec import decode
from dmrl.stages import view as stage
from dmrl.viewer import Page, Settings, Web
from dmrl.viewer.layouts import BACKGROUND, IMAGE_OPACITY
from dmrl.viewer.window import desktop, viewer_process
from dmrl.viewer.window.desktop import show_in_window, write_screenshot

Make = Callable[..., Path]

PATIENCE_S = 100.0
"""Time limit of a process, with a margin for a busy machine."""


@pytest.fixture(scope="session")
def vulkan() -> None:
    """Skip where there is no software Vulkan driver to draw with."""
    folders = (Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d"))
    if not any(any(folder.glob("lvp*.json")) for folder in folders):
        pytest.skip("no software Vulkan driver; apt-get install mesa-vulkan-drivers")


def measure_panel(picture: Path, row: int, col: int) -> tuple[int, ...]:
    """Return the mean colour of the middle of one of four panels."""
    rgb = decode(picture.read_bytes())
    v, u = (280, 760)[row], (400, 1200)[col]
    return tuple(int(value) for value in rgb[v - 40 : v + 40, u - 40 : u + 40].mean(axis=(0, 1)))


@pytest.mark.heavy
def test_a_picture_shows_the_image_nearest_to_the_time(
    make_recording: Make, tmp_path: Path, vulkan: None
) -> None:
    picture = tmp_path / "picture.png"
    assert write_screenshot([make_recording()], picture, Settings(), time_s=0.43) == "at 0.400 s"
    rgb = decode(picture.read_bytes())
    assert rgb.shape == (1000, 1600, 3)
    # The names of the panels are in the first rows, so there is no empty bar above them.
    assert rgb[:30, 50:-50].max() > 150
    assert np.ptp(measure_panel(picture, 0, 0)) <= 3
    # The fifth image has grey level 80. It is blended with the background in linear light.
    light = IMAGE_OPACITY * 80**2.2 + (1 - IMAGE_OPACITY) * BACKGROUND[0] ** 2.2
    assert measure_panel(picture, 0, 0)[0] == pytest.approx(light ** (1 / 2.2), abs=2)
    assert list(tmp_path.glob("*.partial")) == []


@pytest.mark.heavy
def test_missing_vulkan_driver_error_names_the_package(
    make_recording: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("VK_ICD_FILENAMES", "VK_DRIVER_FILES"):
        monkeypatch.setenv(name, "/nonexistent")
    with pytest.raises(OutputError, match="apt-get install mesa-vulkan-drivers"):
        write_screenshot([make_recording()], tmp_path / "picture.png", Settings())
    assert list(tmp_path.glob("picture*")) == []


@pytest.mark.heavy
def test_viewer_that_stops_is_reported_with_its_output(
    make_recording: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = "import sys; sys.exit('out of luck')"
    monkeypatch.setattr(desktop, "build_command", lambda *_: [sys.executable, "-c", code])
    with pytest.raises(OutputError, match=r"viewer stopped: out of luck\. Try: dmrl view --save"):
        write_screenshot([make_recording()], tmp_path / "picture.png", Settings())
    with pytest.raises(SettingError, match=r"viewer stopped: out of luck\. Use --save"):
        show_in_window([make_recording("second.mcap")], Settings())


def test_a_picture_is_never_overwritten(make_recording: Make, tmp_path: Path) -> None:
    (tmp_path / "picture.png").write_bytes(b"mine")
    with pytest.raises(OutputError, match="never overwritten"):
        write_screenshot([make_recording()], tmp_path / "picture.png", Settings())
    assert (tmp_path / "picture.png").read_bytes() == b"mine"


@pytest.mark.heavy
def test_missing_screen_error_names_alternatives(make_recording: Make) -> None:
    with pytest.raises(SettingError, match=r"no screen.*--save, --screenshot or --serve"):
        show_in_window([make_recording()], Settings())


def test_viewer_listens_on_loopback_and_has_no_network() -> None:
    command, environment = (
        viewer_process.build_command("127.0.0.1"),
        viewer_process.build_environment(),
    )
    assert command[command.index("--bind") + 1] == "127.0.0.1"
    assert environment["CI"] == "1"
    assert {environment[name] for name in ("https_proxy", "HTTPS_PROXY")} == {"http://127.0.0.1:9"}


@pytest.mark.heavy
@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_the_page_is_served_until_ctrl_c_or_a_kill(
    make_recording: Make, ending: signal.Signals
) -> None:
    code = "from dmrl.cli import main; main()"
    command = [sys.executable, "-c", code, "view", str(make_recording()), "--serve"]

    def restore_ctrl_c() -> None:
        # A shell makes its background jobs ignore SIGINT, and their children inherit that.
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, preexec_fn=restore_ctrl_c
    ) as server:
        try:
            assert server.stderr is not None
            address = server.stderr.readline().split()[0]
            assert address.startswith("http://127.0.0.1:")
            assert b"<html" in _fetch_page(address)
            server.send_signal(ending)
            assert server.wait(timeout=PATIENCE_S) == 0
            with pytest.raises(urllib.error.URLError):
                urllib.request.urlopen(address)
        finally:
            server.kill()


def _fetch_page(address: str) -> bytes:
    """Wait until an address is served; return its content."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            with urllib.request.urlopen(address) as answer:
                return bytes(answer.read())
        except urllib.error.URLError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)


@pytest.mark.heavy
def test_a_page_can_be_opened_and_closed_in_a_notebook(make_recording: Make) -> None:
    page = Page([make_recording()], Settings())
    try:
        assert page._repr_html_().startswith(f'<iframe src="{page.url}"')
        assert b"<html" in _fetch_page(page.url)
    finally:
        page.close()


def test_a_port_in_use_is_named(make_recording: Make) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(SettingError, match=rf"port {port} is in use. Choose another --port"):
            Page([make_recording()], Settings(), Web(port=port))


def test_invalid_address_is_reported(make_recording: Make) -> None:
    with pytest.raises(SettingError, match=r"Try: --bind 127\.0\.0\.1"):
        Page([make_recording()], Settings(), Web(bind="192.0.2.1"))


@pytest.mark.heavy
def test_a_pipeline_writes_by_suffix(
    make_recording: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def draw(paths: list[Path], out: Path, settings: Settings) -> None:
        assert (paths, settings) == ([recording], Settings())
        out.write_bytes(bytes(2000))

    recording = make_recording()
    # Other tests check what a screenshot shows.
    monkeypatch.setattr("dmrl.viewer.window.desktop.write_screenshot", draw)
    for name in ("seen.rrd", "seen.png"):
        stage.run([recording], tmp_path / name, Settings())
        assert (tmp_path / name).stat().st_size > 1000
    with pytest.raises(SettingError, match=r"view writes \.png and \.rrd"):
        stage.run([recording], tmp_path / "seen.jpg", Settings())


@pytest.mark.heavy
def test_without_rerun_the_command_names_the_extra(tmp_path: Path) -> None:
    (tmp_path / "rerun.py").write_text("raise ImportError('not here')")
    code = "from dmrl.cli import main; main()"
    command = [sys.executable, "-c", code, "view", "x.mcap"]
    done = subprocess.run(
        command, env={"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr == (
        "dmrl: dmrl view needs rerun-sdk. Install it with: pip install 'dmrl[view]'\n"
    )
