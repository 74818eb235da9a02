"""Model of a Crazyflie 2.1 at life size: one mesh with a material per part.

92 mm from motor to motor, 29 mm high, rotors of 45 mm. Body frame: x forward, y left, z up,
metres, origin in the middle of the bounding box.
"""

from collections.abc import Iterator, Mapping

import numpy as np

from dmrl.geometry.frames import Array
from dmrl.rendering.robots.primitives import (
    ROTOR,
    Colour,
    Finish,
    Part,
    RobotDesign,
    make_box,
    make_chamfered_box,
    make_cylinder,
    rotate_part,
)

ARM_M = 0.046
ROTOR_RADIUS_M = 0.0225
HEIGHT_M = 0.029
ROTOR_Z_M = HEIGHT_M / 2 - 0.0008
BLADE_HALF_WIDTH_M = 0.0028
ROTOR_STEP_RAD = 1.7
"""Rotation of each rotor beyond the previous one."""
BOARD_Z_M = -0.0035
MOTOR_ANGLES_RAD = np.pi / 4 + np.pi / 2 * np.arange(4)

PAINT: Mapping[str, Finish] = {
    "board": ((0.012, 0.012, 0.014), 0.45, 0.0, 0.0),
    "deck": ((0.012, 0.014, 0.020), 0.45, 0.0, 0.0),
    "battery": ((0.45, 0.46, 0.48), 0.35, 0.3, 0.0),
    "label": ((0.50, 0.48, 0.40), 0.5, 0.0, 0.0),
    "motor": ((0.50, 0.50, 0.50), 0.3, 0.9, 0.0),
    "mount": ((0.015, 0.015, 0.015), 0.5, 0.0, 0.0),
    "pins": ((0.60, 0.42, 0.15), 0.35, 0.9, 0.0),
    "header": ((0.010, 0.010, 0.010), 0.5, 0.0, 0.0),
    "chip": ((0.010, 0.010, 0.010), 0.4, 0.0, 0.0),
    "connector": ((0.55, 0.55, 0.55), 0.4, 0.5, 0.0),
    "wire": ((0.25, 0.02, 0.02), 0.5, 0.0, 0.0),
    "antenna": ((0.45, 0.45, 0.45), 0.35, 0.8, 0.0),
    "lens": ((0.003, 0.003, 0.004), 0.1, 0.0, 0.0),
    "red": ((1.0, 0.04, 0.02), 0.4, 0.0, 4.0),
    "green": ((0.04, 1.0, 0.1), 0.4, 0.0, 4.0),
    "blue": ((0.05, 0.15, 1.0), 0.4, 0.0, 4.0),
    "rotor": ((0.012, 0.012, 0.012), 0.4, 0.0, 0.0),
}
# Alternative colours in which the parts are sold.
OTHER_COLOURS: Mapping[str, tuple[Colour, ...]] = {
    "deck": ((0.01, 0.02, 0.08), (0.01, 0.05, 0.02)),
    "battery": ((0.02, 0.02, 0.02), (0.05, 0.08, 0.3), (0.6, 0.6, 0.6)),
    "label": ((0.6, 0.1, 0.05), (0.05, 0.2, 0.5), (0.02, 0.02, 0.02)),
    "mount": ((0.5, 0.5, 0.5), (0.25, 0.25, 0.25)),
    "rotor": ((0.5, 0.5, 0.5), (0.3, 0.3, 0.3), (0.5, 0.25, 0.02)),
}


def _body_parts() -> Iterator[Part]:
    yield from _board_parts()
    yield from _deck_parts()
    yield from _header_parts()
    for k, angle in enumerate(MOTOR_ANGLES_RAD):
        for part in _arm_parts(k):
            yield rotate_part(part, angle)


def _board_parts() -> Iterator[Part]:
    """Yield the main board with its components."""
    z = BOARD_Z_M
    yield make_chamfered_box("board", (0, 0, z), (0.030, 0.030, 0.0010), 0.005)
    for x, y, width, depth, height in (
        (0.002, 0.000, 0.0072, 0.0072, 0.0009),
        (-0.008, 0.004, 0.0050, 0.0050, 0.0009),
        (0.009, -0.005, 0.0030, 0.0030, 0.0010),
        (-0.003, -0.009, 0.0040, 0.0030, 0.0011),
        (0.006, 0.009, 0.0028, 0.0020, 0.0012),
    ):
        yield make_box("chip", (x, y, z + 0.0005 + height / 2), (width, depth, height))
        yield make_box("chip", (-y, x, z - 0.0005 - height / 2), (depth, width, height))
    yield make_box("connector", (0.0125, 0.0, z + 0.0018), (0.0052, 0.0075, 0.0026))  # USB
    yield make_box("connector", (-0.0135, 0.004, z + 0.0022), (0.0040, 0.0060, 0.0034))  # battery's
    yield make_box("antenna", (-0.0150, -0.006, z + 0.0009), (0.0030, 0.0080, 0.0008))


