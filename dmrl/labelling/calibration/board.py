"""Intrinsics of a camera, from pictures of a chessboard."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.errors import SettingError, SourceError
from dmrl.estimation.calibration import intrinsics
from dmrl.geometry.frames import Camera
from dmrl.guards import limits
from dmrl.guards.paths import refuse_pipes
from dmrl.images.codec import decode
from dmrl.labelling.recorded_camera import choose_robot
from dmrl.recording import read, read_summary
from dmrl.terminal.progress import track

MAX_FOCAL_SHARE = 0.03
"""Largest uncertainty of the focal length, relative to it: distances are off by the same."""
PICTURES = (".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".bmp")


def calibrate_by_board(
    source: Path, corners: str, *, robot: str | None, every: int
) -> tuple[Camera, dict[str, Any]]:
    """Return the intrinsics of the camera that took pictures of a chessboard, and figures.

    Parameters
    ----------
    source
        A folder of pictures, or a recording with images.
    corners
        Inner corners of the board, columns x rows, such as 9x6.
    robot
        Robot of the camera, in a recording. None: the only one there is.
    every
        Step between the images of a recording that are read.

    Raises
    ------
    SourceError
        If pictures are of different sizes, too few show the board, or none shows it tilted.
    SettingError
        If ``corners`` is malformed, or the robot is not named.
    """
    columns, rows = _read_corners(corners)
    views: list[NDArray[np.float32]] = []
    size_px: tuple[int, int] | None = None
    pictures = 0
    for name, data in _read_pictures(source, robot, every):
        rgb = decode(data, name, limits.PIXELS)
        own = rgb.shape[1], rgb.shape[0]
        if own != (size_px := size_px or own):
            raise SourceError(
                f"{name} is {own[0]}x{own[1]} px, those before it {size_px[0]}x{size_px[1]}. "
                "Calibrate with pictures of one size"
            )
        pictures += 1
        at = intrinsics.find_corners(np.asarray(rgb.mean(axis=2), np.uint8), columns, rows)
        views += [] if at is None else [at]
    if len(views) < intrinsics.MIN_BOARDS or size_px is None:
        raise SourceError(
            f"{source}: a board of {columns}x{rows} inner corners in {len(views)} of {pictures} "
            f"pictures; {intrinsics.MIN_BOARDS} are needed. Check --board, and light and focus"
            + (", or look at more: --every 1" if source.is_file() and every > 1 else "")
        )
    found = intrinsics.calibrate_intrinsics(views, (columns, rows), size_px)
    _refuse_uncertain(source, found)
    figures = {
        "pictures": pictures,
        "with_board": len(views),
        "rms_px": found.rms_px,
        "focal_px": [found.camera.fx_px, found.camera.fy_px],
        "focal_std_px": list(found.focal_std_px),
        "centre_px": [found.camera.cx_px, found.camera.cy_px],
        "centre_std_px": list(found.centre_std_px),
        "distortion": list(found.camera.distortion),
    }
    return found.camera, figures


def _refuse_uncertain(source: Path, found: intrinsics.Intrinsics) -> None:
    """Raise SourceError unless the boards determine the focal length."""
    if found.focal_share > MAX_FOCAL_SHARE:
        raise SourceError(
            f"{source}: its boards leave the focal length uncertain by "
            f"{min(found.focal_share, 1):.0%} or more. Add pictures of the board tilted by 30 "
            "degrees, each to another side"
        )


def _read_corners(text: str) -> tuple[int, int]:
    """Return the columns and rows of ``9x6``."""
    columns, _, rows = text.partition("x")
    if not (columns.isdigit() and rows.isdigit() and int(columns) > 2 and int(rows) > 2):
        raise SettingError(f"--board {text}: give inner corners, columns x rows, such as 9x6")
    return int(columns), int(rows)


def _read_pictures(source: Path, robot: str | None, every: int) -> Iterator[tuple[str, bytes]]:
    """Yield the names and bytes of the pictures of a folder, or of a robot's images."""
    if source.is_dir():
        refuse_pipes(source)
        paths = sorted(p for p in source.iterdir() if p.suffix.lower() in PICTURES)
        yield from ((str(path), path.read_bytes()) for path in track(paths, "Looking for boards"))
        return
    if not source.exists():
        raise SourceError(f"no recording or folder of pictures {source}. Check the name")
    robot = choose_robot(source, robot, topics.CAMERA_IMAGE)
    total = read_summary(source).topics[topics.CAMERA_IMAGE(robot)].count
    stamped = track(read(source, topics.CAMERA_IMAGE(robot)), "Looking for boards", total)
    for k, one in enumerate(stamped):
        if k % every == 0:
            yield f"{source}: the image at {one.time_ns} ns", one.message.data
