"""Simple quadrotor of boxes and discs with the size of a Crazyflie, for sketches.

Body frame: origin between the motors, x forward, y left, z up, metres.
"""

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array, yaw_matrix

ARM_M = 0.046
ROTOR_RADIUS_M = 0.0235
ROTOR_Z_M = 0.013
BLADE_HALF_WIDTH_M = 0.003
DISC_CORNERS = 20
ARM_ANGLES_RAD = np.pi / 4 + np.arange(4) * np.pi / 2

# Corners of the six faces of a box. Corner k has the signs of the bits of k (x, y, z).
BOX_FACES = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
)
CORNER_SIGNS = np.array([[k >> 2 & 1, k >> 1 & 1, k & 1] for k in range(8)]) * 2.0 - 1.0


@dataclass(frozen=True, slots=True)
class Mesh:
    """Flat faces of a robot.

    Parameters
    ----------
    corners
        (F, 4, 3) metres, body frame, anticlockwise from outside.
    normals
        (F, 3) outward, unit length.
    colours
        (F, 3) red, green, blue, 0 to 1.
    glows
        (F,) whether a face emits light.
    """

    corners: Array
    normals: Array
    colours: Array
    glows: NDArray[np.bool_]


def _iter_boxes() -> Iterator[tuple[tuple[float, float, float], Array, float, Array, bool]]:
    """Yield centre, half sizes, yaw, colour and glow of every box."""
    table = tomllib.loads(files(__package__).joinpath("quadrotor.toml").read_text("utf-8"))
    colours = {name: np.array(rgb) for name, rgb in table["colours"].items()}
    for angle in ARM_ANGLES_RAD:
        x, y = np.cos(angle), np.sin(angle)
        for along_m, up_m, half_m, name in table["arm_behind" if x < 0 else "arm_ahead"]:
            at = (x * along_m, y * along_m, up_m)
            yield at, np.array(half_m), angle, colours[name], name in table["glowing"]
    for centre, half_m, name in table["body"]:
        yield tuple(centre), np.array(half_m), 0.0, colours[name], False


def _build_mesh() -> Mesh:
    corners, normals, colours, glows = [], [], [], []
    for centre, half, yaw, colour, glow in _iter_boxes():
        box = (CORNER_SIGNS * half) @ yaw_matrix(yaw)
        outward = box[BOX_FACES].mean(axis=1)
        corners.append(box[BOX_FACES] + centre)
        normals.append(outward / np.linalg.norm(outward, axis=1, keepdims=True))
        colours.append(np.tile(colour, (len(BOX_FACES), 1)))
        glows.append(np.full(len(BOX_FACES), glow))
    return Mesh(*(np.concatenate(part) for part in (corners, normals, colours, glows)))


MESH = _build_mesh()


def blade_outlines(turn_rad: float) -> Array:
    """Return (4, 4, 3) outlines of the blades. Each rotor is a quarter turn ahead of the last."""
    angle = turn_rad + ARM_ANGLES_RAD * 1.5
    along = np.stack([np.cos(angle), np.sin(angle), np.zeros(4)], axis=1) * ROTOR_RADIUS_M
    across = np.stack([-np.sin(angle), np.cos(angle), np.zeros(4)], axis=1) * BLADE_HALF_WIDTH_M
    outline = np.stack([along + across, along - across, -along - across, -along + across], axis=1)
    return outline + _rotor_hubs()[:, None]


def _rotor_hubs() -> Array:
    x, y = np.cos(ARM_ANGLES_RAD) * ARM_M, np.sin(ARM_ANGLES_RAD) * ARM_M
    return np.stack([x, y, np.full(4, ROTOR_Z_M)], axis=1)


def _disc_outlines() -> Array:
    turn = np.arange(DISC_CORNERS) * 2 * np.pi / DISC_CORNERS
    rim = np.stack([np.cos(turn), np.sin(turn), np.zeros(DISC_CORNERS)], axis=1) * ROTOR_RADIUS_M
    return rim + _rotor_hubs()[:, None]


ROTOR_DISCS = _disc_outlines()
"""(4, DISC_CORNERS, 3) outlines of the discs that the rotors sweep."""

RADIUS_M = float(np.hypot(ARM_M + ROTOR_RADIUS_M, ROTOR_Z_M))
"""Radius of a ball about the origin that contains the whole quadrotor."""
