"""Scenes rendered by Blender. Skips where it is not set up."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.geometry.frames import AIDECK
from dmrl.rendering import worker_pool
from dmrl.rendering.blender import protocol
from dmrl.rendering.camera.sensor import Sensor
from dmrl.rendering.renderer import Renderer, RobotModel, Scene
from dmrl.rendering.shot import Light, Look, Robot
from dmrl.rendering.sketch_renderer import Pose

CAMERA = replace(AIDECK, distortion=())

# A Blender that keeps its pixels to itself.
SHUT = f"""
import sys
sys.path.insert(0, {str(Path(protocol.__file__).parent)!r})
import passes, worker
def refuse(result):
    raise AttributeError("foreach_get")
passes._take = refuse
worker.main()
"""


def scene(light: str, depth_m: float) -> Scene:
    towards = np.array([0.0, 0.0, 1.0])
    shining = Light(light, (0.0, 0.0, 0.0), 1.0, towards, 2.0, (1.0, 1.0, 1.0), 0.1)
    grey = np.full((CAMERA.height_px, CAMERA.width_px, 3), 0.3, np.float32)
    robot = Robot(Pose(np.array([depth_m, 0.1, -0.1]), np.eye(3)))
    return CAMERA, (robot,), Look(grey, shining, Sensor())


@pytest.mark.heavy
def test_pixels_come_through_files_where_memory_is_shut(
    blender: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Renderer(blender, RobotModel(), workers=1, samples=2) as renderer:
        asked = [scene(renderer.lights[0], depth_m) for depth_m in (0.5, 1.0)]
        expected = list(renderer.render_shots(asked))
    monkeypatch.setattr(worker_pool, "WORKER_SCRIPT", tmp_path / "worker.py")
    worker_pool.WORKER_SCRIPT.write_text(SHUT)
    with Renderer(blender, RobotModel(), workers=1, samples=2) as renderer:
        found = list(renderer.render_shots(asked))
        assert renderer.pool.replaced == 0
    for one, other in zip(found, expected, strict=True):
        assert np.array_equal(one.rgb, other.rgb)
        assert np.array_equal(one.surface_m, other.surface_m)
        assert other.surface_m.max() > 0.4


@pytest.mark.heavy
def test_rendering_is_independent_of_earlier_shots(blender: Path) -> None:
    with Renderer(blender, RobotModel(), workers=1, samples=2) as renderer:
        first, second = renderer.lights[0], renderer.lights[1]
        asked = [scene(first, 0.5), scene(second, 0.3), scene(first, 0.5)]
        shots = list(renderer.render_shots(asked))
    assert np.array_equal(shots[0].rgb, shots[2].rgb)
    assert not np.array_equal(shots[0].rgb, shots[1].rgb)