def _deck_parts() -> Iterator[Part]:
    """Yield battery and decks: flow deck below, UWB and AI decks above."""
    yield make_chamfered_box("deck", (0, 0, -0.0100), (0.0285, 0.0280, 0.0009), 0.004)
    yield make_box("chip", (0.003, 0, -0.0113), (0.006, 0.006, 0.0018))
    yield make_cylinder("lens", (0.003, 0.0), 0.0017, -0.0130, -0.0122, 10)
    yield make_box("chip", (-0.006, 0, -0.0110), (0.0045, 0.0025, 0.0010))
    yield make_box("battery", (0.0, 0.0, 0.0018), (0.0330, 0.0170, 0.0068))
    yield make_box("label", (0.0, 0.0, 0.0018), (0.0200, 0.01715, 0.00695))
    yield make_box("wire", (-0.0172, 0.0030, 0.0005), (0.0016, 0.0012, 0.0060))
    yield make_box("wire", (-0.0172, 0.0048, 0.0005), (0.0016, 0.0012, 0.0060))
    yield make_chamfered_box("deck", (0, 0, 0.0075), (0.0300, 0.0275, 0.0009), 0.003)
    yield make_box("antenna", (-0.0105, 0.0, 0.0092), (0.0090, 0.0130, 0.0026))
    yield make_box("chip", (-0.0020, 0.0060, 0.0085), (0.0060, 0.0060, 0.0010))
    yield make_chamfered_box("board", (0.0030, 0, 0.0108), (0.0300, 0.0275, 0.0009), 0.003)
    yield make_box("antenna", (-0.0060, 0.0, 0.0122), (0.0120, 0.0160, 0.0020))
    yield make_box("chip", (0.0065, 0.0050, 0.0119), (0.0070, 0.0070, 0.0012))
    yield make_box("lens", (0.0180, 0.0, 0.0108), (0.0030, 0.0062, 0.0062))
    yield make_box("chip", (0.0160, 0.0, 0.0108), (0.0022, 0.0080, 0.0072))


def _header_parts() -> Iterator[Part]:
    """Yield two rows of ten pins, 2 mm apart, through all decks."""
    for y in (-0.0110, 0.0110):
        yield make_box("header", (0, y, -0.0068), (0.0200, 0.0021, 0.0045))
        yield make_box("header", (0, y, 0.0040), (0.0200, 0.0021, 0.0060))
        for k in range(10):
            yield make_box("pins", (-0.009 + 0.002 * k, y, 0.0007), (0.0005, 0.0005, 0.0270))


def _arm_parts(number: int) -> Iterator[Part]:
    """Yield arm, motor and LED along +x."""
    inner, z = 0.014, BOARD_Z_M
    yield make_box("board", ((inner + ARM_M) / 2, 0, z), (ARM_M - inner, 0.0068, 0.0010))
    mount = ((0.0047, -0.0145, -0.0105), (0.0053, -0.0105, -0.0015), (0.0046, -0.0015, 0.0010))
    for radius, low, high in mount:
        yield make_cylinder("mount", (ARM_M, 0.0), radius, low, high)
    yield make_box("mount", (ARM_M - 0.0075, 0, z - 0.0014), (0.009, 0.0080, 0.0018))
    yield make_cylinder("motor", (ARM_M, 0.0), 0.0035, -0.0125, 0.0105)
    yield make_cylinder("mount", (ARM_M, 0.0), 0.0024, 0.0105, HEIGHT_M / 2, 10)
    yield make_box("wire", (ARM_M - 0.014, 0.0012, z + 0.0010), (0.016, 0.0007, 0.0007))
    yield make_box("wire", (ARM_M - 0.014, -0.0012, z + 0.0010), (0.016, 0.0007, 0.0007))
    # LEDs of the Crazyflie: blue at the back, red and green in front.
    colour = ("green", "blue", "blue", "red")[number]
    for side in (-1, 1):
        at = (0.0245, 0.0, z + side * 0.0010)
        yield make_box(colour, at, (0.0020, 0.0016, 0.0010))


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


CRAZYFLIE = RobotDesign(PAINT, OTHER_COLOURS, lambda: (*_body_parts(), *_rotor_parts()))


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
    body = whole.vertices[
        np.unique(whole.faces[whole.material != CRAZYFLIE.materials.index(ROTOR)])
    ]
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
