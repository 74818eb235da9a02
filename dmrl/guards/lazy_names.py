"""Names of a package that are imported when they are used, by a module's ``__getattr__``."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def import_lazily(package: str, places: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a ``__getattr__`` for a package or module.

    Parameters
    ----------
    package
        Its name.
    places
        Where each name is: ``module``, or ``module:name`` where it has another name.
    """

    def __getattr__(name: str) -> Any:  # noqa: N807 - it becomes one
        if name not in places:
            raise AttributeError(f"{package} has no {name}. It has: {', '.join(sorted(places))}")
        module, _, other = places[name].partition(":")
        return getattr(import_module(module), other or name)

    return __getattr__
