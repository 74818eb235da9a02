"""State of a Crazyflie as time series, from whichever of its log variables contain it."""

from collections.abc import Sequence

import numpy as np

from dmrl.formats.crazyflie.log_block import LogBlock, TimeSeries, find_series, unpack_quaternions
from dmrl.geometry.frames import Array
from dmrl.geometry.rotations import euler_to_quaternion, quaternion_to_euler

ANGLES = ("roll", "pitch", "yaw")


def find_attitude(blocks: Sequence[LogBlock]) -> TimeSeries | None:
    """Return roll, pitch, yaw of Rz Ry Rx, radians, (N, 3), yaw unwrapped; None: not all logged."""
    turned = find_quaternions(blocks)
    if turned is not None:
        angles = quaternion_to_euler(turned.values)
        return TimeSeries(turned.time_ns, np.column_stack([angles[:, :2], np.unwrap(angles[:, 2])]))
    roll, pitch, yaw = (find_angle(blocks, name) for name in ANGLES)
    if roll is None or pitch is None or yaw is None:
        return None
    # Angles of other blocks are interpolated at the times of the first.
    columns = [roll.values, -pitch.interpolate(roll.time_ns), yaw.interpolate(roll.time_ns)]
    return TimeSeries(roll.time_ns, np.hstack(columns))


def find_angle(blocks: Sequence[LogBlock], name: str) -> TimeSeries | None:
    """Return (N, 1) radians, with the sign of the log, unwrapped; None: not logged."""
    for group in ("stateEstimate", "stabilizer"):
        logged = find_series(blocks, [f"{group}.{name}"])
        if logged is not None:
            return TimeSeries(logged.time_ns, np.unwrap(np.radians(logged.values), axis=0))
    return None


def find_quaternions(blocks: Sequence[LogBlock], group: str = "stateEstimate") -> TimeSeries | None:
    """Return (N, 4) unit quaternions x, y, z, w, without rows before the estimator has started."""
    logged = find_series(blocks, [f"{group}.{name}" for name in ("qx", "qy", "qz", "qw")])
    packed = find_series(blocks, ["stateEstimateZ.quat"]) if group == "stateEstimate" else None
    if logged is None and packed is not None:
        numbers = packed.values[:, 0].astype(np.int64)
        logged = TimeSeries(packed.time_ns, unpack_quaternions(numbers))
    if logged is None:
        return None
    norm = np.linalg.norm(logged.values, axis=1)
    good = np.abs(norm - 1) < 0.1
    if not good.any():
        return None
    return TimeSeries(logged.time_ns[good], logged.values[good] / norm[good, None])


def compute_yaw_rate(blocks: Sequence[LogBlock], attitude: TimeSeries) -> Array:
    """Compute the (N,) yaw rate about the vertical at the times of the attitude, rad/s.

    From the gyroscope: (q sin(roll) + r cos(roll)) / cos(pitch), or r alone where q was not
    logged. Without a gyroscope: the slope of the yaw.
    """
    roll, pitch, yaw = attitude.values.T
    both = find_series(blocks, ["gyro.y", "gyro.z"])
    if both is not None:
        q, r = np.radians(both.interpolate(attitude.time_ns)).T
        return np.asarray((q * np.sin(roll) + r * np.cos(roll)) / np.cos(pitch))
    for name, unit in (("gyro.z", np.pi / 180), ("stateEstimateZ.rateYaw", 1e-3)):
        alone = find_series(blocks, [name])
        if alone is not None:
            return np.asarray(alone.interpolate(attitude.time_ns)[:, 0] * unit)
    # Rows may share a time, between which there is no slope.
    time_ns, first = np.unique(attitude.time_ns, return_index=True)
    if len(time_ns) < 2:
        return np.asarray(0 * yaw)
    slope = np.gradient(yaw[first], (time_ns - time_ns[0]) * 1e-9)
    return np.asarray(np.interp(attitude.time_ns, time_ns, slope))


def find_in_metres(blocks: Sequence[LogBlock], names: str) -> TimeSeries | None:
    """Return state in metres: from stateEstimate, else from stateEstimateZ, in millimetres."""
    plain = find_series(blocks, [f"stateEstimate.{name}" for name in names.split()])
    if plain is not None:
        return plain
    packed = find_series(blocks, [f"stateEstimateZ.{name}" for name in names.split()])
    return None if packed is None else TimeSeries(packed.time_ns, packed.values * 1e-3)


def find_orientation(blocks: Sequence[LogBlock]) -> TimeSeries | None:
    """Return (N, 4) unit quaternions x, y, z, w, else from the angles; missing angles are 0.

    None: no orientation was logged.
    """
    turned = find_quaternions(blocks)
    angles = {name: angle for name in ANGLES if (angle := find_angle(blocks, name)) is not None}
    if turned is not None or not angles:
        return turned
    time_ns = next(iter(angles.values())).time_ns
    still = np.zeros((len(time_ns), 1))
    roll, pitch, yaw = (angles[n].interpolate(time_ns) if n in angles else still for n in ANGLES)
    return TimeSeries(time_ns, euler_to_quaternion(np.hstack([roll, -pitch, yaw])))
