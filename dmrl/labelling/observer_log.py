"""One observer's detections, motion and ranges, image by image."""

from dataclasses import dataclass

import numpy as np

from dmrl import topics
from dmrl.errors import MissingTopic, RecordingError
from dmrl.estimation.tracking.tracker_input import EgoMotion, ImageDetections
from dmrl.geometry.frames import Array, Camera
from dmrl.labelling.flight_log import FlightLog, Samples, Times

LONGEST_GAP_S = 0.1
"""Longest time between an image and a range that counts for it, seconds."""

HEIGHT_WINDOW_S = 0.1
"""Time before an image over which the observer's height is averaged, seconds: that between images
at 10 Hz."""


@dataclass(frozen=True, slots=True)
class ObserverLog:
    """One observer's detections with its own motion, image by image.

    Parameters
    ----------
    robot
        Its name.
    camera
        Its camera; no distortion if the images have none any more.
    log_time_ns, time_ns
        (K,) log times of the images, and when they were taken.
    detections
        (M, 5) u and v in pixels, depth and its standard deviation in metres (0: unknown), and
        confidence, of all images.
    first_row
        (K + 1,) row of each image's first detection, and the end.
    attitude_rad
        (K, 2) roll and pitch.
    path_m, yaw_rad
        (K, 3) and (K,) dead-reckoned position of the observer in a frame fixed to ground, and its
        heading there.
    range_m
        (K,) distances by peer, NaN where there was none.
    warnings
        One line for each sensor that was missing.
    """

    robot: str
    camera: Camera
    log_time_ns: Times
    time_ns: Times
    detections: Array
    first_row: Times
    attitude_rad: Array
    path_m: Array
    yaw_rad: Array
    range_m: dict[str, Array]
    warnings: list[str]

    def motion(self, k: int) -> EgoMotion:
        """Return the observer's motion between images k - 1 and k."""
        if k == 0:
            return EgoMotion(0.0, np.zeros(3), 0.0)
        # R(-yaw) turns the way into the observer's frame at the image before.
        c, s = np.cos(self.yaw_rad[k - 1]), np.sin(self.yaw_rad[k - 1])
        x, y, z = self.path_m[k] - self.path_m[k - 1]
        shift_m = np.array([c * x + s * y, -s * x + c * y, z])
        dt_s = float(self.time_ns[k] - self.time_ns[k - 1]) * 1e-9
        return EgoMotion(dt_s, shift_m, float(self.yaw_rad[k] - self.yaw_rad[k - 1]))

    def view(self, k: int) -> ImageDetections:
        """Return the detections of image k."""
        rows = self.detections[self.first_row[k] : self.first_row[k + 1]]
        roll_rad, pitch_rad = self.attitude_rad[k]
        return ImageDetections(
            rows[:, :2], rows[:, 2], float(roll_rad), float(pitch_rad), rows[:, 4], rows[:, 3]
        )

    def ranges(self, k: int) -> dict[str, float]:
        """Return the distances measured near image k by peer, metres."""
        near = ((peer, float(values[k])) for peer, values in self.range_m.items())
        return {peer: value for peer, value in near if np.isfinite(value)}


def read_observer_log(
    flight: FlightLog, robot: str, camera: Camera, threshold: float | None
) -> ObserverLog:
    """Return the log of one observer.

    Parameters
    ----------
    flight
        With the topics `flight_log.OBSERVER_TOPICS`.
    robot
        The observer.
    camera
        Its camera; no distortion if the images have none any more.
    threshold
        Least confidence of a detection; None: the detector's own.

    Raises
    ------
    RecordingError
        If the robot has no detections or no attitude.
    """
    log_time_ns, detections, first_row = select_detections(flight, robot, threshold)
    time_ns = log_time_ns - round(camera.delay_s * 1e9)
    attitude_ns, attitude = finite_attitude(flight, robot)
    warnings: list[str] = []
    yaw_rad = _integrate(attitude_ns, attitude[:, 2:])[:, 0]
    return ObserverLog(
        robot,
        camera,
        log_time_ns,
        time_ns,
        detections,
        first_row,
        np.column_stack([np.interp(time_ns, attitude_ns, c) for c in attitude.T[:2]]),
        _dead_reckon(flight, robot, (attitude_ns, yaw_rad), time_ns, warnings),
        np.interp(time_ns, attitude_ns, yaw_rad),
        _match_ranges(flight, robot, time_ns),
        warnings,
    )


