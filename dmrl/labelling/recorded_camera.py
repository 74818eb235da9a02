"""Read a robot's camera: from its recording, or from a calibration file."""

from collections.abc import Mapping
from pathlib import Path

from dmrl import topics
from dmrl.errors import MissingTopic, RecordingError, SettingError
from dmrl.geometry.calibration import find_calibration_fault, find_lens_fault
from dmrl.geometry.camera_file import read_camera
from dmrl.geometry.frames import Camera
from dmrl.labelling.flight_log import FlightLog
from dmrl.recording import read_summary


def find_recorded_camera(flight: FlightLog, robot: str) -> Camera | None:
    """Return a robot's camera; None if the recording has no calibration.

    Raises
    ------
    RecordingError
        If its lens model is unknown, or its numbers are invalid.
    """
    found = flight.calibrations.get(robot)
    if found is None:
        return None
    topic, way_out = topics.CALIBRATION(robot), "dmrl calibrate --board, then --camera"
    if why := find_lens_fault(found.distortion_model, found.D):
        raise RecordingError(f"{flight.path}: {topic} {why}. Give another calibration: {way_out}")
    if why := find_calibration_fault(found.width, found.height, found.K, found.D):
        raise RecordingError(f"{flight.path}: {topic} {why}. Give another calibration: {way_out}")
    fx, _, cx, _, fy, cy, *_ = found.K
    return Camera(found.width, found.height, fx, fy, cx, cy, tuple(found.D[:5]))


def require_camera(flight: FlightLog, robot: str, given: Camera | None = None) -> Camera:
    """Return the camera given for a robot, or else the recording's.

    Raises
    ------
    MissingTopic
        If there is neither.
    RecordingError
        As `find_recorded_camera` does.
    """
    camera = given or find_recorded_camera(flight, robot)
    if camera is None:
        raise MissingTopic(topics.CALIBRATION(robot), flight.topics, flight.path)
    return camera


def read_robot_camera(flight: FlightLog, robot: str, path: Path) -> Camera:
    """Read the camera of a TOML file, for a robot's images.

    Parameters
    ----------
    flight
        With the size of the robot's first image, if it has images.
    robot, path
        The robot, and the file.

    Raises
    ------
    SourceError
        If the file cannot be read.
    SettingError
        If it is for images of another size.
    """
    camera = read_camera(path)
    width_px, height_px = taken = flight.image_size_px.get(robot, (0, 0))
    if any(taken) and taken != (camera.width_px, camera.height_px):
        raise SettingError(
            f"{path} is for images of {camera.width_px}x{camera.height_px}, those of {robot} "
            f"in {flight.path} are {width_px}x{height_px}. Calibrate with such images"
        )
    return camera


def read_robot_cameras(flight: FlightLog, paths: Mapping[str, Path]) -> dict[str, Camera]:
    """Read the cameras of TOML files by robot; raise as `read_robot_camera` does."""
    return {robot: read_robot_camera(flight, robot, path) for robot, path in paths.items()}


def choose_robot(source: Path, robot: str | None, pattern: str) -> str:
    """Return the robot that was named, or the only one with a topic of a pattern.

    Raises
    ------
    SettingError
        If there are several and none was named.
    MissingTopic
        If there is none, or not the one that was named.
    """
    held = list(read_summary(source).topics)
    robots = topics.list_robots(held, pattern)
    if robot is None and len(robots) > 1:
        raise SettingError(f"{source} has {', '.join(robots)}. Name one: --robot {robots[0]}")
    robot = robot or (robots[0] if robots else "*")
    if robot not in robots:
        raise MissingTopic(pattern.format(robot=robot), held, source)
    return robot
