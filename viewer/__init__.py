"""Show recordings in rerun: a window, a file, a web page or an image. Only this package uses rerun.

* ``drawing`` converts the columns of a topic to archetypes; ``content`` joins several topics.
* ``layouts`` arranges panels. Each file of ``views`` is a layout, ``browse`` the one of datasets.
* ``session`` logs the images that ``selection`` chose. ``window`` runs rerun's viewer.
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
