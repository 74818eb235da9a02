"""What other packages add to dmrl, found by the entry points that they declare.

In the package's pyproject.toml::

    [project.entry-points."dmrl.formats"]
    blackbox = "their_package.blackbox:FORMAT"     # a dmrl.formats.base.Format
    [project.entry-points."dmrl.networks"]
    their-nano = "their_package.network:TheirNano" # a subclass of dmrl.learn.networks.architectures.Network
    [project.entry-points."dmrl.stages"]
    smooth = "their_package.smooth"                # a module with command(), as in dmrl/stages

Nothing of it is imported before it is asked for by its name (a format: before no format of dmrl
knows a source). A name that dmrl has itself stays dmrl's. What goes wrong in a plug-in is a
`PluginError` that names its package, and harms no other command.
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
"""The groups of entry points."""
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")


@dataclass(frozen=True, slots=True)
class Plugin:
    """One thing that a package adds, not imported yet.

    Parameters
    ----------
    name
        As users call it.
    package
        The distribution that brings it, as pip calls it.
    summary
        What the package says of itself.
    entry
        Where it is.
    """

    name: str
    package: str
    summary: str
    entry: "EntryPoint"

    def load(self) -> Any:
        """What the entry point names, imported.

        Raises
        ------
        PluginError
            If it cannot be imported.
        """
        with self.blamed("cannot be loaded"):
            try:
                return self.entry.load()
            except SystemExit as e:
                raise RuntimeError(f"it ends the program, with {e.code}") from e

    def require(self, fits: bool, what: str) -> None:
        """Nothing, if what was loaded is what it should be.

        Raises
        ------
        PluginError
            If not; ``what`` says what it should be.
        """
        if not fits:
            raise self._error(f"is not {what}: {self.entry.value}")

    @contextmanager
    def blamed(self, what: str) -> Iterator[None]:
        """Errors that are not dmrl's own become one that names the package.

        Raises
        ------
        PluginError
            For any other error inside the block; ``what`` says what went wrong.
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
def found(group: str) -> dict[str, Plugin]:
    """What installed packages add to a group, by name; two of one name: the first package's."""
    from importlib.metadata import entry_points  # noqa: PLC0415 - 30 ms of every start

    every = [_plugin(entry) for entry in entry_points(group=group) if NAME.fullmatch(entry.name)]
    by_name: dict[str, Plugin] = {}
    for plugin in sorted(every, key=lambda plugin: (plugin.name, plugin.package)):
        by_name.setdefault(plugin.name, plugin)
    return by_name


def _plugin(entry: "EntryPoint") -> Plugin:
    if entry.dist is None:
        return Plugin(entry.name, entry.module.split(".")[0], "", entry)
    # A missing key of the metadata is None.
    return Plugin(entry.name, entry.dist.name, entry.dist.metadata["Summary"] or "", entry)


def stage_command(plugin: Plugin) -> Callable[..., Any]:
    """The function that a stage's command line calls.

    Raises
    ------
    PluginError
        If it cannot be loaded or is none.
    """
    loaded = plugin.load()
    command = getattr(loaded, "command", loaded)
    plugin.require(callable(command), "a module with a function command()")

    @wraps(command)
    def called(*arguments: Any, **named: Any) -> Any:
        with plugin.blamed("failed"):
            return command(*arguments, **named)

    return called


def __getattr__(name: str) -> Callable[..., Any]:
    """The command of a stage: the command line finds it as ``dmrl.plugins:NAME``, when called."""
    # Whoever imports this asks for __path__ as well.
    if not NAME.fullmatch(name) or name not in found(STAGES):
        raise AttributeError(name)
    return stage_command(found(STAGES)[name])
