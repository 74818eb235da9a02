"""Model of a bare Crazyflie in bright colours, as in the published renders, at life size.

No decks: a blue board and arms, lilac mounts with long feet, brass motors, violet blades at
rest, a battery in a sea-green frame. Modelled by eye after the published images; nothing comes
from the authors' model. Body frame: x forward, y left, z up, metres. The origin is the reference
point of those images' labels.
"""

from collections.abc import Iterator, Mapping

import numpy as np

from dmrl.rendering.robots.primitives import (
    Colour,
    Finish,
    Part,
    RobotDesign,
    make_box,
    make_chamfered_box,
    make_cylinder,
    rotate_part,
)

PAINT: Mapping[str, Finish] = {
    "board": ((0.072, 0.029, 1.000), 0.75, 0.0, 0.0),
    "arm": ((0.254, 0.148, 0.953), 0.75, 0.0, 0.0),
    "mount": ((0.321, 0.193, 0.668), 0.75, 0.0, 0.0),
    "motor": ((0.745, 0.668, 0.385), 0.75, 0.0, 0.0),
    "blade": ((0.175, 0.029, 0.378), 0.75, 0.0, 0.0),
    "frame": ((0.079, 0.424, 0.300), 0.75, 0.0, 0.0),
    "battery": ((0.167, 0.019, 0.257), 0.75, 0.0, 0.0),
    "pins": ((0.300, 0.160, 0.500), 0.75, 0.0, 0.0),
}
OTHER_COLOURS: Mapping[str, tuple[Colour, ...]] = {}

FIT_SCALE = 0.97
FIT_OFFSET_Z_M = 0.001
"""Scale and vertical offset that fit published training images best, at their labels' poses."""
ARM_M = 0.046
MOTOR_ANGLES_RAD = np.pi / 4 + np.pi / 2 * np.arange(4)
BOARD_Z_M = 0.0
ROTOR_Z_M = 0.0135
BLADE_ANGLES_RAD = (1.65, 1.5, 1.65, 1.6)
BLADE_PROFILE_M = np.array(
    [(0.0031, 0.0030), (0.0063, 0.0044), (0.0115, 0.0046), (0.0189, 0.0034), (0.0241, 0.0018)]
)
"""Radius and half width of a blade, metres."""
BLADE_PITCH_RAD = np.radians([32.0, 30.0, 24.0, 17.0, 12.0])


def _fit_parts() -> Iterator[Part]:
    for name, points, faces in _build_parts():
        yield name, points * FIT_SCALE + np.array([0.0, 0.0, FIT_OFFSET_Z_M]), faces


def _build_parts() -> Iterator[Part]:
    yield make_chamfered_box("board", (0, 0, BOARD_Z_M), (0.030, 0.030, 0.0018), 0.007)
    yield from _battery_parts()
    for k, angle in enumerate(MOTOR_ANGLES_RAD):
        for part in _arm_parts():
            yield rotate_part(part, angle)
        hub = ARM_M * np.cos(angle), ARM_M * np.sin(angle)
        yield _make_blades(hub, BLADE_ANGLES_RAD[k], 1 if k % 2 else -1)


def _battery_parts() -> Iterator[Part]:
    z = BOARD_Z_M
    yield make_box("battery", (0, 0, z + 0.0052), (0.030, 0.0155, 0.0060))
    for y in (-0.0105, 0.0105):
        yield make_box("frame", (0, y, z + 0.0050), (0.021, 0.0030, 0.0080))
        yield make_box("pins", (0, y, z - 0.0030), (0.018, 0.0012, 0.0050))
    for x in (-0.0095, 0.0, 0.0095):
        yield make_box("frame", (x, 0, z + 0.0088), (0.0025, 0.0230, 0.0012))


def _arm_parts() -> Iterator[Part]:
    """Yield arm, mount and motor along +x."""
    yield make_box("arm", (0.028, 0, BOARD_Z_M), (0.030, 0.0072, 0.0018))
    for y in (-0.0035, 0.0035):
        yield make_box("mount", (ARM_M - 0.008, y, BOARD_Z_M - 0.0010), (0.012, 0.0022, 0.0050))
    yield make_cylinder("mount", (ARM_M, 0.0), 0.0048, -0.0075, 0.0035)
    yield make_box("mount", (ARM_M + 0.0030, 0, -0.0115), (0.0020, 0.0050, 0.0090))
    yield make_box("mount", (ARM_M - 0.0035, 0, -0.0115), (0.0020, 0.0050, 0.0090))
    yield make_cylinder("motor", (ARM_M, 0.0), 0.0035, 0.0035, 0.0105)
    yield make_cylinder("blade", (ARM_M, 0.0), 0.0024, 0.0105, ROTOR_Z_M + 0.0015, 10)


def _make_blades(hub: tuple[float, float], at_rad: float, way: int) -> Part:
    """Build two twisted blades, opposite each other."""
    radius, half = BLADE_PROFILE_M.T
    across, up = half * np.cos(BLADE_PITCH_RAD), way * half * np.sin(BLADE_PITCH_RAD)
    edges = np.concatenate(
        [np.column_stack([radius, side * across, side * up]) for side in (-1, 1)]
    )
    count = len(radius)
    k = np.arange(count - 1)
    strip = np.concatenate(
        [
            np.column_stack([k, k + 1, k + count + 1]),
            np.column_stack([k, k + count + 1, k + count]),
        ]
    )
    both = [edges, edges * np.array([-1, -1, 1])]
    points = np.concatenate(both)
    faces = np.concatenate([strip, strip + len(edges)])
    c, s = np.cos(at_rad), np.sin(at_rad)
    points = points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return "blade", points + np.array([*hub, ROTOR_Z_M]), faces


VIOLET = RobotDesign(PAINT, OTHER_COLOURS, lambda: tuple(_fit_parts()))
