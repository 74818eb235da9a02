"""A Crazyflie 2.1 by code, at life size: one mesh, a material for each part.

92 mm from motor to motor, 29 mm high, rotors of 45 mm. Body frame: x forward, y left, z up,
metres, the origin in the middle of the bounding box.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array

MATERIALS = (
    "board",
    "deck",
    "battery",
    "label",
    "motor",
    "mount",
    "pins",
    "header",
    "chip",
    "connector",
    "wire",
    "antenna",
    "lens",
    "red",
    "green",
    "blue",
    "rotor",
)

ARM_M = 0.046
ROTOR_RADIUS_M = 0.0225
HEIGHT_M = 0.029
ROTOR_Z_M = HEIGHT_M / 2 - 0.0008
BLADE_HALF_WIDTH_M = 0.0028
BETWEEN_ROTORS_RAD = 1.7
"""How much further each rotor has turned than the one before."""
BOARD_Z_M = -0.0035
MOTOR_ANGLES_RAD = np.pi / 4 + np.pi / 2 * np.arange(4)
CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)

Part = tuple[str, Array, NDArray[np.int64]]


@dataclass(frozen=True, slots=True)
class Mesh:
    """A robot's surface.

    Parameters
    ----------
    vertices
        (V, 3) metres, body frame.
    faces
        (F, 3) vertices of triangles, anticlockwise from outside.
    material
        (F,) number in MATERIALS.
    rotor
        (V, 3) of points of rotors: x and y from the hub, metres, and the rotor's number.
    """

    vertices: Array
    faces: NDArray[np.int64]
    material: NDArray[np.int64]
    rotor: Array


@cache
def mesh() -> Mesh:
    """The whole robot. The same arrays every time: do not write into them."""
    vertices, faces, material, rotor = [], [], [], []
    count = 0
    numbered = [(0, part) for part in _body()] + list(enumerate(_rotors()))
    for number, (name, points, triangles) in numbered:
        vertices.append(points)
        faces.append(triangles + count)
        material.append(np.full(len(triangles), MATERIALS.index(name)))
        hub = points.mean(axis=0) if name == "rotor" else points
        rotor.append(np.column_stack([(points - hub)[:, :2], np.full(len(points), float(number))]))
        count += len(points)
    parts = (vertices, faces, material, rotor)
    return Mesh(*(np.concatenate(part) for part in parts))


def _prism(outline: Array, low: float, high: float) -> tuple[Array, NDArray[np.int64]]:
    """A convex outline (K, 2), anticlockwise from above, stretched from low to high."""
    count = len(outline)
    points = np.concatenate(
        [np.column_stack([outline, np.full(count, z)]) for z in (low, high)], axis=0
    )
    k = np.arange(count)
    after = (k + 1) % count
    fan = np.column_stack([np.zeros(count - 2, int), k[1:-1], k[2:]])
    sides = np.concatenate(
        [
            np.column_stack([k, after, after + count]),
            np.column_stack([k, after + count, k + count]),
        ]
    )
    return points, np.concatenate([fan[:, ::-1], fan + count, sides])


def _box(name: str, centre: tuple[float, float, float], size: tuple[float, float, float]) -> Part:
    x, y, z = centre
    outline = CORNERS * np.array(size[:2]) / 2 + (x, y)
    return name, *_prism(outline, z - size[2] / 2, z + size[2] / 2)


def _round(
    name: str, xy: tuple[float, float], radius: float, low: float, high: float, sides: int = 14
) -> Part:
    turn = 2 * np.pi * np.arange(sides) / sides
    outline = np.column_stack([np.cos(turn), np.sin(turn)]) * radius + xy
    return name, *_prism(outline, low, high)


def _turned(part: Part, angle: float) -> Part:
    """The part turned about the z axis."""
    name, points, faces = part
    c, s = np.cos(angle), np.sin(angle)
    return name, points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]), faces


def _rounded(
    name: str, centre: tuple[float, float, float], size: tuple[float, float, float], cut: float
) -> Part:
    """A box with its upright edges cut, as circuit boards have."""
    x, y, z = centre
    half_x, half_y = size[0] / 2, size[1] / 2
    outline = np.array(
        [
            (half_x, -half_y + cut),
            (half_x, half_y - cut),
            (half_x - cut, half_y),
            (-half_x + cut, half_y),
            (-half_x, half_y - cut),
            (-half_x, -half_y + cut),
            (-half_x + cut, -half_y),
            (half_x - cut, -half_y),
        ]
    )
    return name, *_prism(outline + np.array([x, y]), z - size[2] / 2, z + size[2] / 2)


def _body() -> Iterator[Part]:
    yield from _frame()
    yield from _stack()
    yield from _headers()
    for k, angle in enumerate(MOTOR_ANGLES_RAD):
        for part in _arm(k):
            yield _turned(part, angle)


def _frame() -> Iterator[Part]:
    """The main board with its parts."""
    z = BOARD_Z_M
    yield _rounded("board", (0, 0, z), (0.030, 0.030, 0.0010), 0.005)
    for x, y, width, depth, height in (
        (0.002, 0.000, 0.0072, 0.0072, 0.0009),
        (-0.008, 0.004, 0.0050, 0.0050, 0.0009),
        (0.009, -0.005, 0.0030, 0.0030, 0.0010),
        (-0.003, -0.009, 0.0040, 0.0030, 0.0011),
        (0.006, 0.009, 0.0028, 0.0020, 0.0012),
    ):
        yield _box("chip", (x, y, z + 0.0005 + height / 2), (width, depth, height))
        yield _box("chip", (-y, x, z - 0.0005 - height / 2), (depth, width, height))
    yield _box("connector", (0.0125, 0.0, z + 0.0018), (0.0052, 0.0075, 0.0026))  # USB
    yield _box("connector", (-0.0135, 0.004, z + 0.0022), (0.0040, 0.0060, 0.0034))  # battery's
    yield _box("antenna", (-0.0150, -0.006, z + 0.0009), (0.0030, 0.0080, 0.0008))


def _stack() -> Iterator[Part]:
    """What the headers hold: flow deck below, battery, UWB and AI decks above."""
    yield _rounded("deck", (0, 0, -0.0100), (0.0285, 0.0280, 0.0009), 0.004)
    yield _box("chip", (0.003, 0, -0.0113), (0.006, 0.006, 0.0018))
    yield _round("lens", (0.003, 0.0), 0.0017, -0.0130, -0.0122, 10)
    yield _box("chip", (-0.006, 0, -0.0110), (0.0045, 0.0025, 0.0010))
    yield _box("battery", (0.0, 0.0, 0.0018), (0.0330, 0.0170, 0.0068))
    yield _box("label", (0.0, 0.0, 0.0018), (0.0200, 0.01715, 0.00695))
    yield _box("wire", (-0.0172, 0.0030, 0.0005), (0.0016, 0.0012, 0.0060))
    yield _box("wire", (-0.0172, 0.0048, 0.0005), (0.0016, 0.0012, 0.0060))
    yield _rounded("deck", (0, 0, 0.0075), (0.0300, 0.0275, 0.0009), 0.003)
    yield _box("antenna", (-0.0105, 0.0, 0.0092), (0.0090, 0.0130, 0.0026))
    yield _box("chip", (-0.0020, 0.0060, 0.0085), (0.0060, 0.0060, 0.0010))
    yield _rounded("board", (0.0030, 0, 0.0108), (0.0300, 0.0275, 0.0009), 0.003)
    yield _box("antenna", (-0.0060, 0.0, 0.0122), (0.0120, 0.0160, 0.0020))
    yield _box("chip", (0.0065, 0.0050, 0.0119), (0.0070, 0.0070, 0.0012))
    yield _box("lens", (0.0180, 0.0, 0.0108), (0.0030, 0.0062, 0.0062))
    yield _box("chip", (0.0160, 0.0, 0.0108), (0.0022, 0.0080, 0.0072))


def _headers() -> Iterator[Part]:
    """Two rows of ten pins, 2 mm apart, through all decks."""
    for y in (-0.0110, 0.0110):
        yield _box("header", (0, y, -0.0068), (0.0200, 0.0021, 0.0045))
        yield _box("header", (0, y, 0.0040), (0.0200, 0.0021, 0.0060))
        for k in range(10):
            yield _box("pins", (-0.009 + 0.002 * k, y, 0.0007), (0.0005, 0.0005, 0.0270))


def _arm(number: int) -> Iterator[Part]:
    """Arm, motor and LED along +x."""
    inner, z = 0.014, BOARD_Z_M
    yield _box("board", ((inner + ARM_M) / 2, 0, z), (ARM_M - inner, 0.0068, 0.0010))
    mount = ((0.0047, -0.0145, -0.0105), (0.0053, -0.0105, -0.0015), (0.0046, -0.0015, 0.0010))
    for radius, low, high in mount:
        yield _round("mount", (ARM_M, 0.0), radius, low, high)
    yield _box("mount", (ARM_M - 0.0075, 0, z - 0.0014), (0.009, 0.0080, 0.0018))
    yield _round("motor", (ARM_M, 0.0), 0.0035, -0.0125, 0.0105)
    yield _round("mount", (ARM_M, 0.0), 0.0024, 0.0105, HEIGHT_M / 2, 10)
    yield _box("wire", (ARM_M - 0.014, 0.0012, z + 0.0010), (0.016, 0.0007, 0.0007))
    yield _box("wire", (ARM_M - 0.014, -0.0012, z + 0.0010), (0.016, 0.0007, 0.0007))
    # As on the Crazyflie: blue behind, red and green in front.
    colour = ("green", "blue", "blue", "red")[number]
    for side in (-1, 1):
        at = (0.0245, 0.0, z + side * 0.0010)
        yield _box(colour, at, (0.0020, 0.0016, 0.0010))


def _rotors() -> Iterator[Part]:
    """Discs that the blades sweep; the material shows the blades in them."""
    sides = 40
    turn = 2 * np.pi * np.arange(sides) / sides
    rim = np.column_stack([np.cos(turn), np.sin(turn)]) * ROTOR_RADIUS_M
    fan = np.array([(k, (k + 1) % sides, sides) for k in range(sides)])
    for angle in MOTOR_ANGLES_RAD:
        hub = np.array([np.cos(angle), np.sin(angle)]) * ARM_M
        points = np.concatenate([rim, [(0.0, 0.0)]]) + hub
        yield "rotor", np.column_stack([points, np.full(sides + 1, ROTOR_Z_M)]), fan


def outline(scale: float, first_rad: float, sweep_rad: float) -> Array:
    """(N, 3) points that reach as far as what is seen of a robot: body, and swept blades.

    Parameters
    ----------
    scale
        Times life size.
    first_rad
        Angle of rotor 0 when the shutter opens.
    sweep_rad
        How far all rotors turn until it closes.
    """
    whole = mesh()
    body = whole.vertices[np.unique(whole.faces[whole.material != MATERIALS.index("rotor")])]
    radius = np.linspace(0.004, ROTOR_RADIUS_M, 12)
    half = BLADE_HALF_WIDTH_M / radius
    rim = np.linspace(-half[-1], min(sweep_rad, np.pi) + half[-1], 60)
    angle = np.concatenate([-half, min(sweep_rad, np.pi) + half, rim])
    radius = np.concatenate([radius, radius, np.full(60, ROTOR_RADIUS_M)])
    points = [body]
    for k, arm in enumerate(MOTOR_ANGLES_RAD):
        for blade in (0.0, np.pi):
            turn = angle + first_rad + k * BETWEEN_ROTORS_RAD + blade
            x = np.cos(turn) * radius + np.cos(arm) * ARM_M
            y = np.sin(turn) * radius + np.sin(arm) * ARM_M
            points.append(np.column_stack([x, y, np.full(len(x), ROTOR_Z_M)]))
    return np.concatenate(points) * scale
