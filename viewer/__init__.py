"""Show recordings in rerun: a window, a file, a web page or an image. Only this package uses rerun.

* ``drawing`` converts the columns of a topic to archetypes; ``content`` joins several topics.
* ``layouts`` arranges panels. Each file of ``views`` is a layout, ``browse`` the one of datasets.
* ``session`` logs the images that ``selection`` chose. ``window`` runs rerun's viewer.

A name is imported on first use: ``settings`` needs no rerun.
"""

from typing import TYPE_CHECKING

from dmrl.errors import MissingExtra
from dmrl.guards.lazy_names import import_lazily
from dmrl.viewer.settings import Settings, Web

if TYPE_CHECKING:
    from dmrl.viewer.flag_page import write_flag_page as flag
    from dmrl.viewer.session import save
    from dmrl.viewer.window.desktop import show_in_window as view
    from dmrl.viewer.window.desktop import write_screenshot as screenshot
    from dmrl.viewer.window.web_page import Page, serve
    from dmrl.viewer.window.web_page import open_page as page

__all__ = ["Page", "Settings", "Web", "flag", "page", "save", "screenshot", "serve", "view"]

_PLACES = {
    "flag": "dmrl.viewer.flag_page:write_flag_page",
    "Page": "dmrl.viewer.window.web_page",
    "page": "dmrl.viewer.window.web_page:open_page",
    "save": "dmrl.viewer.session",
    "screenshot": "dmrl.viewer.window.desktop:write_screenshot",
    "serve": "dmrl.viewer.window.web_page",
    "view": "dmrl.viewer.window.desktop:show_in_window",
}
_import = import_lazily(__name__, _PLACES)


def __getattr__(name: str) -> object:
    try:
        return _import(name)
    except ImportError as e:
        raise MissingExtra("rerun-sdk", "view", "dmrl view") from e
