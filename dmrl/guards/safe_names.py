"""Make names from files and from the network safe before they are used.

A recording, a model, a recipe or a packet may be untrusted, and so is every name in it: of a
robot, topic, split, step, network, layer, class or event. Before a name becomes a path, a C
comment, Markdown or terminal output, it passes through one of these functions.
"""

import re
from functools import cache
from pathlib import Path
from urllib.parse import quote

from dmrl.errors import UnsafeName, to_one_line

NAME_BYTES_MAX = 200
"""Length of a name, bytes. With ``-00000-of-00001.parquet`` it fits a file system's 255."""

ERROR_CHARACTERS_MAX = 480
"""Length of an error message, characters: a few lines of a terminal."""

_COMMENT_UNSAFE = re.compile(r"[^A-Za-z0-9 ._,:+()=-]")
_SPLIT_NAME = re.compile(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*")
_MARKUP = re.compile(r"([\\`\[\]<>|]|(?<=:)/|(?<=www)\.)", re.IGNORECASE)
"""Characters of markup, and those that make a link of ``https://x`` or ``www.x``."""
_RESERVED_NAMES = (
    *("data", "figures", "parts", "readme.md", "croissant.json", "facts.json"),
    *("manifest.json", "provenance.json", "dataset_dict.json"),
)
"""Names in a dataset's folder beside the splits. Many disks do not distinguish upper case."""
_WINDOWS_DEVICE = re.compile(r"(con|prn|aux|nul|(com|lpt)[0-9])(\..*)?", re.IGNORECASE)
"""Names that Windows reserves for devices. A dataset must be copyable to Windows."""


def safe_join(folder: Path, name: str, what: str, *, suffix: str = "") -> Path:
    """Return the path ``folder / (name + suffix)``, which is inside ``folder`` for every name.

    Parameters
    ----------
    folder
        Parent folder.
    name
        Untrusted name: a single part of a path.
    what
        Description of the named object for the error: ``"flight.mcap: the split"``.
    suffix
        Trusted suffix.

    Raises
    ------
    UnsafeName
        If the name is not a plain file name.
    """
    return folder / (check_file_name(name, what) + suffix)


def check_file_name(name: str, what: str) -> str:
    """Return the name if it is a valid file name in any folder.

    Raises
    ------
    UnsafeName
        If it is empty, too long, begins with a dot, or contains a slash or a control character.
    """
    if not name:
        raise UnsafeName(f"{what} has an empty name. Give it one")
    shown = truncate(name)
    if "/" in name or "\\" in name or name.startswith("."):
        raise UnsafeName(
            f"{what} is called {shown!r}, which is a path or a hidden file. "
            "Use a name without slashes and leading dots"
        )
    if not name.isprintable() or len(name.encode("utf-8", "replace")) > NAME_BYTES_MAX:
        raise UnsafeName(
            f"{what} is called {shown!r}, which is not a valid file name everywhere. "
            f"Use up to {NAME_BYTES_MAX} letters, digits and signs"
        )
    return name


def check_split_name(name: str, what: str) -> str:
    """Return the name if it is valid for a split: letters, digits, ``_``, ``-``, inner dots.

    Raises
    ------
    UnsafeName
        If the name is not valid on every disk, or is reserved in a dataset's folder.
    """
    if not isinstance(name, str) or not _SPLIT_NAME.fullmatch(name) or len(name) > NAME_BYTES_MAX:
        raise UnsafeName(
            f"{what} is called {truncate(str(name))!r}. Give it up to {NAME_BYTES_MAX} letters, "
            "digits, _ and -"
        )
    if _WINDOWS_DEVICE.fullmatch(name):
        raise UnsafeName(f"{what} is called {name}, which Windows reserves for a device. Rename it")
    if name.casefold() in _RESERVED_NAMES:
        raise UnsafeName(f"{what} is called {name}, which is reserved in a dataset. Rename it")
    return name


@cache
def check_topic_part(name: str, what: str) -> str:
    """Return the name if it is valid between two slashes of a topic.

    Raises
    ------
    UnsafeName
        If it is empty, too long, or contains a slash or a control character.
    """
    if not name or "/" in name or not name.isprintable() or len(name) > NAME_BYTES_MAX:
        raise UnsafeName(
            f"a {what} is called {truncate(name)!r}, which cannot be part of a topic. Use a name "
            "without slashes and control characters"
        )
    return name


def to_topic_file_name(topic: str) -> str:
    """Return a unique file name for a topic: ``/cf1/height`` becomes ``cf1.height``.

    Dots and unsafe characters of the topic are percent-encoded (``%2E``). A topic without a leading
    slash gets the prefix ``=``.
    """
    parts = topic.removeprefix("/").split("/")
    name = ".".join(quote(part, safe=" +,@()").replace(".", "%2E") for part in parts)
    return (name or "%2F") if topic.startswith("/") else f"={name}"


def comment_safe(text: str) -> str:
    """Replace characters that could end a comment in C or a Makefile by ``_``.

    Letters, digits, spaces and a few signs stay. They cannot form ``*/``, a line end, a backslash,
    a trigraph, a quote or ``$``.
    """
    return _COMMENT_UNSAFE.sub("_", truncate(text))


def escape_markdown(text: str) -> str:
    """Escape text for a line of Markdown or a table cell: no link, no HTML, no new cell."""
    return _MARKUP.sub(r"\\\1", to_one_line(text))


def markdown_code(text: str) -> str:
    """Return the text as a Markdown code span that its content cannot end."""
    line = to_one_line(text)
    fence = "`" * (1 + max((len(run) for run in re.findall("`+", line)), default=0))
    pad = " " if line.startswith("`") or line.endswith("`") else ""
    return f"{fence}{pad}{line}{pad}{fence}"


def truncate(text: str) -> str:
    """Truncate text that is longer than any honest name."""
    return text if len(text) <= NAME_BYTES_MAX else f"{text[:NAME_BYTES_MAX]}..."


def truncate_middle(line: str) -> str:
    """Remove the middle of a very long line for people.

    The beginning names the file at fault, the end the way out.
    """
    if len(line) <= ERROR_CHARACTERS_MAX:
        return line
    return f"{line[: ERROR_CHARACTERS_MAX // 2]} ... {line[-ERROR_CHARACTERS_MAX // 2 :]}"
