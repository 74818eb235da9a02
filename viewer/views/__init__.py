"""What recordings can be shown as: a file here is a layout of ``dmrl view``, by its name.

It has one function, ``scene(selection, settings)``, which gives a `Scene`: what is drawn of which
topics, and the panels around it. It is loaded when it is shown.
"""

from pkgutil import iter_modules

NAMES = tuple(sorted(module.name for module in iter_modules(__path__)))
