"""State of a Crazyflie as time series, from whichever of its log variables contain it."""

from collections.abc import Sequence

import numpy as np

from dmrl.formats.crazyflie.log_block import Block, Series, series, unpacked_quaternion
from dmrl.geometry.frames import Array
from dmrl.geometry.rotations import euler_zyx, quaternion_zyx

ANGLES = ("roll", "pitch", "yaw")


def attitude_of(blocks: Sequence[Block]) -> Series | None:
    """Return roll, pitch, yaw of Rz Ry Rx, radians, (N, 3), yaw unwrapped; None: not all logged."""
    turned = quaternions_of(blocks)
    if turned is not None:
        angles = euler_zyx(turned.values)
        return Series(turned.time_ns, np.column_stack([angles[:, :2], np.unwrap(angles[:, 2])]))
    roll, pitch, yaw = (angle_of(blocks, name) for name in ANGLES)
    if roll is None or pitch is None or yaw is None:
        return None
    # Angles of other blocks are interpolated at the times of the first.
    columns = [roll.values, -pitch.at(roll.time_ns), yaw.at(roll.time_ns)]
    return Series(roll.time_ns, np.hstack(columns))


def angle_of(blocks: Sequence[Block], name: str) -> Series | None:
    """Return (N, 1) radians, with the sign of the log, unwrapped; None: not logged."""
    for group in ("stateEstimate", "stabilizer"):
        logged = series(blocks, [f"{group}.{name}"])
        if logged is not None:
            return Series(logged.time_ns, np.unwrap(np.radians(logged.values), axis=0))
    return None


def quaternions_of(blocks: Sequence[Block], group: str = "stateEstimate") -> Series | None:
    """Return (N, 4) unit quaternions x, y, z, w, without rows before the estimator has started."""
    logged = series(blocks, [f"{group}.{name}" for name in ("qx", "qy", "qz", "qw")])
    packed = series(blocks, ["stateEstimateZ.quat"]) if group == "stateEstimate" else None
    if logged is None and packed is not None:
        logged = Series(packed.time_ns, unpacked_quaternion(packed.values[:, 0].astype(np.int64)))
    if logged is None:
        return None
    norm = np.linalg.norm(logged.values, axis=1)
    good = np.abs(norm - 1) < 0.1
    if not good.any():
        return None
    return Series(logged.time_ns[good], logged.values[good] / norm[good, None])


def yaw_rate_of(blocks: Sequence[Block], attitude: Series) -> Array:
    """Compute the (N,) yaw rate about the vertical at the times of the attitude, rad/s.

    From the gyroscope: (q sin(roll) + r cos(roll)) / cos(pitch), or r alone where q was not
    logged. Without a gyroscope: the slope of the yaw.
    """
    roll, pitch, yaw = attitude.values.T
    both = series(blocks, ["gyro.y", "gyro.z"])
    if both is not None:
        q, r = np.radians(both.at(attitude.time_ns)).T
        return np.asarray((q * np.sin(roll) + r * np.cos(roll)) / np.cos(pitch))
    for name, unit in (("gyro.z", np.pi / 180), ("stateEstimateZ.rateYaw", 1e-3)):
        alone = series(blocks, [name])
        if alone is not None:
            return np.asarray(alone.at(attitude.time_ns)[:, 0] * unit)
    time_s = (attitude.time_ns - attitude.time_ns[0]) * 1e-9
    usable = len(yaw) > 1 and (np.diff(time_s) > 0).all()
    return np.asarray(np.gradient(yaw, time_s) if usable else 0 * yaw)


def scaled(blocks: Sequence[Block], names: str) -> Series | None:
    """Return state in metres: from stateEstimate, else from stateEstimateZ, in millimetres."""
    plain = series(blocks, [f"stateEstimate.{name}" for name in names.split()])
    if plain is not None:
        return plain
    packed = series(blocks, [f"stateEstimateZ.{name}" for name in names.split()])
    return None if packed is None else Series(packed.time_ns, packed.values * 1e-3)


def turn_of(blocks: Sequence[Block]) -> Series | None:
    """Return (N, 4) unit quaternions x, y, z, w, else from the angles; missing angles are 0.

    None: no orientation was logged.
    """
    turned = quaternions_of(blocks)
    angles = {name: angle for name in ANGLES if (angle := angle_of(blocks, name)) is not None}
    if turned is not None or not angles:
        return turned
    time_ns = next(iter(angles.values())).time_ns
    still = np.zeros((len(time_ns), 1))
    roll, pitch, yaw = (angles[n].at(time_ns) if n in angles else still for n in ANGLES)
    return Series(time_ns, quaternion_zyx(np.hstack([roll, -pitch, yaw])))
