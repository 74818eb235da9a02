# SPDX-License-Identifier: GPL-3.0-or-later
"""dmrl's Blender worker with times of rendering, run in Blender's Python.

DMRL_RENDER_TIMES names a file. Each image adds a line with two numbers: the CPU seconds of this
process so far, and those of bpy.ops.render.render in it. The latter include Cycles, Blender's
update of the scene, and its BVH.
"""

import os
import sys
import time
from pathlib import Path

WORKER_FOLDER = Path(__file__).parents[1] / "dmrl" / "rendering" / "blender"
sys.path.insert(0, str(WORKER_FOLDER))

import worker  # noqa: E402

OUT = Path(os.environ["DMRL_RENDER_TIMES"])
_send, _render_passes = worker.send, worker.render_passes
spent_s = 0.0


def timed_render():
    """Render, and add the CPU seconds to the total."""
    global spent_s
    begin = time.process_time()
    found = _render_passes()
    spent_s += time.process_time() - begin
    return found


def timed_send(*message):
    """Send a message, and write a line of times."""
    _send(*message)
    with OUT.open("a") as out:
        out.write(f"{time.process_time():.6f} {spent_s:.6f}\n")


worker.render_passes, worker.send = timed_render, timed_send
worker.main()
