"""Plug-ins of other packages: formats, networks, commands and pilots, found by their entry points.

In the package's pyproject.toml::

    [project.entry-points."dmrl.formats"]
    blackbox = "their_package.blackbox:FORMAT"     # a dmrl.plugins.Format
    [project.entry-points."dmrl.networks"]
    their-nano = "their_package.network:TheirNano" # a subclass of dmrl.plugins.Network
    [project.entry-points."dmrl.stages"]
    smooth = "their_package.smooth"                # a module with command(), as in dmrl/stages
    [project.entry-points."dmrl.pilots"]
    patrol = "their_package.patrol:Patrol"         # a subclass of dmrl.plugins.Pilot

A plug-in is imported when it is used by its name (a format: when no format of dmrl recognises a
source). A name of dmrl's own stays dmrl's. An error in a plug-in becomes a `PluginError` that
names its package, and affects no other command.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, wraps
from pathlib import Path
from traceback import extract_tb
from typing import TYPE_CHECKING, Any

from dmrl.errors import DmrlError, PluginError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

FORMATS, NETWORKS, STAGES = "dmrl.formats", "dmrl.networks", "dmrl.stages"
PILOTS = "dmrl.pilots"
"""The groups of entry points."""
PLUGIN_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")


@dataclass(frozen=True, slots=True)
class Plugin:
    """A format, network, command or pilot of another package, which is not imported yet.

    Parameters
    ----------
    name
        Name that users give.
    package
        Distribution of the package, as pip lists it.
    summary
        Summary in the package's metadata.
    entry
        Entry point.
    """

    name: str
    package: str
    summary: str
    entry: "EntryPoint"

    def load(self) -> Any:
        """Import the object of the entry point.

        Raises
        ------
        PluginError
            If it cannot be imported.
        """
        with self.naming_the_package("cannot be loaded"):
            try:
                return self.entry.load()
            except SystemExit as e:
                raise RuntimeError(f"it ends the program, with {e.code}") from e

    def require(self, fits: bool, what: str) -> None:
        """Raise PluginError unless the object is of the right kind; ``what`` names the kind."""
        if not fits:
            raise self._error(f"is not {what}: {self.entry.value}")

    @contextmanager
    def naming_the_package(self, what: str) -> Iterator[None]:
        """Turn errors that are not dmrl's own into one that names the package.

        Raises
        ------
        PluginError
            For any other error inside the block; ``what`` is its text.
        """
        try:
            yield
        except (DmrlError, BrokenPipeError):  # the latter: who reads our output has gone
            raise
        except Exception as e:
            last = extract_tb(e.__traceback__)[-1]
            where = f"{Path(last.filename).name}:{last.lineno}"
            text = " ".join(str(e).split()) or "no reason given"
            raise self._error(f"{what}: {type(e).__name__}: {text} ({where})") from e

    def _error(self, what: str) -> PluginError:
        return PluginError(
            f"{self.entry.group} {self.name}, of the package {self.package}, {what}. Update the "
            f"package, or remove it: pip uninstall {self.package}"
        )


@cache
def find_plugins(group: str) -> dict[str, Plugin]:
    """Return the plug-ins of a group by name; of two of one name, the first package's."""
    from importlib.metadata import entry_points  # noqa: PLC0415 - 30 ms of every start

    found = entry_points(group=group)
    every = [_to_plugin(entry) for entry in found if PLUGIN_NAME.fullmatch(entry.name)]
    by_name: dict[str, Plugin] = {}
    for plugin in sorted(every, key=lambda plugin: (plugin.name, plugin.package)):
        by_name.setdefault(plugin.name, plugin)
    return by_name


def _to_plugin(entry: "EntryPoint") -> Plugin:
    if entry.dist is None:
        return Plugin(entry.name, entry.module.split(".")[0], "", entry)
    # A missing key of the metadata is None.
    return Plugin(entry.name, entry.dist.name, entry.dist.metadata["Summary"] or "", entry)


def load_command(plugin: Plugin) -> Callable[..., Any]:
    """Return the function that the command line calls for a stage.

    Raises
    ------
    PluginError
        If it cannot be loaded or is none.
    """
    loaded = plugin.load()
    command = getattr(loaded, "command", loaded)
    plugin.require(callable(command), "a module with a function command()")

    @wraps(command)
    def call_plugin(*arguments: Any, **named: Any) -> Any:
        with plugin.naming_the_package("failed"):
            return command(*arguments, **named)

    return call_plugin


def __getattr__(name: str) -> Any:
    """Return the command of a stage: ``dmrl.entry_points:NAME`` in cli.py."""
    # An import of this module asks for __path__ as well.
    if not PLUGIN_NAME.fullmatch(name) or name not in find_plugins(STAGES):
        raise AttributeError(f"no plug-in {name}")
    return load_command(find_plugins(STAGES)[name])
