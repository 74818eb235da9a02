"""What a recording says of one observer: its detections, how it moved, and its ranges."""

from dataclasses import dataclass

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray

from dmrl import topics
from dmrl.errors import MissingTopic, RecordingError
from dmrl.estimation.calibration.observations import Flight, PeerPath
from dmrl.estimation.tracking.tracker_input import Motion, View
from dmrl.geometry.frames import Array, Camera
from dmrl.labelling.ground_truth import true_pairs, true_path
from dmrl.messages import STATUS_OK
from dmrl.recording import Contents

SEEN = (
    topics.DETECTIONS,
    topics.CALIBRATION,
    topics.ATTITUDE,
    topics.VELOCITY,
    topics.HEIGHT,
    topics.RANGE,
)
"""What an observer's sight is made of."""
LONGEST_GAP_S = 0.1
"""A range further from an image than this says nothing about it."""
UNSAID = np.eye(3) * 0.1**2
"""(3, 3) m^2, covariance of a position that comes without: a decimetre each way."""

CAPTURED = np.eye(3) * 0.01**2
"""(3, 3) m^2, covariance of a position by motion capture: markers are not quite at the middle."""

Times = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Sight:
    """One observer's detections with its own motion, image by image.

    Parameters
    ----------
    robot
        Its name.
    camera
        Its camera; no distortion if the images have none any more.
    logged_ns, time_ns
        (K,) log times of the images, and when they were taken.
    detections
        (M, 4) u and v in pixels, depth and its standard deviation in metres (0: not known), of
        all images.
    first
        (K + 1,) row of each image's first detection, and the end.
    attitude_rad
        (K, 2) roll and pitch.
    path_m, yaw_rad
        (K, 3) and (K,) where the observer was by its own sensors, in a frame fixed to ground,
        and its heading there.
    range_m
        (K,) distances by peer, NaN where there was none.
    warnings
        One line for each thing that was missing.
    """

    robot: str
    camera: Camera
    logged_ns: Times
    time_ns: Times
    detections: Array
    first: Times
    attitude_rad: Array
    path_m: Array
    yaw_rad: Array
    range_m: dict[str, Array]
    warnings: list[str]

    def motion(self, k: int) -> Motion:
        """Of the observer between images k - 1 and k."""
        if k == 0:
            return Motion(0.0, np.zeros(3), 0.0)
        # R(-yaw) turns the way into the observer's frame at the image before.
        c, s = np.cos(self.yaw_rad[k - 1]), np.sin(self.yaw_rad[k - 1])
        x, y, z = self.path_m[k] - self.path_m[k - 1]
        shift_m = np.array([c * x + s * y, -s * x + c * y, z])
        dt_s = float(self.time_ns[k] - self.time_ns[k - 1]) * 1e-9
        return Motion(dt_s, shift_m, float(self.yaw_rad[k] - self.yaw_rad[k - 1]))

    def view(self, k: int) -> View:
        """Detections of image k."""
        rows = self.detections[self.first[k] : self.first[k + 1]]
        roll_rad, pitch_rad = self.attitude_rad[k]
        return View(rows[:, :2], rows[:, 2], float(roll_rad), float(pitch_rad), rows[:, 3])

    def ranges(self, k: int) -> dict[str, float]:
        """Distance by peer, metres, of those that were heard near image k."""
        near = ((peer, float(values[k])) for peer, values in self.range_m.items())
        return {peer: value for peer, value in near if np.isfinite(value)}


def read_sight(held: Contents, robot: str, camera: Camera, threshold: float | None) -> Sight:
    """One observer of a recording.

    Parameters
    ----------
    held
        A recording with detections, best with what `SEEN` names.
    robot
        The observer.
    camera
        Its camera; no distortion if the images have none any more.
    threshold
        Least confidence of a detection; None: what the detector named.

    Raises
    ------
    RecordingError
        If it cannot be read, or has no attitude of that robot.
    """
    logged_ns, detections, first = _detections(held, robot, threshold)
    time_ns = logged_ns - round(camera.delay_s * 1e9)
    attitude = _attitude(held, robot)
    warnings: list[str] = []
    yaw_rad, path_m = _path(held, robot, attitude, time_ns, warnings)
    return Sight(
        robot,
        camera,
        logged_ns,
        time_ns,
        detections,
        first,
        np.column_stack([np.interp(time_ns, attitude[0], c) for c in attitude[1].T[:2]]),
        path_m,
        yaw_rad,
        _ranges(held, robot, time_ns),
        warnings,
    )


