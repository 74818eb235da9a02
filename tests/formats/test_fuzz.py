"""Damaged sources of every binary format give a one-line error or the undamaged part.

They never give another error, a hang, or more than 500 MB of memory.
"""

import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from dmrl.errors import DmrlError
from dmrl.formats.base import Options
from dmrl.formats.registry import load_builtin_formats
from dmrl.messages import message_class

from ..faults.mutate import mutate
from . import foreign

HANG_S = 20
MEMORY_BYTES = 500_000_000
ALONE = """
import sys, types
from pathlib import Path
tests = types.ModuleType("tests")
tests.__path__ = [sys.argv[1]]
sys.modules["tests"] = tests
from tests.formats.test_fuzz import run
run(sys.argv[2], int(sys.argv[3]), Path(sys.argv[4]))
"""


def _make_usd_writer(version: int) -> Callable[[Path], tuple[Path, Path]]:
    """Return a function that writes a micro-SD log, and returns source and file."""

    def make(folder: Path) -> tuple[Path, Path]:
        path = folder / "log"
        path.write_bytes(foreign.pack_usd_log(version))
        return path, path

    return make


def _write_flash(folder: Path) -> tuple[Path, Path]:
    """Write a HyperFlash dump; return source and file."""
    path = folder / "flash.bin"
    raw = foreign.make_raw_images(2, 224, 320)
    path.write_bytes(foreign.pack_flash_dump(raw, [[1, 2, 1, 0, 0, 1]] * 2))
    return path, path


def _write_stream(folder: Path) -> tuple[Path, Path]:
    """Write a CPX stream; return source and file."""
    path = folder / "flight.cpx"
    path.write_bytes(foreign.pack_cpx_stream())
    return path, path


def _make_ros2_writer(storage: str) -> Callable[[Path], tuple[Path, Path]]:
    """Return a function that writes a rosbag2 folder, and returns source and file."""

    def make(folder: Path) -> tuple[Path, Path]:
        bag = foreign.write_ros2_bag(folder / "bag", storage)
        return bag, next(path for path in bag.iterdir() if path.suffix in (".db3", ".mcap"))

    return make


def _write_ros1_bag(folder: Path) -> tuple[Path, Path]:
    """Write a ROS 1 bag; return source and file."""
    path = foreign.write_ros1_bag(folder / "flight.bag")
    return path, path


def _make_picture_writer(name: str) -> Callable[[Path], tuple[Path, Path]]:
    """Return a function that writes a folder of one image, and returns source and file."""

    def make(folder: Path) -> tuple[Path, Path]:
        path = folder / name
        path.write_bytes(foreign.encode_grey_image()[name])
        return folder, path

    return make


def _write_nanocockpit(folder: Path) -> tuple[Path, Path]:
    """Write a nanocockpit folder; return it and one of its images."""
    source = foreign.write_nanocockpit(folder / "cockpit")
    return source, source / "camera_raw" / "00002.png"


def _write_ranges(folder: Path) -> tuple[Path, Path]:
    """Write ranges of TIERS; return source and file."""
    path = folder / "ranges.npz"
    time = np.arange(20)
    pose = {f"optitrack_turtle0{n}_pose_np": np.stack([time * 0.01, time * n], 1) for n in (1, 2)}
    turn = {f"optitrack_turtle0{n}_orientation_np": time * 0.1 for n in (1, 2)}
    np.savez(path, **pose, **turn, uwb_range_1_2_np=time * 1.0)
    return path, path


def _make_saved_picture_writer(suffix: str) -> Callable[[Path], tuple[Path, Path]]:
    """Return a function that saves an image by Pillow, and returns its folder and file."""

    def make(folder: Path) -> tuple[Path, Path]:
        path = folder / f"a.{suffix}"
        rgb = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8)
        PIL.Image.fromarray(rgb).save(path)
        return folder, path

    return make


def _make_label_writer(name: str, text: str) -> Callable[[Path], tuple[Path, Path]]:
    """Return a function that writes an image with a file of labels, and returns source and file."""

    def make(folder: Path) -> tuple[Path, Path]:
        (folder / "a.png").write_bytes(foreign.encode_grey_image()["a.png"])
        (folder / "classes.txt").write_text("drone\n")
        (folder / name).write_text(text)
        return folder, folder / name

    return make


