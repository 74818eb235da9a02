"""Recordings in rerun: a window, a file, a web page or a picture. The only home of rerun.

``entities`` (images), ``space`` (3D) and ``plots`` turn a topic's columns into archetypes,
``layouts`` arranges them. Each file of ``views`` is a layout, and ``browse`` that of datasets;
``follow`` joins what a flight's topics say together. ``session`` logs what ``selection`` chose;
``window`` and ``web`` run rerun's viewer.
"""

from dmrl.errors import MissingExtra

try:
    from dmrl.viewer.flag import flag
    from dmrl.viewer.selection import Settings
    from dmrl.viewer.session import save
    from dmrl.viewer.window.desktop import screenshot, view
    from dmrl.viewer.window.web_page import Page, Web, page, serve
except ImportError as e:
    raise MissingExtra("rerun-sdk", "view", "dmrl view") from e

__all__ = ["Page", "Settings", "Web", "flag", "page", "save", "screenshot", "serve", "view"]
