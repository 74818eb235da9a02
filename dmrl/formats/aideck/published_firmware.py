"""Numbers that the published firmware stores with an image: attitude and position of the peer.

They are roll and pitch in degrees with the Crazyflie's signs (pitch positive nose up), x, y, z
of the peer in the horizontal frame and its UWB distance d, metres. A dump of the flash contains
them, and so does a text file beside images, as ``imgNNNNN.ppm roll pitch x y z d``.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from dmrl import topics
from dmrl.geometry.frames import Camera, pixels_from_horizontal
from dmrl.messages import LogType
from dmrl.samples.sample import Sample, build_labels

VARIABLES = ("roll", "pitch", "x", "y", "z", "d")
LABEL_SOURCE = "estimate"
LOG_TYPE = LogType("aideck", tuple((name, "f") for name in VARIABLES))
MIN_DEPTH_M = 0.05
MAX_DISTANCE_M = 60.0


def is_plausible(values: Sequence[float]) -> bool:
    """Return whether six numbers are finite and possible for a flying drone."""
    roll, pitch, *rest = values
    return all(map(math.isfinite, values)) and (
        max(abs(roll), abs(pitch)) <= 180.0 and max(map(abs, rest)) <= MAX_DISTANCE_M
    )


def iter_samples(
    time_ns: int, robot: str, peer: str, values: Sequence[float], camera: Camera | None
) -> Iterator[Sample]:
    """Yield the six numbers as logged, and as messages; with a camera, a label as well.

    Parameters
    ----------
    time_ns
        Time of the image.
    robot
        Robot that carries the camera.
    peer
        Robot in view.
    values
        Roll, pitch, x, y, z, d. Implausible ones are only logged.
    camera
        Camera of the stored image; None: unknown.
    """
    fields = dict(zip(VARIABLES, values, strict=True))
    yield Sample(time_ns, topics.LOG(robot, LOG_TYPE.name), LOG_TYPE, fields)
    if not is_plausible(values):
        return
    roll, pitch = math.radians(values[0]), -math.radians(values[1])
    xyz = dict(zip("xyz", values[2:5], strict=True))
    attitude = {"roll_rad": roll, "pitch_rad": pitch}
    yield Sample(time_ns, topics.ATTITUDE(robot), "Attitude", attitude)
    place = {"frame_id": f"{robot}/horizontal", **xyz}
    yield Sample(time_ns, topics.POSITION(robot, peer), "PeerPosition", place)
    if values[5] > 0:
        yield Sample(time_ns, topics.RANGE(robot, peer), "UwbRange", {"range_m": values[5]})
    if camera is not None:
        yield build_labels(
            time_ns, robot, _build_label(peer, values[2:5], roll, pitch, camera), [LABEL_SOURCE]
        )


def _build_label(
    peer: str, xyz: Sequence[float], roll: float, pitch: float, camera: Camera
) -> list[dict[str, object]]:
    """Build the label from the firmware's estimate; empty if the peer is out of view."""
    uv, depth_m, _ = pixels_from_horizontal(
        np.array([xyz]), np.array([roll]), np.array([pitch]), camera
    )
    (u, v), depth = uv[0].tolist(), float(depth_m[0])
    if not (depth > MIN_DEPTH_M and 0 <= u < camera.width_px and 0 <= v < camera.height_px):
        return []
    return [{"peer": peer, "u_px": u, "v_px": v, "depth_m": depth, "source": LABEL_SOURCE}]
