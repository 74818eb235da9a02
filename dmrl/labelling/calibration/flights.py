"""Mount and delay of a camera, from flights in which it detected peers."""

from pathlib import Path
from typing import Any, Literal

import numpy as np

from dmrl import topics
from dmrl.errors import RecordingError
from dmrl.estimation.calibration.extrinsics import MIN_MATCHES, Calibration, calibrate_mount
from dmrl.estimation.calibration.noise import Noise
from dmrl.geometry.frames import Camera
from dmrl.labelling.calibration.calibration_flight import read_calibration_flight
from dmrl.labelling.flight_log import OBSERVER_TOPICS, TRUTH_TOPICS, read_flight
from dmrl.labelling.recorded_camera import choose_robot, read_robot_camera, require_camera
from dmrl.terminal.progress import say, track

DOUBTED_SHARE = 0.025
"""Median residual that is doubted, relative to the width of the images: 8 px of 320. Networks are
within 3 px of sharp images; focal lengths that are off by 20 % leave 11 px."""


def calibrate_by_flights(
    sources: list[Path],
    *,
    robot: str | None,
    against: Literal["estimate", "truth"],
    camera_file: Path | None,
    threshold: float | None,
    noise: Noise,
) -> tuple[Camera, dict[str, Any]]:
    """Return the camera whose mount and delay fit the detections of flights, and figures.

    Parameters
    ----------
    sources
        Recordings with detections and positions of peers, all by the same camera.
    robot
        Robot of the camera. None: the only one there is.
    against
        Positions that were estimated, or true ones.
    camera_file
        Camera to start from. None: the recordings'.
    threshold
        Least confidence of a detection. None: the recordings'.
    noise
        Errors of detections and attitude.

    Raises
    ------
    RecordingError
        If too few detections lie near the peers.
    """
    robots = [choose_robot(source, robot, topics.DETECTIONS) for source in sources]
    positions, *more = (topics.POSITION,) if against == "estimate" else TRUTH_TOPICS
    camera = None
    flights = []
    for source, name in zip(track(sources, "Reading"), robots, strict=True):
        sizes_of = [name] if camera_file else []
        held = read_flight(source, *OBSERVER_TOPICS, positions, *more, sizes_of=sizes_of)
        if camera_file:
            camera = read_robot_camera(held, name, camera_file)
        camera = require_camera(held, name, camera)
        flights.append(read_calibration_flight(held, name, threshold, positions))
    assert camera is not None
    found = calibrate_mount(flights, camera, noise)
    if found is None:
        raise RecordingError(
            f"{sources[0]}: fewer than {MIN_MATCHES} detections of {robots[0]} lie near where its "
            "peers "
            "are. Was it the right model? Try: dmrl evaluate"
        )
    _warn_of_residual(robots[0], found)
    return found.camera, _figures(robots[0], found)


def _warn_of_residual(robot: str, found: Calibration) -> None:
    """Print a line if detections lie far from their predictions, with the likely cause."""
    if found.after_px <= DOUBTED_SHARE * found.camera.width_px:
        return
    cause = "Check the intrinsics (--camera) and the model"
    if found.after_px <= found.expected_px:
        cause = (
            f"The sigmas of the positions explain it: they allow {found.expected_px:.0f} px. Add "
            "flights with more precise positions"
        )
    say(
        f"{robot}: doubt: half of its detections are {found.after_px:.0f} px or more from where "
        f"this calibration expects them. {cause}"
    )


def _figures(robot: str, found: Calibration) -> dict[str, Any]:
    return {
        "robot": robot,
        "detections": found.matched,
        "mount_deg": np.degrees(found.camera.mount_rad).tolist(),
        "mount_std_deg": np.degrees(found.mount_std_rad).tolist(),
        "delay_ms": 1e3 * found.camera.delay_s,
        "delay_std_ms": 1e3 * found.delay_std_s,
        "median_before_px": found.before_px,
        "median_after_px": found.after_px,
    }
