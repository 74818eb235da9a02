"""What a recording says of a robot's camera: its calibration, if none is given."""

from pathlib import Path

from dmrl import topics
from dmrl.errors import RecordingError, SettingError
from dmrl.geometry.calibration import no_camera
from dmrl.geometry.camera_file import read_camera
from dmrl.geometry.frames import Camera
from dmrl.images.codec import size
from dmrl.recording import Contents, read

LENSES = ("", "plumb_bob", "rational_polynomial")
"""Models of a lens that are the plumb bob's, the last if its further coefficients are 0."""


def camera_of(held: Contents, robot: str) -> Camera | None:
    """A robot's camera; None where the recording has no calibration.

    Raises
    ------
    RecordingError
        If its lens is of a model that dmrl does not know, or its numbers are those of no camera.
    """
    topic = topics.calibration(robot)
    first = next(held.messages(topic), None) if topic in held.topics else None
    if first is None:
        return None
    found = first.message
    if found.distortion_model not in LENSES or any(found.D[5:]):
        raise RecordingError(
            f"{held.path}: {topic} has a lens of model {found.distortion_model!r} with "
            f"{len(found.D)} coefficients, dmrl knows plumb_bob with 5. Give another calibration: "
            "dmrl calibrate --board, then --camera"
        )
    if why := no_camera(found.width, found.height, found.K, found.D):
        raise RecordingError(
            f"{held.path}: {topic} {why}. Give another calibration: dmrl calibrate --board, then "
            "--camera"
        )
    fx, _, cx, _, fy, cy, *_ = found.K
    return Camera(found.width, found.height, fx, fy, cx, cy, tuple(found.D[:5]))


def camera_given(held: Contents, robot: str, path: Path) -> Camera:
    """The camera of a TOML file, for a robot's images.

    Raises
    ------
    SourceError
        If the file cannot be read.
    SettingError
        If it is of images of another size.
    """
    camera, topic = read_camera(path), topics.camera_image(robot)
    first = next(read(held.path, topic), None) if topic in held.topics else None
    if first is not None:
        taken = size(first.message.data, f"{held.path}: the first image of {robot}")[:2]
        if taken != (camera.width_px, camera.height_px):
            raise SettingError(
                f"{path} is for images of {camera.width_px}x{camera.height_px}, those of {robot} "
                f"in {held.path} are {taken[0]}x{taken[1]}. Calibrate with such images"
            )
    return camera
