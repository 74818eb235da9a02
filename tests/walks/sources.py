"""A small source of every kind in docs/sources.md, and functions that damage a file."""

from collections.abc import Callable
from pathlib import Path
from shutil import copytree

import numpy as np

from ..formats import foreign
from ..formats.test_fuzz import SOURCES as BINARY

Made = tuple[Path, Path]
"""A source, and the file of it that is damaged."""


def write_client_log(folder: Path) -> Made:
    """Write two log blocks of the Crazyflie client."""
    names = ("vx", "vy", "z", "roll", "pitch", "yaw")
    head = ",".join(f"stateEstimate.{name}" for name in names)
    rows = [f"{1000 + 10 * k},0.5,0.1,1.0,1.5,2.5,{0.1 * k:.1f}" for k in range(50)]
    (folder / "cf1").mkdir()
    path = folder / "cf1" / "state-20221011T10-33-31.csv"
    path.write_text("\n".join([f"Timestamp,{head}", *rows]) + "\n")
    ranges = [f"{1000 + 20 * k},{1500 + k}" for k in range(25)]
    other = folder / "cf1" / "range-20221011T10-33-32.csv"
    other.write_text("\n".join(["Timestamp,ranging.distance2", *ranges]) + "\n")
    return folder / "cf1", path


def write_flight_logs(folder: Path) -> Made:
    """Write the CSV logs of two robots with dmrl's own columns."""
    columns = "time_s,roll_rad,pitch_rad,yaw_rate_radps,vx_mps,vy_mps,height_m"
    flight = folder / "flight"
    flight.mkdir()
    for robot, peer in (("cf1", "cf2"), ("cf2", "cf1")):
        rows = [f"{0.01 * k:.2f},0.01,0.02,0.1,0.5,0.1,1.0,{1.5 + 0.01 * k:.2f}" for k in range(50)]
        text = "\n".join([f"{columns},range_{peer}_m", *rows]) + "\n"
        (flight / f"{robot}.csv").write_text(text)
    return flight, flight / "cf2.csv"


def write_nanobench(folder: Path) -> Made:
    """Write fifty rows with the columns of NanoBench."""
    from dmrl.formats.files.column_map import read_column_map  # noqa: PLC0415
    from dmrl.formats.files.mapped_csv import NANOBENCH_TABLE  # noqa: PLC0415

    names = sorted(read_column_map(NANOBENCH_TABLE).names - {"t", "qw"})
    rows = [f"{1772662978 + 0.01 * k:.9f},1," + ",".join(["0.01"] * len(names)) for k in range(50)]
    path = folder / "B7_oval.csv"
    path.write_text("\n".join([",".join(["t", "qw", *names]), *rows]) + "\n")
    return path, path


def write_pictures(folder: Path) -> Made:
    """Write images and labels; the file of labels is damaged."""
    source = folder / "pictures"
    source.mkdir()
    for name, data in foreign.encode_grey_image().items():
        (source / name).write_bytes(data)
    rows = [f"{name},cf2,10.5,8.5,1.2,hand" for name in sorted(foreign.encode_grey_image())]
    path = source / "labels.csv"
    path.write_text("\n".join(["file,peer,u_px,v_px,depth_m,source", *rows]) + "\n")
    return source, path


def make_published_writer(data: Path) -> Callable[[Path], Made]:
    """Return a function that copies a part of the published set."""

    def make(folder: Path) -> Made:
        source = folder / "published"
        copytree(data / "locanet-multi", source)
        return source, source / "posLabel.txt"

    return make


KINDS: dict[str, Callable[[Path], Made]] = {
    **{which: make for which, (_, make) in BINARY.items()},
    "cfclient": write_client_log,
    "csv": write_flight_logs,
    "columns": write_nanobench,
    "labels of pictures": write_pictures,
}


def truncate(data: bytes) -> bytes:
    """Drop the last two fifths, as after an empty battery."""
    return data[: len(data) * 3 // 5]


def empty(_: bytes) -> bytes:
    """Drop everything."""
    return b""


def overwrite_middle(data: bytes) -> bytes:
    """Replace 64 bytes in the middle by random ones."""
    at = len(data) // 2
    noise = np.random.default_rng(at).integers(0, 256, 64, np.uint8).tobytes()
    return data[:at] + noise + data[at + 64 :]


def replace_by_text(_: bytes) -> bytes:
    """Replace everything by a text of another kind."""
    return b"Dear diary,\ntoday the drones flew.\n" * 40


def double(data: bytes) -> bytes:
    """Append a copy."""
    return data + data


DAMAGES = (truncate, empty, overwrite_middle, replace_by_text, double)
