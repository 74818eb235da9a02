# SPDX-License-Identifier: GPL-3.0-or-later
#
# Copyright (C) 2026 The dmrl developers
#
# This program is free software: you can redistribute it and/or modify it under the terms of
# the GNU General Public License as published by the Free Software Foundation, either version
# 3 of the License, or (at your option) any later version. It is distributed in the hope that
# it will be useful, but WITHOUT ANY WARRANTY; without even the implied warranty of
# MERCHANTABILITY or FITNESS FOR A PARTICULAR PURPOSE. See <https://www.gnu.org/licenses/>.
"""Pixels of a render, read from memory.

Blender does not document this. Its release is fixed: see `dmrl.rendering.blender_environment`.
"""

import bpy
import numpy as np
from cycles import CyclesRender

PASSES = ("Combined", "Depth")

_render = CyclesRender.render
_captured = {}


def _render_and_capture(engine, depsgraph):
    """Run Cycles' own render, then read the passes from memory."""
    _render(engine, depsgraph)
    result = engine.get_result()
    for one in result.layers[0].passes:
        if one.name in PASSES:
            buffer = np.empty(result.resolution_x * result.resolution_y * one.channels, np.float32)
            one.rect.foreach_get(buffer)
            shape = (result.resolution_y, result.resolution_x, one.channels)
            _captured[one.name] = buffer.reshape(shape)[::-1]


CyclesRender.render = _render_and_capture


def render_passes():
    """Return (H, W, 4) premultiplied light and opacity, and (H, W) depth, top row first."""
    _captured.clear()
    bpy.ops.render.render()
    return {"light": _captured["Combined"], "depth": _captured["Depth"][..., 0]}
