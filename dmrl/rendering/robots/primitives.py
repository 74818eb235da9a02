"""Solids from which robots are built: boxes, prisms and cylinders, each of one material."""

import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array, yaw_matrix

MOTOR_ANGLES_RAD = np.pi / 4 + np.pi / 2 * np.arange(4)
CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)

Part = tuple[str, Array, NDArray[np.int64]]
"""Material, (V, 3) points in metres, (F, 3) triangles, anticlockwise from outside."""
ROTOR = "rotor"
"""Material whose parts are rotors, numbered in their order."""
Colour = tuple[float, float, float]
"""Red, green, blue; linear light, 0 to 1."""
Finish = tuple[Colour, float, float, float]
"""Base colour, roughness, metallic, glow."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """Surface of a robot.

    Parameters
    ----------
    vertices
        (V, 3) metres, body frame.
    faces
        (F, 3) vertices of triangles, anticlockwise from outside.
    material
        (F,) index of the material.
    rotor
        (V, 3) for points of rotors: x and y from the hub, metres, and the rotor's number.
    """

    vertices: Array
    faces: NDArray[np.int64]
    material: NDArray[np.int64]
    rotor: Array


@dataclass(frozen=True)
class RobotDesign:
    """Built-in robot.

    Parameters
    ----------
    paint
        Finish of every material.
    others
        Alternative colours in which parts are sold.
    parts
        Builds its parts at life size, body frame.
    """

    paint: Mapping[str, Finish]
    others: Mapping[str, tuple[Colour, ...]]
    parts: Callable[[], Iterable[Part]]

    @property
    def materials(self) -> tuple[str, ...]:
        """Names in the order of the mesh's indices."""
        return tuple(self.paint)

    def build_mesh(self) -> Mesh:
        """Return the mesh of the whole robot. The arrays are cached: do not modify them."""
        return _build_mesh(self.parts, self.materials)


@cache
def _build_mesh(parts: Callable[[], Iterable[Part]], materials: tuple[str, ...]) -> Mesh:
    return join_parts(parts(), materials)


def join_parts(parts: Iterable[Part], materials: tuple[str, ...]) -> Mesh:
    """Join parts into one surface.

    Parameters
    ----------
    parts
        Parts of a robot, body frame.
    materials
        Names of the materials, in the order of the mesh's indices.
    """
    vertices, faces, material, rotor = [], [], [], []
    count = rotors = 0
    for name, points, triangles in parts:
        vertices.append(points)
        faces.append(triangles + count)
        material.append(np.full(len(triangles), materials.index(name)))
        hub, number = (points.mean(axis=0), rotors) if name == ROTOR else (points, 0)
        rotor.append(np.column_stack([(points - hub)[:, :2], np.full(len(points), float(number))]))
        rotors += name == ROTOR
        count += len(points)
    return Mesh(*(np.concatenate(one) for one in (vertices, faces, material, rotor)))


def make_prism(outline: Array, low: float, high: float) -> tuple[Array, NDArray[np.int64]]:
    """Make a prism of a convex (K, 2) outline, anticlockwise from above, between two heights."""
    count = len(outline)
    rings = [np.column_stack([outline, np.full(count, z)]) for z in (low, high)]
    points = np.concatenate(rings, axis=0)
    k = np.arange(count)
    after = (k + 1) % count
    fan = np.column_stack([np.zeros(count - 2, int), k[1:-1], k[2:]])
    sides = np.concatenate(
        [np.column_stack([k, after, after + count]), np.column_stack([k, after + count, k + count])]
    )
    return points, np.concatenate([fan[:, ::-1], fan + count, sides])


def make_box(
    name: str, centre: tuple[float, float, float], size: tuple[float, float, float]
) -> Part:
    """Build a box with sides along the axes, metres."""
    x, y, z = centre
    outline = CORNERS * np.array(size[:2]) / 2 + (x, y)
    return name, *make_prism(outline, z - size[2] / 2, z + size[2] / 2)


def make_cylinder(
    name: str, xy: tuple[float, float], radius: float, low: float, high: float, sides: int = 14
) -> Part:
    """Build an upright cylinder about ``xy``, from ``low`` to ``high``, metres."""
    turn = 2 * np.pi * np.arange(sides) / sides
    outline = np.column_stack([np.cos(turn), np.sin(turn)]) * radius + xy
    return name, *make_prism(outline, low, high)


def rotate_part(part: Part, angle: float) -> Part:
    """Rotate a part about the z axis."""
    name, points, faces = part
    return name, points @ yaw_matrix(angle), faces


def make_chamfered_box(
    name: str, centre: tuple[float, float, float], size: tuple[float, float, float], cut: float
) -> Part:
    """Build a box with chamfered upright edges, as circuit boards have."""
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
    return name, *make_prism(outline + np.array([x, y]), z - size[2] / 2, z + size[2] / 2)


MAKERS: Mapping[str, Callable[..., Part]] = {
    "box": make_box,
    "chamfered": make_chamfered_box,
    "cylinder": make_cylinder,
}


def load_design(
    name: str, more: Callable[[], Iterable[Part]], scale: float = 1.0, lift_m: float = 0.0
) -> RobotDesign:
    """Read a robot's table, a TOML file beside this one.

    Parameters
    ----------
    name
        Name of the file, without its suffix.
    more
        Builds the parts that no table describes: rotors or blades.
    scale, lift_m
        Applied to all parts: factor, then offset upwards, metres.
    """
    table = tomllib.loads(files(__package__).joinpath(f"{name}.toml").read_text("utf-8"))
    parts = table["parts"]

    def build() -> Iterable[Part]:
        made = [MAKERS[kind](*rest) for kind, *rest in parts["body"]]
        for k, angle in enumerate(MOTOR_ANGLES_RAD):
            arm = parts["arm"] + parts.get(f"arm_{k}", [])
            made += [rotate_part(MAKERS[kind](*rest), angle) for kind, *rest in arm]
        lift = np.array([0.0, 0.0, lift_m])
        return [(kind, points * scale + lift, faces) for kind, points, faces in (*made, *more())]

    paint = {key: (tuple(colour), *finish) for key, (colour, *finish) in table["paint"].items()}
    others = {key: tuple(map(tuple, colours)) for key, colours in table["others"].items()}
    return RobotDesign(paint, others, build)
