# SPDX-License-Identifier: GPL-3.0-or-later
"""The published method of rendering as a baseline, run in Blender's Python.

It renders the full image with the background in the compositor, and once more per robot for its
box. Images pass through files, and nothing is kept between images. It uses Cycles, which needs no
screen. It reads a JSON job: model, samples, lean, folder, and for every image the background and
the matrix of each robot in camera coordinates. The published settings have 12 bounces of light and
a pixel filter wider than a pixel. The lean ones are dmrl's: 2 bounces and a box filter.
"""

import json
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

UNITS_PER_M = 500.0  # of the published model, which is then twice life size
WORLD_FROM_CAMERA = Matrix(((0, 0, -1, 0), (-1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
Z_FROM_Y_UP = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))


def prepare(job):
    """Open the model and configure the scene as published; return the scene."""
    bpy.ops.wm.open_mainfile(filepath=job["model"])
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = job["samples"]
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    if job["lean"]:
        apply_lean_settings(scene.cycles)
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.use_persistent_data = False
    scene.render.film_transparent = True
    scene.render.resolution_x, scene.render.resolution_y = 320, 224
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGBA"
    camera = bpy.data.objects["Camera"]
    camera.matrix_world = WORLD_FROM_CAMERA
    camera.data.lens = 120.0 * camera.data.sensor_width / 320
    scene.use_nodes = True
    scene.node_tree.nodes["Scale"].frame_method = "CROP"  # Blender 4.5 lacks the method in the file
    return scene


def apply_lean_settings(cycles):
    """Apply the faster settings of Cycles that dmrl uses."""
    cycles.pixel_filter_type = "BOX"
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = 2
    cycles.transparent_max_bounces = 8
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.sample_clamp_indirect = 4.0
    cycles.use_light_tree = False


def place_robots(scene, matrices):
    """Return robots at their poses, copied from the first."""
    first = bpy.data.objects["crazyflie"]
    robots = [first]
    for _ in matrices[1:]:
        robots.append(first.copy())
        scene.collection.objects.link(robots[-1])
    for robot, matrix in zip(robots, matrices, strict=True):
        place = Matrix(matrix)
        place.translation *= UNITS_PER_M
        robot.matrix_world = place @ Z_FROM_Y_UP
    return robots


def read_box(path):
    """Return first column and row, and last column and row, of the pixels with alpha."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    alpha = np.array(image.pixels[:]).reshape(height, width, 4)[::-1, :, 3]
    bpy.data.images.remove(image)
    rows, cols = np.nonzero(alpha)
    return (cols.min(), rows.min(), cols.max(), rows.max()) if len(rows) else None


def main(job):
    """Render every image of a job, and the box of each robot."""
    scene = prepare(job)
    nodes = scene.node_tree.nodes
    out = Path(job["folder"])
    for k, image in enumerate(job["images"]):
        robots = place_robots(scene, image["robots"])
        background = bpy.data.images.load(image["background"])
        nodes["Image"].image = background
        scene.render.use_compositing = True
        scene.render.filepath = str(out / f"{k:04d}.png")
        bpy.ops.render.render(write_still=True)
        scene.render.use_compositing = False
        for robot in robots:
            for other in robots:
                other.hide_render = other is not robot
            scene.render.filepath = str(out / "mask.png")
            bpy.ops.render.render(write_still=True)
            read_box(out / "mask.png")
        for robot in robots:
            robot.hide_render = False
        for robot in robots[1:]:
            bpy.data.objects.remove(robot)
        bpy.data.images.remove(background)


main(json.loads(Path(sys.argv[1]).read_text()))
