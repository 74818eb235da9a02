# SPDX-License-Identifier: GPL-3.0-or-later
#
# Copyright (C) 2026 The dmrl developers
#
# This program is free software: you can redistribute it and/or modify it under the terms of
# the GNU General Public License as published by the Free Software Foundation, either version
# 3 of the License, or (at your option) any later version. It is distributed in the hope that
# it will be useful, but WITHOUT ANY WARRANTY; without even the implied warranty of
# MERCHANTABILITY or FITNESS FOR A PARTICULAR PURPOSE. See <https://www.gnu.org/licenses/>.
"""Blender worker: renders a robot's colour, opacity and depth for a pinhole camera, over a pipe.

Run by path in Blender's own Python. Only the files of this folder import bpy. Blender's world
is dmrl's camera frame: x forward, y left, z up, metres, the camera at the origin. Light rotates
with gravity. Every reply depends on its request alone, not on earlier ones.
"""

import os
import sys
from pathlib import Path

from core import limit_to_one_core

with limit_to_one_core():
    import bpy
import numpy as np
from light import Sky, load_panorama
from mathutils import Matrix
from passes import render_passes
from protocol import receive, send
from robot import build_mesh, load_mesh

# Blender's camera points along its -z axis, y up.
WORLD_FROM_CAMERA = Matrix(((0, 0, -1, 0), (-1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
SENSOR_MM = 32.0
# Offset of a crop's edges into the pixels, so that rounding cannot move them.
NUDGE_PX = 0.25
HIDDEN_OFFSET_M = -1000.0


class RenderScene:
    """Scene of one robot, one camera, a sun and a sky."""

    def __init__(self, head, arrays):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.scene = bpy.context.scene
        self.configure_cycles(head)
        self.camera = self.add_object("camera", bpy.data.cameras.new("camera"))
        self.camera.matrix_world = WORLD_FROM_CAMERA
        self.camera.data.sensor_fit = "HORIZONTAL"
        self.camera.data.sensor_width = SENSOR_MM
        self.camera.data.clip_start, self.camera.data.clip_end = 0.005, 100.0
        self.scene.camera = self.camera
        self.sun = self.add_object("sun", bpy.data.lights.new("sun", "SUN"))
        self.sky = Sky(self.scene, head["lights"])
        if head["model"] is None:
            mesh = build_mesh(head, arrays)
        else:
            mesh = load_mesh(
                Path(head["model"]),
                head["model_scale"],
                head["model_up"],
                boxed=head["model_centre"] == "box",
            )
        self.robot = self.add_object("robot", mesh)
        # Blender keeps a mesh that two objects share. It would transform the mesh of a single
        # object and rebuild its BVH whenever the robot or the sun change.
        self.add_object("twin", mesh).matrix_world = Matrix.Translation((HIDDEN_OFFSET_M, 0, 0))

    def configure_cycles(self, head):
        """Set Cycles' options."""
        render, cycles = self.scene.render, self.scene.cycles
        render.engine = "CYCLES"
        cycles.device = "CPU"
        cycles.samples = head["samples"]
        cycles.use_adaptive_sampling = False
        # Few samples speckle the large, bright faces of other models. The robots that dmrl draws
        # are as the shipped networks have learned them.
        cycles.use_denoising = head["model"] is not None
        cycles.denoiser, cycles.denoising_quality = "OPENIMAGEDENOISE", "FAST"
        cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
        # A box filter of one pixel: opacity is the covered share of the pixel.
        cycles.pixel_filter_type = "BOX"
        cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = head["bounces"]
        cycles.transparent_max_bounces = 8
        cycles.caustics_reflective = cycles.caustics_refractive = False
        cycles.sample_clamp_indirect = 4.0
        cycles.use_light_tree = False  # it is rebuilt for every image, at half the image's cost
        render.threads_mode, render.threads = "FIXED", 1
        render.use_persistent_data = True
        render.film_transparent = True
        render.use_border = render.use_crop_to_border = True
        render.use_compositing = render.use_sequencer = False
        render.resolution_percentage = 100
        self.scene.view_settings.view_transform = "Raw"
        self.scene.view_layers[0].use_pass_z = True

    def add_object(self, name, data):
        """Add an object to the scene."""
        thing = bpy.data.objects.new(name, data)
        self.scene.collection.objects.link(thing)
        return thing

    def get_vertices(self):
        """Return the (N, 3) vertices of the robot."""
        found = np.empty(3 * len(self.robot.data.vertices), np.float32)
        self.robot.data.vertices.foreach_get("co", found)
        return found.reshape(-1, 3)

    def render_crop(self, head):
        """Return (H, W, 4) premultiplied light and opacity, and (H, W) depth of a crop."""
        self.aim_camera(head)
        self.sky.select_panorama(head["light"], head["light_turn_rad"], head["light_strength"])
        self.sun.data.energy = head["sun_strength"]
        self.sun.data.color = head["sun_colour"]
        self.sun.data.angle = head["sun_angle_rad"]
        self.sun.data.use_shadow = head["sun_shadow"]
        self.sun.matrix_world = Matrix(head["sun_matrix"])
        for name, value in head["paint"].items():
            self.robot[name] = value
        self.robot.matrix_world = Matrix(head["camera_from_body"])
        # Required for changed properties. Without the refresh type, the mesh would be copied.
        self.robot.update_tag(refresh={"OBJECT"})
        self.scene.cycles.seed = head["seed"]
        return render_passes()

    def aim_camera(self, head):
        """Set the camera's intrinsics and the crop."""
        width, height = head["size_px"]
        fx, fy, cx, cy = head["intrinsics_px"]
        render, lens = self.scene.render, self.camera.data
        render.resolution_x, render.resolution_y = width, height
        render.pixel_aspect_x, render.pixel_aspect_y = max(fy / fx, 1.0), max(fx / fy, 1.0)
        lens.lens = SENSOR_MM * fx / width
        # Shifts are relative to the image's width, in square pixels.
        lens.shift_x, lens.shift_y = (width / 2 - cx) / width, (cy - height / 2) * fx / fy / width
        left, top, right, bottom = head["crop_px"]
        render.border_min_x, render.border_max_x = (
            (left + NUDGE_PX) / width,
            (right + NUDGE_PX) / width,
        )
        low, high = height - bottom, height - top
        render.border_min_y, render.border_max_y = (
            (low + NUDGE_PX) / height,
            (high + NUDGE_PX) / height,
        )


def main():
    """Serve requests until the other side closes the pipe."""
    requests = sys.stdin.buffer
    # Blender writes to standard output too, so replies use a duplicate of it.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    stage = None
    while True:
        try:
            head, arrays = receive(requests)
        except EOFError:
            return
        if stage is None:
            try:
                stage = RenderScene(head, arrays)
            except (RuntimeError, ValueError, OSError) as error:
                why = " ".join(str(error).split())
                send(answers, {"error": f"{head['model']} is no model that Blender reads: {why}"})
                return
            send(answers, {"version": bpy.app.version_string}, {"points": stage.get_vertices()})
        elif "panorama" in head:
            send(answers, {}, {"panorama": load_panorama(head["panorama"])})
        else:
            send(answers, {}, stage.render_crop(head))


if __name__ == "__main__":
    main()
