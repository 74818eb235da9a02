"""The frames of /tf, compared with the geometry of dmrl."""

import numpy as np
import pytest

from dmrl.geometry.frames import OPTICAL_FROM_CAMERA, Array, camera_from_horizontal
from dmrl.samples.flight import RobotPose, build_transforms

ANGLES = [(0.3, 0.2, 0.0), (-0.4, 0.1, 2.0), (0.2, -0.5, -1.0), (-0.3, -0.2, 3.0)]


def build_matrix(rotation: dict[str, float]) -> Array:
    """Return the matrix (3, 3) from child to parent of a unit quaternion."""
    x, y, z, w = (rotation[name] for name in "xyzw")
    assert x * x + y * y + z * z + w * w == pytest.approx(1)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


@pytest.mark.parametrize(("roll", "pitch", "yaw"), ANGLES)
def test_frames_have_the_rotations_of_the_geometry(roll: float, pitch: float, yaw: float) -> None:
    place = np.array([1.0, 2.0, 0.5])
    sample = build_transforms(3_000_000_007, {"cf1": RobotPose(place, yaw, roll, pitch)})
    world, camera, optical = sample.fields["transforms"]
    assert (sample.time_ns, world["timestamp"]) == (3_000_000_007, {"seconds": 3, "nanos": 7})
    assert (world["parent_frame_id"], world["child_frame_id"]) == ("world", "cf1/horizontal")
    assert world["translation"] == {"x": 1.0, "y": 2.0, "z": 0.5}
    c, s = np.cos(yaw), np.sin(yaw)
    np.testing.assert_allclose(
        build_matrix(world["rotation"]), [[c, -s, 0], [s, c, 0], [0, 0, 1]], atol=1e-12
    )
    np.testing.assert_allclose(
        build_matrix(camera["rotation"]), camera_from_horizontal(roll, pitch).T, atol=1e-12
    )
    np.testing.assert_allclose(build_matrix(optical["rotation"]), OPTICAL_FROM_CAMERA.T, atol=1e-12)
