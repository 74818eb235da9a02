"""Model of a bare Crazyflie in bright colours, as in the published renders, at life size.

No decks: a blue board and arms, lilac mounts with long feet, brass motors, violet blades at
rest, a battery in a sea-green frame. Modelled by eye after the published images; nothing comes
from the authors' model. Body frame: x forward, y left, z up, metres. The origin is the reference
point of those images' labels.
"""

from collections.abc import Iterator

import numpy as np

from dmrl.geometry.frames import yaw_matrix
from dmrl.rendering.robots.primitives import MOTOR_ANGLES_RAD, Part, load_design

FIT_SCALE = 0.97
FIT_OFFSET_Z_M = 0.001
"""Scale and vertical offset that fit published training images best, at their labels' poses."""
ARM_M = 0.046
ROTOR_Z_M = 0.0135
BLADE_ANGLES_RAD = (1.65, 1.5, 1.65, 1.6)
BLADE_PROFILE_M = np.array(
    [(0.0031, 0.0030), (0.0063, 0.0044), (0.0115, 0.0046), (0.0189, 0.0034), (0.0241, 0.0018)]
)
"""Radius and half width of a blade, metres."""
BLADE_PITCH_RAD = np.radians([32.0, 30.0, 24.0, 17.0, 12.0])


def _blade_parts() -> Iterator[Part]:
    for k, angle in enumerate(MOTOR_ANGLES_RAD):
        hub = ARM_M * np.cos(angle), ARM_M * np.sin(angle)
        yield _make_blades(hub, BLADE_ANGLES_RAD[k], 1 if k % 2 else -1)


def _make_blades(hub: tuple[float, float], at_rad: float, turn_sign: int) -> Part:
    """Build two twisted blades, opposite each other."""
    radius, half = BLADE_PROFILE_M.T
    across, up = half * np.cos(BLADE_PITCH_RAD), turn_sign * half * np.sin(BLADE_PITCH_RAD)
    edges = np.concatenate(
        [np.column_stack([radius, side * across, side * up]) for side in (-1, 1)]
    )
    count = len(radius)
    k = np.arange(count - 1)
    strip = np.concatenate(
        [np.column_stack([k, k + 1, k + count + 1]), np.column_stack([k, k + count + 1, k + count])]
    )
    points = np.concatenate([edges, edges * np.array([-1, -1, 1])])
    faces = np.concatenate([strip, strip + len(edges)])
    return "blade", points @ yaw_matrix(at_rad) + np.array([*hub, ROTOR_Z_M]), faces


VIOLET = load_design("violet", _blade_parts, FIT_SCALE, FIT_OFFSET_Z_M)
