"""Conversion between quaternions and the angles of Rz(yaw) Ry(pitch) Rx(roll), z up.

Pitch is positive nose down. Frames of cameras are in ``geometry.frames``.
"""

import numpy as np

from dmrl.geometry.frames import Array


def quaternion_to_euler(quaternion: Array) -> Array:
    """Convert (N, 4) x, y, z, w to (N, 3) roll, pitch, yaw of Rz(yaw) Ry(pitch) Rx(roll)."""
    x, y, z, w = quaternion.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.stack([roll, pitch, yaw], axis=1)


def euler_to_quaternion(angles: Array) -> Array:
    """Convert (N, 3) roll, pitch, yaw to (N, 4) x, y, z, w."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles / 2).T, np.sin(angles / 2).T
    xyzw = (
        cy * cp * sr - sy * sp * cr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
        cy * cp * cr + sy * sp * sr,
    )
    return np.stack(xyzw, axis=1)
