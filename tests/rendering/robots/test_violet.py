"""The procedural mesh of the violet robot, and the names of all designs."""

from typing import get_args, get_type_hints

import numpy as np

from dmrl.rendering.robots.robot_models import DESIGNS
from dmrl.rendering.robots.violet import FIT_OFFSET_Z_M, FIT_SCALE, VIOLET
from dmrl.rendering.settings import Settings


def test_violet_has_four_motors_at_the_fitted_radius() -> None:
    mesh = VIOLET.build_mesh()
    motor = mesh.vertices[np.unique(mesh.faces[mesh.material == VIOLET.materials.index("motor")])]
    side = np.sign(motor[:, :2])
    each = np.unique(side, axis=0)
    hubs = np.array([motor[(side == one).all(axis=1), :2].mean(axis=0) for one in each])
    np.testing.assert_allclose(np.hypot(*hubs.T), 0.046 * FIT_SCALE, atol=1e-6)
    np.testing.assert_allclose(np.abs(hubs), 0.046 * FIT_SCALE / np.sqrt(2), atol=1e-6)


def test_feet_are_below_and_blades_above_the_board() -> None:
    mesh = VIOLET.build_mesh()
    height = {
        name: np.sort(mesh.vertices[np.unique(mesh.faces[mesh.material == k])][:, 2])
        for k, name in enumerate(VIOLET.materials)
    }
    board = height["board"].mean()
    assert board == FIT_OFFSET_Z_M
    assert height["mount"][0] < board - 0.012 < board + 0.008 < height["blade"][0]
    assert height["frame"][-1] < height["motor"][-1] < height["blade"][-1]


def test_blades_are_pitched_in_the_direction_in_which_they_turn() -> None:
    mesh = VIOLET.build_mesh()
    faces = mesh.faces[mesh.material == VIOLET.materials.index("blade")]
    a, b, c = np.moveaxis(mesh.vertices[faces], 1, 0)
    normal, middle = np.cross(b - a, c - a), (a + b + c) / 3
    hub = np.sign(middle[:, :2]) * 0.046 * FIT_SCALE / np.sqrt(2)
    out = middle[:, :2] - hub
    blade = (np.hypot(*out.T) > 0.004) & (np.abs(normal[:, 2]) > 1e-9)
    slope = normal[blade, :2] / normal[blade, 2:]
    # A blade rises against the rotation of its rotor, and neighbours turn in opposite directions.
    ways = np.sign(out[blade, 0] * slope[:, 1] - out[blade, 1] * slope[:, 0])
    clockwise = np.sign(np.prod(middle[blade, :2], axis=1))
    assert set((ways * clockwise).tolist()) in ({1.0}, {-1.0})


def test_designs_equal_the_choices_of_the_setting() -> None:
    named = get_args(get_type_hints(Settings)["design"])
    assert set(named) == set(DESIGNS)
    assert DESIGNS[Settings().design].materials[0] == "board"
