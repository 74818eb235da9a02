# SPDX-License-Identifier: GPL-3.0-or-later
#
# Copyright (C) 2026 The dmrl developers
#
# This program is free software: you can redistribute it and/or modify it under the terms of
# the GNU General Public License as published by the Free Software Foundation, either version
# 3 of the License, or (at your option) any later version. It is distributed in the hope that
# it will be useful, but WITHOUT ANY WARRANTY; without even the implied warranty of
# MERCHANTABILITY or FITNESS FOR A PARTICULAR PURPOSE. See <https://www.gnu.org/licenses/>.
"""Light of panoramas, on robots and as backgrounds."""

import math

import bpy
import numpy as np
from nodes import add_math, add_node

LIGHT_SIZE_PX = (32, 16)
MEAN_LIGHT = 0.5
LIGHT_CAP = 8.0


class Sky:
    """One Blender world for all panoramas, stacked in one image.

    Separate worlds would be reloaded at every change, which takes longer than rendering a robot.
    """

    def __init__(self, scene, lights):
        columns, rows = LIGHT_SIZE_PX
        atlas = bpy.data.images.new("light", columns, rows * len(lights), float_buffer=True)
        drawn = [downsample_panorama(name) for name in lights]
        atlas.pixels.foreach_set(np.concatenate(drawn).ravel())
        self.numbers = {name: k for k, name in enumerate(lights)}
        scene.world = world = bpy.data.worlds.new("world")
        world.use_nodes = True
        # The coarse, capped panorama needs no importance sampling: random rays hit it often
        # enough. Light sampling is left to the sun, and no importance map is built per image.
        world.cycles.sampling_method = "NONE"
        world.cycles_visibility.camera = False  # the film is transparent there
        tree = world.node_tree
        self.background = tree.nodes["Background"]
        place = tree.nodes.new("ShaderNodeTexCoord").outputs["Generated"]
        self.turn = add_node(tree, "Mapping", place)
        x, y, z = add_node(tree, "SeparateXYZ", self.turn.outputs[0]).outputs
        turn = add_math(tree, "DIVIDE", add_math(tree, "ARCTAN2", y, x), -2 * math.pi)
        height = add_math(tree, "DIVIDE", add_math(tree, "ARCSINE", z), math.pi)
        # Stay half a row from the edges, where the next panorama would be interpolated.
        height = add_math(tree, "MULTIPLY", add_math(tree, "ADD", height, 0.5), (rows - 1) / rows)
        height = add_math(tree, "ADD", height, 0.5 / rows)
        self.number = add_node(tree, "Math", height, 0.0, operation="ADD")
        up = add_math(tree, "DIVIDE", self.number.outputs[0], len(lights))
        where = add_node(tree, "CombineXYZ", add_math(tree, "ADD", turn, 0.5), up, 0.0)
        picture = add_node(tree, "TexImage", where.outputs[0], image=atlas)
        tree.links.new(picture.outputs["Color"], self.background.inputs["Color"])

    def select_panorama(self, name, turn_rad, strength):
        """Select one panorama, rotated by XYZ angles."""
        self.number.inputs[1].default_value = self.numbers[name]
        self.turn.inputs["Rotation"].default_value = turn_rad
        self.background.inputs["Strength"].default_value = strength


def downsample_panorama(name):
    """Return a (rows, columns, 4) downsampled panorama of mean MEAN_LIGHT.

    Small bright lights would cause fireflies. The scene's sun replaces them.
    """
    columns, rows = LIGHT_SIZE_PX
    wide = load_panorama(name)[::-1]
    height, width, _ = wide.shape
    down, across = height // rows, width // columns
    if not (down and across):
        raise ValueError(f"{name} is smaller than {columns}x{rows} pixels")
    part = wide[: down * rows, : across * columns]
    small = part.reshape(rows, down, columns, across, 3).mean(axis=(1, 3))
    small *= MEAN_LIGHT / max(small.mean(), 1e-9)
    small = np.minimum(small, LIGHT_CAP * MEAN_LIGHT)
    return np.dstack([small, np.ones((rows, columns, 1))]).astype(np.float32)


def load_panorama(name):
    """Load the (H, W, 3) linear light of a panorama, top row first."""
    image = bpy.data.images.load(name)
    width, height = image.size
    pixels = np.empty(4 * width * height, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1, :, :3]
