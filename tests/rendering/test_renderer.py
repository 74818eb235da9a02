"""Scenes rendered by Blender; skipped where it is not set up."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.geometry.frames import AIDECK
from dmrl.rendering.camera.sensor import Sensor
from dmrl.rendering.renderer import Renderer, RobotModel, Scene
from dmrl.rendering.shot import Light, Look, Robot
from dmrl.rendering.sketch_renderer import Pose

CAMERA = replace(AIDECK, distortion=())


def build_scene(light: str, depth_m: float) -> Scene:
    """Return a scene of one robot before a grey backdrop, lit from above."""
    towards = np.array([0.0, 0.0, 1.0])
    shining = Light(light, (0.0, 0.0, 0.0), 1.0, towards, 2.0, (1.0, 1.0, 1.0), 0.1)
    grey = np.full((CAMERA.height_px, CAMERA.width_px, 3), 0.3, np.float32)
    robot = Robot(Pose(np.array([depth_m, 0.1, -0.1]), np.eye(3)))
    return CAMERA, (robot,), Look(grey, shining, Sensor())


@pytest.mark.heavy
def test_rendering_is_independent_of_earlier_shots(blender: Path) -> None:
    with Renderer(blender, RobotModel(), workers=1, samples=2) as renderer:
        first, second = renderer.lights[0], renderer.lights[1]
        asked = [build_scene(first, 0.5), build_scene(second, 0.3), build_scene(first, 0.5)]
        shots = list(renderer.render_shots(asked))
    assert np.array_equal(shots[0].rgb, shots[2].rgb)
    assert not np.array_equal(shots[0].rgb, shots[1].rgb)
