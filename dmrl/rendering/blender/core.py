# SPDX-License-Identifier: GPL-3.0-or-later
#
# Copyright (C) 2026 The dmrl developers
#
# This program is free software: you can redistribute it and/or modify it under the terms of
# the GNU General Public License as published by the Free Software Foundation, either version
# 3 of the License, or (at your option) any later version. It is distributed in the hope that
# it will be useful, but WITHOUT ANY WARRANTY; without even the implied warranty of
# MERCHANTABILITY or FITNESS FOR A PARTICULAR PURPOSE. See <https://www.gnu.org/licenses/>.
"""One core while Blender is loaded, all of them afterwards."""

import os
from contextlib import contextmanager


@contextmanager
def one_core():
    """Show this process a single core.

    Blender's libraries count the cores when they are loaded and start a thread for each. A
    worker has work for one: the others would spin, waiting for some, and take half a core from
    the other workers. Where cores cannot be chosen (macOS, Windows) this does nothing.
    """
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else None
    if cores:
        os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        if cores:
            os.sched_setaffinity(0, cores)
