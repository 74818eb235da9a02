# SPDX-License-Identifier: GPL-3.0-or-later
#
# Copyright (C) 2026 The dmrl developers
#
# This program is free software: you can redistribute it and/or modify it under the terms of
# the GNU General Public License as published by the Free Software Foundation, either version
# 3 of the License, or (at your option) any later version. It is distributed in the hope that
# it will be useful, but WITHOUT ANY WARRANTY; without even the implied warranty of
# MERCHANTABILITY or FITNESS FOR A PARTICULAR PURPOSE. See <https://www.gnu.org/licenses/>.
"""Restriction of Blender to one core while it is loaded."""

import os
from contextlib import contextmanager


@contextmanager
def limit_to_one_core():
    """Limit this process to one core inside the context.

    Blender's libraries count the cores when they are loaded and start one thread per core. A
    worker has work for one thread. The others would spin idly and take half a core from the
    other workers. Where affinity cannot be set (macOS, Windows) this has no effect.
    """
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else None
    if cores:
        os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        if cores:
            os.sched_setaffinity(0, cores)