def camera_flight(held: Contents, robot: str, threshold: float | None, positions: str) -> Flight:
    """What one observer saw and where its peers were, to calibrate its camera with.

    Parameters
    ----------
    held
        A recording with detections, attitude and positions.
    robot
        The observer.
    threshold
        Least confidence of a detection; None: what the detector named.
    positions
        Pattern of the topics of positions: `topics.POSITION`, or `topics.TRUTH`, for which
        motion capture of both robots does as well.

    Raises
    ------
    RecordingError
        If it cannot be read, or lacks one of these.
    """
    links = [n for topic in held.topics if (n := topics.names(positions, topic))]
    pairs = [(n["robot"], n["peer"]) for n in links]
    if positions == topics.TRUTH:
        pairs = true_pairs(held.topics)
    peers = [peer for observer, peer in pairs if observer == robot]
    if not peers:
        raise MissingTopic(positions.format(robot=robot, peer="*"), held.topics, held.path)
    time_ns, detections, first = _detections(held, robot, threshold)
    attitude_ns, attitude = _attitude(held, robot)

    def seconds(at_ns: Times) -> Array:
        return np.asarray((at_ns - held.start_ns) * 1e-9)

    paths = ((peer, _known(held, positions, robot, peer)) for peer in peers)
    return Flight(
        seconds(time_ns),
        np.repeat(np.arange(len(time_ns)), np.diff(first)),
        detections[:, :2],
        seconds(attitude_ns),
        attitude[:, :2],
        {peer: path for peer, path in paths if len(path.time_s) > 1},
    )


def _known(held: Contents, positions: str, robot: str, peer: str) -> PeerPath:
    """The positions of a peer that are OK."""
    topic = positions.format(robot=robot, peer=peer)
    if topic not in held.topics:
        true_ns, true_m = true_path(held, robot, peer)
        sure = np.tile(CAPTURED, (len(true_ns), 1, 1))
        return PeerPath(np.asarray((true_ns - held.start_ns) * 1e-9), true_m, sure)
    table = held.table(topic)
    table = table.filter(pc.equal(table["status"], STATUS_OK))
    rows = table["covariance"].to_pylist()
    covariance = [row if len(row) == 9 else UNSAID.ravel() for row in rows]
    return PeerPath(
        (table["log_time"].to_numpy() - held.start_ns) * 1e-9,
        np.column_stack([table[axis].to_numpy() for axis in "xyz"]),
        np.reshape(covariance, (-1, 3, 3)),
    )


def _attitude(held: Contents, robot: str) -> tuple[Times, Array]:
    """Times, and (N, 3) roll, pitch and yaw rate."""
    topic = topics.attitude(robot)
    if topic not in held.topics:
        raise MissingTopic(topic, held.topics, held.path)
    found = _columns(held, topic, "roll_rad", "pitch_rad", "yaw_rate_radps")
    if found is None:
        raise RecordingError(f"{held.path}: {topic} holds no numbers. Try: dmrl info {held.path}")
    return found


