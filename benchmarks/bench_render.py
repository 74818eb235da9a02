"""Figures of dmrl render: reprojection, cost against the published way, memory.

    python benchmarks/bench_render.py reprojection [--images 500]
    python benchmarks/bench_render.py speed --model crazyflie-published.blend --backgrounds DIR
    python benchmarks/bench_render.py memory [--images 3000]

CPU seconds are those of all processes together, start-up included.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from dmrl.geometry import Array, Camera, project
from dmrl.progress import say
from dmrl.rendering import crazyflie
from dmrl.rendering.environment import ensure
from dmrl.rendering.lens import image_from_pinhole
from dmrl.rendering.randomise import World, draw_scene
from dmrl.rendering.renderer import Model, Renderer
from dmrl.rendering.settings import Settings
from dmrl.rendering.sketch import Pose
from dmrl.stages.render import camera_of, run, settings_of

PUBLISHED_WAY = Path(__file__).parent / "published_way.py"
MM_PER_UNIT = 0.002  # the published model, at twice life size as the authors rendered it


def mesh_box(camera: Camera, pose: Pose, points: Array) -> Array:
    """Left, top, right, bottom of a mesh's corners in the image, clipped to it.

    Parameters
    ----------
    camera
        Takes the image.
    pose
        Of the robot.
    points
        (N, 3) corners, body frame.
    """
    xyz = points @ pose.camera_from_body.T + pose.xyz_camera
    uv, _ = project(xyz[xyz[:, 0] > 0.01], camera.image_from_optical)
    uv = image_from_pinhole(uv, camera)
    box = np.concatenate([uv.min(axis=0), uv.max(axis=0)])
    return np.clip(box, 0, (camera.width_px, camera.height_px) * 2)


def reprojection(recipe: str, images: int) -> dict[str, float]:
    """Distance of alpha boxes' edges from the mesh's, pixels, robots that nothing hides.

    Parameters
    ----------
    recipe
        Preset to draw from.
    images
        How many.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recipe.toml"
        path.write_text(f'kind = "render"\npreset = "{recipe}"\nempty_share = 0.0\n')
        settings = settings_of(str(path), images=images)
    camera = camera_of(settings)
    model = Model(settings.model, settings.scale, settings.model_up)
    errors, middles = [], []
    with Renderer(ensure(say), model) as renderer:
        world = World(
            settings, camera, renderer.radius_m, tuple(renderer.lights), renderer.panorama, None
        )
        world = replace(world, panorama=lambda name: np.full((8, 16, 3), 0.3, np.float32))
        scenes = [draw_scene(world, k) for k in range(images)]
        shots = renderer.shots((camera, scene.robots, scene.look) for scene in scenes)
        for scene, shot in zip(scenes, shots, strict=True):
            for k, robot in enumerate(scene.robots):
                if shot.visible_share[k] < 1 or np.isnan(shot.box_px[k]).any():
                    continue
                turn = (robot.paint["rotor_first_rad"], robot.paint["rotor_sweep_rad"])
                points = crazyflie.outline(settings.scale, *turn)
                box = mesh_box(camera, robot.pose, points)
                errors.append(shot.box_px[k] - box)
                middles.append((shot.box_px[k] - box).reshape(2, 2).mean(axis=0))
    edges = np.array(errors)
    return {
        "robots": len(edges),
        "median_px": float(np.median(np.abs(edges))),
        "p95_px": float(np.percentile(np.abs(edges), 95)),
        **{
            f"median_{name}_px": float(value)
            for name, value in zip(
                ("left", "top", "right", "bottom"), np.median(edges, axis=0), strict=True
            )
        },
        "median_middle_px": float(np.median(np.abs(middles))),
    }
