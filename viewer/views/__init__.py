"""Layouts of ``dmrl view`` for recordings, one file each; the file has the layout's name.

Each has a function ``scene(selection, settings)``. It returns a `Scene`: the topics that are drawn,
and the panels around them. A layout is imported when it is shown.
"""

from pkgutil import iter_modules

LAYOUT_NAMES = tuple(sorted(module.name for module in iter_modules(__path__)))
