"""Table of all formats, in the order in which a source is tested against them.

A new format is one file in this package with a ``FORMAT``, or a plug-in of another package: see
docs/add-a-format.md.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages

from dmrl import entry_points, formats
from dmrl.entry_points import Plugin
from dmrl.errors import PluginError, SourceError, suggest
from dmrl.formats.base import Content, Format, Options
from dmrl.guards.paths import refuse_pipes
from dmrl.samples.sample import Sample
from dmrl.terminal.progress import say

GUESS_ORDER = (
    *("locanet", "csv", "uwb-tiers", "rosbag2", "nanocockpit", "cfclient"),
    *("cfusdlog", "aideck-stream", "hyperflash", "coco", "voc", "yolo"),
)
"""Formats to try first. The order matters: sources of some contain files that match later ones."""


@cache
def load_builtin_formats() -> dict[str, Format]:
    """Return the ``FORMAT`` of every file of this package by name: ``GUESS_ORDER``, then by name.

    Plain images come last, since any folder with images matches them.
    """
    walked = walk_packages(formats.__path__, f"{formats.__name__}.")
    modules = [import_module(m.name) for m in walked if m.name != __name__]
    found = [m.FORMAT for m in modules if isinstance(getattr(m, "FORMAT", None), Format)]

    def turn(form: Format) -> tuple[int, str]:
        if form.name in GUESS_ORDER:
            return GUESS_ORDER.index(form.name), ""
        return len(GUESS_ORDER) + (form.name == "images"), form.name

    return {form.name: form for form in sorted(found, key=turn)}


def find_format(source: Path, name: str | None = None) -> Format:
    """Return the built-in or plug-in format of a source.

    Parameters
    ----------
    source
        A file or folder.
    name
        Name of its format; None: guess.

    Raises
    ------
    SourceError
        If the source or the format does not exist, or no format matches: lists the formats.
    PluginError
        If the plug-in with the given name cannot be loaded.
    """
    added = {
        n: p
        for n, p in entry_points.find_plugins(entry_points.FORMATS).items()
        if n not in load_builtin_formats()
    }
    known = ", ".join([*load_builtin_formats(), *added])
    if not source.exists():
        raise SourceError(f"no file or folder {source}. Pass one that exists")
    refuse_pipes(source)
    if name in added:
        return _load_plugin_format(added[name])
    if name is not None and name not in load_builtin_formats():
        hint = suggest(name, [*load_builtin_formats(), *added], "")
        words = f"--from {name}: no such format.", hint, f"Formats: {known}"
        raise SourceError(" ".join(filter(None, words)))
    if name is not None:
        return load_builtin_formats()[name]
    if source.is_file() and source.stat().st_size == 0:
        raise SourceError(f"{source} is empty, 0 bytes. Pass another file")
    if source.is_dir() and not any(source.iterdir()):
        raise SourceError(f"{source} is an empty folder. Pass one with files in it")
    if guess := _guess_format(source, added.values()):
        return guess
    if source.suffix == ".mcap" and source.is_file():
        raise SourceError(f"{source} is a recording already. Pass --to: csv, parquet, ros2")
    files = source.iterdir() if source.is_dir() else [source]
    if any(path.suffix.lower() in (".csv", ".tsv") for path in files):
        remedy = "State them: --columns map.toml (docs/sources.md)"
        raise SourceError(f"{source} has columns that dmrl does not know. {remedy}")
    raise SourceError(f"{source} matches no known format. Pass --from: {known}")


def _guess_format(source: Path, added: Iterable[Plugin]) -> Format | None:
    """Return the first format that matches a source. Plug-ins follow dmrl's own, before images."""
    *first, pictures = load_builtin_formats().values()
    if found := next((f for f in first if f.recognises(source)), None):
        return found
    for plugin in added:
        try:
            form = _load_plugin_format(plugin)
            if form.recognises(source):
                return form
        except PluginError as e:
            say(f"{e}. Skipped for {source}")
    return pictures if pictures.recognises(source) else None


def _load_plugin_format(plugin: Plugin) -> Format:
    """Load the format of another package. Its failures become errors that name the package."""
    loaded = plugin.load()
    form = getattr(loaded, "FORMAT", loaded)
    plugin.require(isinstance(form, Format), "a dmrl.plugins.Format")

    def recognises(source: Path) -> bool:
        with plugin.naming_the_package(f"fails to check {source}"):
            return bool(form.recognises(source))

    def content(source: Path, options: Options) -> Content:
        with plugin.naming_the_package(f"fails to read {source}"):
            held: Content = form.content(source, options)
            return replace(held, samples=samples(source, held.samples))

    def samples(source: Path, given: Iterator[Sample]) -> Iterator[Sample]:
        with plugin.naming_the_package(f"fails to read {source}"):
            yield from given

    return Format(plugin.name, form.what, recognises, content, form.uses)
