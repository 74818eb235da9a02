"""Names that come from files and from the network, made safe before they become anything else.

A recording, a model, a recipe or a packet may come from a stranger, and so does every name in
it: of a robot, topic, split, step, network, layer, class or event. Before such a name becomes a
path, a comment of C, Markdown, or a line on a terminal, it goes through one of these functions.
"""

import re
from functools import cache
from pathlib import Path
from urllib.parse import quote

from dmrl.errors import UnsafeName, one_line

MOST_BYTES = 200
"""Of a name: with ``-00000-of-00001.parquet`` it still fits a file system's 255."""

LINE_MAX = 480
"""Of an error: a few lines of a terminal."""

_PLAIN = re.compile(r"[^A-Za-z0-9 ._,:+()=-]")
_SPLIT = re.compile(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*")
_MARKUP = re.compile(r"([\\`\[\]<>|]|(?<=:)/|(?<=www)\.)", re.IGNORECASE)
"""What is markup, and what makes a link of ``https://x`` or ``www.x``."""
_TAKEN = (
    *("data", "figures", "parts", "readme.md", "croissant.json", "facts.json"),
    *("manifest.json", "provenance.json", "dataset_dict.json"),
)
"""What a dataset's folder holds beside its splits; many disks take ``Data`` for ``data``."""
_DEVICE = re.compile(r"(con|prn|aux|nul|(com|lpt)[0-9])(\..*)?", re.IGNORECASE)
"""Names that Windows keeps for devices: no folder of a dataset that is copied there has one."""


def inside(folder: Path, name: str, what: str, *, suffix: str = "") -> Path:
    """The file or folder ``name + suffix`` in ``folder``: in it, whatever the name is.

    Parameters
    ----------
    folder
        Where it shall lie.
    name
        From a file: one part of a path, no more.
    what
        What is named so, and where, for the error: ``"flight.mcap: the split"``.
    suffix
        Our own ending.

    Raises
    ------
    UnsafeName
        If the name is no plain name of a file.
    """
    return folder / (file_name(name, what) + suffix)


def file_name(name: str, what: str) -> str:
    """The name, if it can be that of a file in any folder and is nothing else.

    Raises
    ------
    UnsafeName
        If it is empty, too long, begins with a dot, or holds a slash or a control character.
    """
    if not name:
        raise UnsafeName(f"{what} has an empty name. Give it one")
    shown = shortened(name)
    if "/" in name or "\\" in name or name.startswith("."):
        raise UnsafeName(
            f"{what} is called {shown!r}, which leads out of its folder or hides in it. "
            "Names have no slashes and no dot in front"
        )
    if not name.isprintable() or len(name.encode("utf-8", "replace")) > MOST_BYTES:
        raise UnsafeName(
            f"{what} is called {shown!r}, which no file can be called everywhere. "
            f"Use up to {MOST_BYTES} letters, digits and signs"
        )
    return name


def split_name(name: str, what: str) -> str:
    """The name, if a split can be called so: letters, digits, ``_`` and ``-``, and dots between.

    Raises
    ------
    UnsafeName
        If it cannot on every disk, or a part of every dataset is called so.
    """
    if not isinstance(name, str) or not _SPLIT.fullmatch(name) or len(name) > MOST_BYTES:
        raise UnsafeName(
            f"{what} is called {shortened(str(name))!r}. Give it up to {MOST_BYTES} letters, "
            "digits, _ and -"
        )
    if _DEVICE.fullmatch(name):
        raise UnsafeName(f"{what} is called {name}, as devices of Windows are. Rename it")
    if name.casefold() in _TAKEN:
        raise UnsafeName(f"{what} is called {name}, as a part of every dataset is. Rename it")
    return name


@cache
def topic_part(name: str, what: str) -> str:
    """The name, if it can stand between two slashes of a topic.

    Raises
    ------
    UnsafeName
        If it is empty, too long, or holds a slash or a control character.
    """
    if not name or "/" in name or not name.isprintable() or len(name) > MOST_BYTES:
        raise UnsafeName(
            f"a {what} is called {shortened(name)!r}, which cannot be part of a topic. Names have "
            "no slashes and no control characters"
        )
    return name


def file_of_topic(topic: str) -> str:
    """A file name for a topic, another for every other: ``/cf1/height`` is ``cf1.height``.

    A dot of the topic itself, and what is not safe in a file's name, is written ``%2E``; a topic
    without a slash in front begins with ``=``.
    """
    parts = topic.removeprefix("/").split("/")
    name = ".".join(quote(part, safe=" +,@()").replace(".", "%2E") for part in parts)
    return (name or "%2F") if topic.startswith("/") else f"={name}"


def plain(text: str) -> str:
    """The text for comments of C and of Makefiles: what could end one becomes ``_``.

    Letters, digits, spaces and a few signs stay: no ``*/``, no line end, no backslash, no
    trigraph, no quote and no ``$`` can be written with them.
    """
    return _PLAIN.sub("_", shortened(text))


def markdown(text: str) -> str:
    """The text for a line of Markdown or a cell of its tables: no link, no HTML, no new cell."""
    return _MARKUP.sub(r"\\\1", one_line(text))


def code(text: str) -> str:
    """The text as a code span of Markdown, which nothing in it can end."""
    line = one_line(text)
    fence = "`" * (1 + max((len(run) for run in re.findall("`+", line)), default=0))
    pad = " " if line.startswith("`") or line.endswith("`") else ""
    return f"{fence}{pad}{line}{pad}{fence}"


def shortened(text: str) -> str:
    """The text, cut where it is longer than any honest name."""
    return text if len(text) <= MOST_BYTES else f"{text[:MOST_BYTES]}..."


def without_middle(line: str) -> str:
    """A line that a person reads: of a very long one the middle is left out.

    The file at fault stands at its beginning, the way out at its end.
    """
    if len(line) <= LINE_MAX:
        return line
    return f"{line[: LINE_MAX // 2]} ... {line[-LINE_MAX // 2 :]}"