BOXES = "0 0.5 0.5 0.25 0.5\n0 0.2 0.2 0.1 0.1 0.9\n0 0.1 0.2 0.5 0.2 0.3 0.7\n"
DESCRIPTION = "path: .\ntrain: images/train\nval: [a, b]\nnames:\n  0: drone\n  1: 'x y'\n"
COCO = """{"images": [{"id": 1, "file_name": "a.png", "width": 5, "height": 4}],
"categories": [{"id": 1, "name": "drone"}], "annotations": [
{"id": 1, "image_id": 1, "category_id": 1, "bbox": [1, 2, 3, 4], "attributes": {"depth_m": 2}}]}
"""
VOC = """<annotation><size><width>5</width><height>4</height></size><object><name>drone</name>
<bndbox><xmin>1</xmin><ymin>2</ymin><xmax>3</xmax><ymax>4</ymax></bndbox></object></annotation>
"""

# Format of each source, and a function that writes it. The function returns the source and the
# file of it that is damaged.
SOURCES = {
    "cfusdlog 1": ("cfusdlog", _make_usd_writer(1)),
    "cfusdlog 2": ("cfusdlog", _make_usd_writer(2)),
    "hyperflash": ("hyperflash", _write_flash),
    "aideck-stream": ("aideck-stream", _write_stream),
    "rosbag2 db3": ("rosbag2", _make_ros2_writer("sqlite3")),
    "rosbag2 mcap": ("rosbag2", _make_ros2_writer("mcap")),
    "ROS 1 bag": ("rosbag2", _write_ros1_bag),
    "PNG": ("images", _make_picture_writer("a.png")),
    "JPEG": ("images", _make_picture_writer("b.jpg")),
    "PPM": ("images", _make_picture_writer("c.ppm")),
    "TIFF": ("images", _make_saved_picture_writer("tif")),
    "WebP": ("images", _make_saved_picture_writer("webp")),
    "GIF": ("images", _make_saved_picture_writer("gif")),
    "YOLO": ("yolo", _make_label_writer("a.txt", BOXES)),
    "YOLO's description": ("yolo", _make_label_writer("data.yaml", DESCRIPTION)),
    "COCO": ("coco", _make_label_writer("set.json", COCO)),
    "VOC": ("voc", _make_label_writer("a.xml", VOC)),
    "nanocockpit": ("nanocockpit", _write_nanocockpit),
    "npz": ("uwb-tiers", _write_ranges),
}


def convert(name: str, source: Path) -> int:
    """Convert a source; return its number of messages. DmrlError is the only allowed error."""
    count = 0
    for sample in load_builtin_formats()[name].content(source, Options()).samples:
        message_class(sample.message)(**sample.fields).SerializeToString()
        count += 1
    return count


def run(which: str, count: int, folder: Path) -> None:
    """Damage a source ``count`` times; print how often it was refused, and the most memory."""
    import signal  # noqa: PLC0415

    name, make = SOURCES[which]
    source, path = make(folder)
    whole = path.read_bytes()
    assert convert(name, source) > 0
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    rng = np.random.default_rng(len(which))
    failed = 0
    for k in range(count):
        path.write_bytes(mutate(whole, rng))
        signal.alarm(HANG_S)  # ends this process if it hangs
        try:
            convert(name, source)
        except DmrlError as e:
            failed += 1
            assert "\n" not in str(e), str(e)
        except BaseException as e:
            raise AssertionError(f"mutation {k} of {which}: {type(e).__name__}: {e}") from e
        finally:
            signal.alarm(0)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    assert grown < MEMORY_BYTES, f"{grown / 1e6:.0f} MB"
    sys.stdout.write(f"{which}: {failed} of {count} refused, {grown / 1e6:.0f} MB\n")


def _run_in_process(which: str, count: int, folder: Path) -> str:
    """Call `run` in a process of its own; return what it prints."""
    tests = str(Path(__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-c", ALONE, tests, which, str(count), str(folder)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "Traceback" not in done.stderr
    return done.stdout


@pytest.mark.heavy
@pytest.mark.parametrize("which", SOURCES)
def test_damaged_sources_are_refused_or_read(which: str, tmp_path: Path) -> None:
    run(which, 12, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("which", SOURCES)
def test_two_thousand_damaged_sources_are_refused_or_read(
    which: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    cases = round(2000 * float(os.environ.get("DMRL_FAULTS", "1")))
    said = _run_in_process(which, cases, tmp_path)
    refused = int(said.partition(f" of {cases} refused")[0].split()[-1])
    counts = {"cases": cases, "refused": refused, "right": cases - refused}
    row = [f"damaged: a source, {which}", counts]
    request.node.user_properties.append(("faults", row))  # see tests/faults/conftest.py
