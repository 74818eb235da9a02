"""Check the paths that a user names, and the content of untrusted folders."""

import os
import stat
from contextlib import suppress
from pathlib import Path

from dmrl.errors import UnsafeName


def require_text_path(path: Path) -> None:
    """Raise UnsafeName unless a path is valid UTF-8 without NUL.

    File systems accept any bytes. Libraries that write tables, figures and training logs need text,
    and some of them would fail in the middle of the work.
    """
    name = str(path)
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        raise UnsafeName(
            f"{name[:80]} is not valid UTF-8, which some programs cannot read. Rename it"
        ) from None
    if "\0" in name:
        raise UnsafeName(f"no file can be called {name[:80]!r}. Check the name")


def refuse_pipe(path: Path) -> None:
    """Raise UnsafeName if a path is a pipe, a socket or a device, or contains NUL."""
    if "\0" in str(path):
        raise UnsafeName(f"no file can be called {str(path)[:80]!r}. Check the name")
    with suppress(OSError):  # opening it will report the error
        mode = os.stat(str(path)).st_mode  # noqa: PTH116 - no request to a bucket
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise UnsafeName(f"{path} is a pipe or a device, not a file. Name a file")


def refuse_pipes(folder: Path) -> None:
    """Raise UnsafeName if a folder contains pipes, sockets or devices, at any depth.

    Archives can contain named pipes and devices, where a read could block or never end.

    Raises
    ------
    UnsafeName
        If there is one.
    OSError
        If a folder cannot be read.
    """
    refuse_pipe(folder)
    to_do = [str(folder)] if os.path.isdir(str(folder)) else []  # noqa: PTH112 - a bucket's is none
    while to_do:
        with os.scandir(to_do.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    to_do.append(entry.path)
                # A dangling link cannot be opened, so it does no harm.
                elif not (entry.is_file() or entry.is_dir()) and Path(entry.path).exists():
                    raise UnsafeName(f"{entry.path} is a pipe or a device, not a file. Remove it")