def select_detections(
    flight: FlightLog, robot: str, threshold: float | None
) -> tuple[Times, Array, Times]:
    """Return the images' log times, the confident detections, and each image's first row.

    Raises
    ------
    MissingTopic
        If the robot has no detections.
    """
    if robot not in flight.detections:
        raise MissingTopic(topics.DETECTIONS(robot), flight.topics, flight.path)
    found = flight.detections[robot]
    image = np.repeat(np.arange(len(found.time_ns)), np.diff(found.first))
    least = found.threshold if threshold is None else np.full(len(found.time_ns), threshold)
    keep = (found.rows[:, 4] >= least[image]) & (found.rows[:, 2] > 0)
    first = np.searchsorted(image[keep], np.arange(len(found.time_ns) + 1))
    return found.time_ns, found.rows[keep].astype(float), first


def finite_attitude(flight: FlightLog, robot: str) -> tuple[Times, Array]:
    """Return times, and (N, 3) roll, pitch and yaw rate.

    Raises
    ------
    RecordingError
        If the robot has no attitude, or none that is finite.
    """
    topic = topics.ATTITUDE(robot)
    if robot not in flight.attitude:
        raise MissingTopic(topic, flight.topics, flight.path)
    found = _finite(flight.attitude[robot])
    if found is None:
        raise RecordingError(
            f"{flight.path}: {topic} holds no numbers. Try: dmrl info {flight.path}"
        )
    return found


def _finite(samples: Samples | None) -> tuple[Times, Array] | None:
    """Return times and finite values of a topic; None if there are none."""
    if samples is None:
        return None
    good = np.isfinite(samples.values).all(axis=1)
    return (samples.time_ns[good], samples.values[good]) if good.any() else None


def _dead_reckon(
    flight: FlightLog, robot: str, heading: tuple[Times, Array], time_ns: Times, warnings: list[str]
) -> Array:
    """Return (K, 3) positions at the images, integrated from velocity along the heading."""
    path_m = np.zeros((len(time_ns), 3))
    moving = _finite(flight.velocity.get(robot))
    if moving is None:
        warnings.append(f"{topics.VELOCITY(robot)}: not there; {robot} is taken to stand still")
    else:
        # Velocities are in the robot's own frame: each is turned by its heading before they add up.
        yaw_rad = np.interp(moving[0], *heading)
        forward = np.exp(1j * yaw_rad) * (moving[1] @ [1, 1j])
        along = _integrate(moving[0], np.column_stack([forward.real, forward.imag]))
        for axis in range(2):
            path_m[:, axis] = np.interp(time_ns, moving[0], along[:, axis])
    high = _finite(flight.height.get(robot))
    if high is None:
        warnings.append(f"{topics.HEIGHT(robot)}: not there; {robot} is taken to keep its height")
    else:
        # The noise of single heights would look like motion between two images.
        path_m[:, 2] = _average_before(*high, time_ns)
    return path_m


def _average_before(at_ns: Times, values: Array, time_ns: Times) -> Array:
    """Return (K,) means of a sampled value over ``HEIGHT_WINDOW_S`` before each time."""
    summed = _integrate(at_ns, values)[:, 0]
    ends_ns = np.clip(time_ns, at_ns[0], at_ns[-1])
    starts_ns = np.clip(time_ns - round(HEIGHT_WINDOW_S * 1e9), at_ns[0], at_ns[-1])
    span_s = (ends_ns - starts_ns) * 1e-9
    total = np.interp(ends_ns, at_ns, summed) - np.interp(starts_ns, at_ns, summed)
    here = np.interp(time_ns, at_ns, values[:, 0])
    return np.where(span_s > 0, total / np.where(span_s > 0, span_s, 1.0), here)


def _integrate(time_ns: Times, rate: Array) -> Array:
    """Integrate (N, C) rates per second from the first time on, by the trapezoidal rule."""
    steps = np.diff(time_ns)[:, None] * 1e-9 * (rate[1:] + rate[:-1]) / 2
    return np.concatenate([np.zeros((1, rate.shape[1])), np.cumsum(steps, axis=0)])


def _match_ranges(flight: FlightLog, robot: str, time_ns: Times) -> dict[str, Array]:
    """Return (K,) distances at the images by peer, measured by either robot."""
    found: dict[str, Array] = {}
    for link, samples in flight.ranges.items():
        measured = _finite(samples) if robot in link else None
        if measured is None:
            continue
        peer = link[1] if link[0] == robot else link[0]
        at_ns, values = measured
        after = np.minimum(np.searchsorted(at_ns, time_ns), len(at_ns) - 1)
        before = np.maximum(after - 1, 0)
        nearest = np.where(time_ns - at_ns[before] < at_ns[after] - time_ns, before, after)
        far = np.abs(at_ns[nearest] - time_ns) > LONGEST_GAP_S * 1e9
        near_m = np.where(far, np.nan, values[nearest, 0])
        found[peer] = np.fmin(found.get(peer, near_m), near_m)
    return found
