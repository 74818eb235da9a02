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
    from dmrl.viewer.flag_page import write_flag_page
    from dmrl.viewer.session import save
    from dmrl.viewer.window.desktop import show_in_window, write_screenshot
    from dmrl.viewer.window.web_page import Page, open_page, serve

__all__ = [
    "Page",
    "Settings",
    "Web",
    "open_page",
    "save",
    "serve",
    "show_in_window",
    "write_flag_page",
    "write_screenshot",
]

_PLACES = {
    "flag": "dmrl.viewer.flag_page",
    "Page": "dmrl.viewer.window.web_page",
    "page": "dmrl.viewer.window.web_page",
    "save": "dmrl.viewer.session",
    "screenshot": "dmrl.viewer.window.desktop",
    "serve": "dmrl.viewer.window.web_page",
    "view": "dmrl.viewer.window.desktop",
}
_import = import_lazily(__name__, _PLACES)


def __getattr__(name: str) -> object:
    try:
        return _import(name)
    except ImportError as e:
        raise MissingExtra("rerun-sdk", "view", "dmrl view") from e
