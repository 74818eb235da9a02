"""Ranges between ground robots with motion capture: the TIERS group's ``.npz`` files.

Arrays of equal length: ``uwb_range_<a>_<b>_np`` (metres, 0 if not measured),
``optitrack_turtle0<n>_pose_np`` (N, 2) metres and ``..._orientation_np`` radians. The file has
no times. A rate of 10 Hz is assumed: with it, the robots' top speeds match those of their
makers, 0.22 and 0.26 m/s. The file has no odometry either, so velocity and yaw rate are derived
from motion capture and are far better than a drone's. Ranges are unchanged, about 0.35 m too long.
"""

import re
import zipfile
from pathlib import Path

import numpy as np

from dmrl.errors import SourceError
from dmrl.formats.base import Content, Format, Options
from dmrl.geometry.frames import Array
from dmrl.guards.bounded_parsing import ARCHIVE_ERRORS, load_npz
from dmrl.samples import flight
from dmrl.samples.flight import log_from_poses, merge_by_time, to_nanoseconds
from dmrl.samples.sample import Columns

RATE_HZ = 10.0
POSE_ARRAY = re.compile(r"optitrack_turtle(\d{1,3})_pose_np")
RANGE_ARRAY = re.compile(r"uwb_range_(\d{1,3})_(\d{1,3})_np")
MAX_ROBOTS = 64
"""Largest number of robots, since every pair gets a topic."""


def can_read(source: Path) -> bool:
    """Return whether a file is an ``.npz`` with ranges and poses of these names."""
    if source.suffix != ".npz" or not zipfile.is_zipfile(source):
        return False
    try:
        with zipfile.ZipFile(source) as archive:
            names = [name.removesuffix(".npy") for name in archive.namelist()]
    except (OSError, ValueError, *ARCHIVE_ERRORS):
        return False
    return any(map(POSE_ARRAY.fullmatch, names)) and any(map(RANGE_ARRAY.fullmatch, names))


def load_content(source: Path, _options: Options | None = None) -> Content:
    """Load the samples of the file, robots named turtle1, turtle3, ...

    Parameters
    ----------
    source
        The ``.npz`` file.

    Raises
    ------
    SourceError
        If it has no such arrays, or their shapes do not match.
    """
    if not can_read(source):
        raise SourceError(f"{source} has no uwb_range_*_np and optitrack_*_pose_np. Pass another")
    arrays = _load_arrays(source)
    poses = {int(m[1]): _build_pose(arrays, m[1]) for m in map(POSE_ARRAY.fullmatch, arrays) if m}
    streams: list[Columns] = []
    for number, (time_s, xy_m, yaw) in sorted(poses.items()):
        log = log_from_poses(time_s, xy_m, yaw)
        streams += flight.build_robot_log(f"turtle{number}", to_nanoseconds(time_s), log)
        streams += [
            flight.build_truth(
                f"turtle{number}",
                f"turtle{peer}",
                to_nanoseconds(time_s),
                _to_horizontal(xy_m, yaw, other),
            )
            for peer, (_, other, _) in sorted(poses.items())
            if peer != number
        ]
    for match in filter(None, map(RANGE_ARRAY.fullmatch, arrays)):
        streams.append(_build_ranges(match[1], match[2], arrays[match[0]]))
    return Content(merge_by_time(streams))


def _load_arrays(source: Path) -> dict[str, Array]:
    try:
        found = {n: np.asarray(v, float) for n, v in load_npz(source).items() if v.itemsize >= 4}
    except (OSError, ValueError, *ARCHIVE_ERRORS) as e:
        why = " ".join(str(e).split())
        raise SourceError(f"{source} cannot be read: {why}. Download it again") from e
    ranges = [values for name, values in found.items() if RANGE_ARRAY.fullmatch(name)]
    if not all(v.ndim for v in found.values()) or any(v.ndim != 1 for v in ranges):
        raise SourceError(f"{source} has arrays of wrong shapes. Download it again")
    if sum(bool(POSE_ARRAY.fullmatch(name)) for name in found) > MAX_ROBOTS:
        raise SourceError(f"{source} has more than {MAX_ROBOTS} robots. Download it again")
    return found


def _build_pose(arrays: dict[str, Array], number: str) -> tuple[Array, Array, Array]:
    xy_m = arrays[f"optitrack_turtle{number}_pose_np"]
    yaw = arrays.get(f"optitrack_turtle{number}_orientation_np", np.zeros(0))
    if xy_m.shape != (len(yaw), 2) or {len(a) for a in arrays.values()} != {len(yaw)}:
        raise SourceError(f"the arrays of turtle{number} differ in length. Download the file again")
    return np.arange(len(yaw)) / RATE_HZ, xy_m, yaw


def _to_horizontal(here: Array, yaw: Array, peer: Array) -> Array:
    """Return the (N, 3) peer in the horizontal frame of a robot on the same floor."""
    x, y = (peer - here).T
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * x + s * y, c * y - s * x, np.zeros(len(yaw))], axis=1)


def _build_ranges(one: str, other: str, range_m: Array) -> Columns:
    time_ns = to_nanoseconds(np.arange(len(range_m)) / RATE_HZ)
    kept = np.isfinite(range_m) & (range_m > 0)
    return flight.iter_ranges(
        f"turtle{int(one)}", f"turtle{int(other)}", time_ns[kept], range_m[kept]
    )


FORMAT = Format("uwb-tiers", "ranges with motion capture", can_read, load_content, frozenset())
