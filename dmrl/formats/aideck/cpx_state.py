"""Robot state as the nanocockpit firmware packs it beside each image."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dmrl.formats.crazyflie.log_block import unpack_quaternions

STATE_FORMAT = "I9hi3h"
"""``struct`` format: robot's time (ms), position (mm), velocity (mm/s), acceleration (mm/s^2),
compressed quaternion, turning rates (mrad/s)."""

MAGNITUDE_MAX = (1 << 9) - 1
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class RobotState:
    """Last state that a robot sent to its camera.

    Parameters
    ----------
    robot_ms
        Time of the state on the robot's clock, unwrapped.
    received_us
        Time of arrival on the camera's clock, unwrapped.
    position_m, velocity_mps, acceleration_mps2
        World frame of the robot's estimator.
    quaternion_xyzw
        Attitude, world from body.
    turning_radps
        Angular rates about the body's x, y, z.
    """

    robot_ms: int
    received_us: int
    position_m: Vector = (0.0, 0.0, 0.0)
    velocity_mps: Vector = (0.0, 0.0, 0.0)
    acceleration_mps2: Vector = (0.0, 0.0, 0.0)
    quaternion_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)
    turning_radps: Vector = (0.0, 0.0, 0.0)


def unpack_state(values: Sequence[int], robot_ms: int, received_us: int) -> RobotState:
    """Decode a state from its packed values (``STATE_FORMAT``; more may follow).

    Parameters
    ----------
    values
        Output of ``struct``.
    robot_ms, received_us
        Its two times, unwrapped.
    """
    metres = [value / 1000 for value in values[1:10]]
    turning = [value / 1000 for value in values[11:14]]
    return RobotState(
        robot_ms,
        received_us,
        (metres[0], metres[1], metres[2]),
        (metres[3], metres[4], metres[5]),
        (metres[6], metres[7], metres[8]),
        decompress_quaternion(values[10]),
        (turning[0], turning[1], turning[2]),
    )


def pack_state(state: RobotState) -> tuple[int, ...]:
    """Encode a state as the values of ``STATE_FORMAT``."""
    vectors = (*state.position_m, *state.velocity_mps, *state.acceleration_mps2)
    return (
        state.robot_ms % (1 << 32),
        *(_to_milli(value) for value in vectors),
        compress_quaternion(state.quaternion_xyzw),
        *(_to_milli(value) for value in state.turning_radps),
    )


def _to_milli(value: float) -> int:
    return int(np.clip(round(value * 1000), -32768, 32767))


def decompress_quaternion(packed: int) -> Quaternion:
    """Return x, y, z, w of a 32-bit quaternion: index of the largest part, then the others.

    Each of the others has a sign and 9 bits. Follows the Crazyflie's ``quatcompress.h``. The
    largest part is positive and is computed from the others.
    """
    x, y, z, w = unpack_quaternions(np.array([packed], np.int64))[0].tolist()
    return x, y, z, w


def compress_quaternion(xyzw: Quaternion) -> int:
    """Compress a unit quaternion to 32 bits, signed, as `decompress_quaternion` reads it."""
    largest = int(np.argmax(np.abs(xyzw)))
    packed = largest
    for k, part in enumerate(xyzw):
        if k != largest:
            negative = (part < 0) != (xyzw[largest] < 0)
            magnitude = int(MAGNITUDE_MAX * abs(part) / np.sqrt(0.5) + 0.5)
            packed = packed << 10 | negative << 9 | min(magnitude, MAGNITUDE_MAX)
    return packed - (1 << 32) if packed >> 31 else packed
