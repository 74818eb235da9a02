"""Model of a Crazyflie 2.1 at life size: the parts of ``crazyflie.toml``, and rotors.

92 mm from motor to motor, 29 mm high, rotors of 45 mm. Body frame: x forward, y left, z up,
metres, origin in the middle of the bounding box.
"""

from collections.abc import Iterator

import numpy as np

from dmrl.geometry.frames import Array
from dmrl.rendering.robots.primitives import MOTOR_ANGLES_RAD, ROTOR, Part, load_design

ARM_M = 0.046
ROTOR_RADIUS_M = 0.0225
HEIGHT_M = 0.029
ROTOR_Z_M = HEIGHT_M / 2 - 0.0008
BLADE_HALF_WIDTH_M = 0.0028
ROTOR_STEP_RAD = 1.7
"""Rotation of each rotor beyond the previous one."""


def _rotor_parts() -> Iterator[Part]:
    """Yield the discs that the blades sweep. Their material shows the blades."""
    sides = 40
    turn = 2 * np.pi * np.arange(sides) / sides
    rim = np.column_stack([np.cos(turn), np.sin(turn)]) * ROTOR_RADIUS_M
    fan = np.array([(k, (k + 1) % sides, sides) for k in range(sides)])
    for angle in MOTOR_ANGLES_RAD:
        hub = np.array([np.cos(angle), np.sin(angle)]) * ARM_M
        points = np.concatenate([rim, [(0.0, 0.0)]]) + hub
        yield "rotor", np.column_stack([points, np.full(sides + 1, ROTOR_Z_M)]), fan


CRAZYFLIE = load_design("crazyflie", _rotor_parts)


def outline_points(scale: float, first_rad: float, sweep_rad: float) -> Array:
    """Return (N, 3) points that span the visible robot: body and swept blades.

    Parameters
    ----------
    scale
        Times life size.
    first_rad
        Angle of rotor 0 when the shutter opens.
    sweep_rad
        Rotation of all rotors during the exposure.
    """
    whole = CRAZYFLIE.build_mesh()
    rotor = CRAZYFLIE.materials.index(ROTOR)
    body = whole.vertices[np.unique(whole.faces[whole.material != rotor])]
    radius = np.linspace(0.004, ROTOR_RADIUS_M, 12)
    half = BLADE_HALF_WIDTH_M / radius
    rim = np.linspace(-half[-1], min(sweep_rad, np.pi) + half[-1], 60)
    angle = np.concatenate([-half, min(sweep_rad, np.pi) + half, rim])
    radius = np.concatenate([radius, radius, np.full(60, ROTOR_RADIUS_M)])
    points = [body]
    for k, arm in enumerate(MOTOR_ANGLES_RAD):
        for blade in (0.0, np.pi):
            turn = angle + first_rad + k * ROTOR_STEP_RAD + blade
            x = np.cos(turn) * radius + np.cos(arm) * ARM_M
            y = np.sin(turn) * radius + np.sin(arm) * ARM_M
            points.append(np.column_stack([x, y, np.full(len(x), ROTOR_Z_M)]))
    return np.concatenate(points) * scale
