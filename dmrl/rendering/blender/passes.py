# SPDX-License-Identifier: GPL-3.0-or-later
#
# Copyright (C) 2026 The dmrl developers
#
# This program is free software: you can redistribute it and/or modify it under the terms of
# the GNU General Public License as published by the Free Software Foundation, either version
# 3 of the License, or (at your option) any later version. It is distributed in the hope that
# it will be useful, but WITHOUT ANY WARRANTY; without even the implied warranty of
# MERCHANTABILITY or FITNESS FOR A PARTICULAR PURPOSE. See <https://www.gnu.org/licenses/>.
"""Pixels of a render, read from memory, or from files where Blender does not expose them."""

import tempfile
from pathlib import Path

import bpy
import numpy as np
from cycles import CyclesRender

CHANNELS = {"Combined": 4, "Depth": 1}

_render = CyclesRender.render
_captured = {}


def _render_and_capture(engine, depsgraph):
    """Run Cycles' own render, then read the passes from memory."""
    _render(engine, depsgraph)
    try:
        _capture_passes(engine.get_result())
    except AttributeError:  # this Blender does not expose the passes
        _captured.clear()


def _capture_passes(result):
    for one in result.layers[0].passes:
        if one.name in CHANNELS:
            buffer = np.empty(result.resolution_x * result.resolution_y * one.channels, np.float32)
            one.rect.foreach_get(buffer)
            shape = (result.resolution_y, result.resolution_x, one.channels)
            _captured[one.name] = buffer.reshape(shape)[::-1]


class Passes:
    """Renderer of a scene that returns its passes.

    Reading passes from memory is not documented by Blender. A release without it is slower, but
    gives the same images.
    """

    def __init__(self, scene):
        self.scene = scene
        self.folder = None
        CyclesRender.render = _render_and_capture

    def render(self):
        """Return (H, W, 4) premultiplied light and opacity, and (H, W) depth, top row first."""
        if self.folder is None:
            _captured.clear()
            bpy.ops.render.render()
            if len(_captured) == len(CHANNELS):
                return {"light": _captured["Combined"], "depth": _captured["Depth"][..., 0]}
            self._use_files()
        bpy.ops.render.render()
        light, depth = (_load_exr(self._path(name)) for name in CHANNELS)
        return {"light": light, "depth": depth[..., 0].copy()}

    def _use_files(self):
        """Configure the compositor to write the passes of every render to files."""
        CyclesRender.render = _render
        self.folder = tempfile.TemporaryDirectory(prefix="dmrl-")
        self.scene.render.use_compositing = self.scene.use_nodes = True
        tree = self.scene.node_tree
        tree.nodes.clear()
        layers = tree.nodes.new("CompositorNodeRLayers")
        for name, socket in zip(CHANNELS, ("Image", "Depth"), strict=True):
            writer = tree.nodes.new("CompositorNodeOutputFile")
            writer.base_path = self.folder.name
            writer.format.file_format, writer.format.color_depth = "OPEN_EXR", "32"
            writer.format.color_mode = "RGBA"
            writer.file_slots[0].path = name
            tree.links.new(layers.outputs[socket], writer.inputs[0])

    def _path(self, name):
        return Path(self.folder.name) / f"{name}{self.scene.frame_current:04d}.exr"


def _load_exr(path):
    image = bpy.data.images.load(str(path))
    try:
        width, height = image.size
        pixels = np.empty(4 * width * height, np.float32)
        image.pixels.foreach_get(pixels)
    finally:
        bpy.data.images.remove(image)
        path.unlink()
    return pixels.reshape(height, width, 4)[::-1]