def _detections(held: Contents, robot: str, threshold: float | None) -> tuple[Times, Array, Times]:
    """Log times of the images, what was detected, and where each image's begin."""
    table = held.table(topics.detections(robot)).combine_chunks()
    lists = table["detections"].combine_chunks()
    if hasattr(lists, "chunks"):
        lists = lists.chunk(0)
    flat = lists.flatten()
    names = ("u_px", "v_px", "depth_m", "sigma_depth_m", "confidence")
    known = {field.name for field in flat.type}  # recordings of before have no sigma
    zero = np.zeros(len(flat))
    values = np.column_stack(
        [flat.field(n).to_numpy(zero_copy_only=False) if n in known else zero for n in names]
    )
    image = np.repeat(np.arange(len(table)), np.diff(lists.offsets.to_numpy()))
    least = np.array(table["threshold"].to_numpy()) if threshold is None else threshold
    keep = (values[:, 4] >= np.broadcast_to(least, len(table))[image]) & (values[:, 2] > 0)
    first = np.searchsorted(image[keep], np.arange(len(table) + 1))
    return table["log_time"].to_numpy(), values[keep, :4].astype(float), first


def _columns(held: Contents, topic: str, *fields: str) -> tuple[Times, Array] | None:
    """Times and finite values of a topic; None where there are none."""
    table = held.table(topic, fields)
    values = np.column_stack([table[name].to_numpy() for name in fields]).astype(float)
    good = np.isfinite(values).all(axis=1)
    return (table["log_time"].to_numpy()[good], values[good]) if good.any() else None


def _path(
    held: Contents,
    robot: str,
    attitude: tuple[Times, Array],
    time_ns: Times,
    warnings: list[str],
) -> tuple[Array, Array]:
    """(K,) heading and (K, 3) position at the images: yaw rate and velocity, summed up."""
    at_ns, values = attitude
    yaw_rad = _summed(at_ns, values[:, 2:])[:, 0]
    path_m = np.zeros((len(time_ns), 3))
    moving = _if_there(held, topics.velocity(robot), "vx_mps", "vy_mps")
    if moving is None:
        warnings.append(f"{topics.velocity(robot)}: not there; {robot} is taken to stand still")
    else:
        heading = np.interp(moving[0], at_ns, yaw_rad)
        # Velocities are in the robot's own frame: each is turned by its heading before they add up.
        forward = np.exp(1j * heading) * (moving[1] @ [1, 1j])
        along = _summed(moving[0], np.column_stack([forward.real, forward.imag]))
        for axis in range(2):
            path_m[:, axis] = np.interp(time_ns, moving[0], along[:, axis])
    high = _if_there(held, topics.height(robot), "height_m")
    if high is None:
        warnings.append(f"{topics.height(robot)}: not there; {robot} is taken to keep its height")
    else:
        path_m[:, 2] = np.interp(time_ns, high[0], high[1][:, 0])
    return np.interp(time_ns, at_ns, yaw_rad), path_m


def _if_there(held: Contents, topic: str, *fields: str) -> tuple[Times, Array] | None:
    return _columns(held, topic, *fields) if topic in held.topics else None


def _summed(time_ns: Times, rate: Array) -> Array:
    """(N, C) integral of rates per second from the first time on, by trapezia."""
    steps = np.diff(time_ns)[:, None] * 1e-9 * (rate[1:] + rate[:-1]) / 2
    return np.concatenate([np.zeros((1, rate.shape[1])), np.cumsum(steps, axis=0)])


def _ranges(held: Contents, robot: str, time_ns: Times) -> dict[str, Array]:
    """(K,) distance to each peer at the images, measured by either."""
    found: dict[str, Array] = {}
    for topic in held.topics:
        link = topics.names(topics.RANGE, topic)
        if link is None or robot not in link.values():
            continue
        peer = link["peer"] if link["robot"] == robot else link["robot"]
        measured = _columns(held, topic, "range_m")
        if measured is None:
            continue
        at_ns, values = measured
        after = np.minimum(np.searchsorted(at_ns, time_ns), len(at_ns) - 1)
        before = np.maximum(after - 1, 0)
        nearest = np.where(time_ns - at_ns[before] < at_ns[after] - time_ns, before, after)
        far = np.abs(at_ns[nearest] - time_ns) > LONGEST_GAP_S * 1e9
        here = np.where(far, np.nan, values[nearest, 0])
        found[peer] = np.fmin(found.get(peer, here), here)
    return found
