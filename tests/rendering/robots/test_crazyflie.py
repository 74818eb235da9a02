"""The procedural mesh of the Crazyflie."""

import numpy as np

from dmrl.rendering.robots.crazyflie import CRAZYFLIE, outline_points


def test_the_mesh_has_the_size_of_a_crazyflie_and_is_centred() -> None:
    points = CRAZYFLIE.build_mesh().vertices
    assert np.allclose(points.min(axis=0), -points.max(axis=0), atol=1e-3)
    assert np.isclose(np.ptp(points[:, 2]), 0.029)
    motor = CRAZYFLIE.build_mesh().faces[
        CRAZYFLIE.build_mesh().material == CRAZYFLIE.materials.index("motor")
    ]
    corners = points[np.unique(motor)]
    radius = np.hypot(corners[:, 0], corners[:, 1])
    assert np.isclose((radius.max() + radius.min()) / 2, 0.046, atol=2e-4)


def test_every_material_has_faces_and_every_face_an_area() -> None:
    whole = CRAZYFLIE.build_mesh()
    assert set(whole.material.tolist()) == set(range(len(CRAZYFLIE.materials)))
    a, b, c = np.moveaxis(whole.vertices[whole.faces], 1, 0)
    assert (np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0).all()


def test_solid_parts_are_closed_and_face_outwards() -> None:
    whole = CRAZYFLIE.build_mesh()
    solid = whole.faces[whole.material != CRAZYFLIE.materials.index("rotor")]
    a, b, c = np.moveaxis(whole.vertices[solid], 1, 0)
    assert np.allclose(np.cross(b - a, c - a).sum(axis=0), 0, atol=1e-12)
    volume_m3 = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume_m3 > 1e-6


def test_the_outline_of_turning_blades_reaches_the_rotor_discs() -> None:
    whole = CRAZYFLIE.build_mesh().vertices
    whirling = outline_points(1.0, 0.3, 10.0)
    assert np.allclose(whirling.max(axis=0), whole.max(axis=0), atol=5e-4)
    # At rest no blade points along x, so the robot is narrower.
    assert outline_points(1.0, 0.3, 0.0)[:, 0].max() < whole[:, 0].max()
    assert np.allclose(outline_points(2.0, 0.3, 10.0), 2 * whirling)
