"""Recordings in rerun: a window, a file, a web page or a picture. The only home of rerun.

``entities`` turns a topic's columns into archetypes, ``layouts`` arranges them, ``session``
reads and logs what ``selection`` chose, ``window`` runs rerun's viewer. One timeline, ``log_time``.
"""

from dmrl.errors import MissingExtra

try:
    from dmrl.viewer.selection import Settings
    from dmrl.viewer.session import save
    from dmrl.viewer.window import screenshot, serve, view
except ImportError as e:
    raise MissingExtra("rerun-sdk", "view", "dmrl view") from e

__all__ = ["Settings", "save", "screenshot", "serve", "view"]
