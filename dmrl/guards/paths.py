"""What stands in a folder of a stranger, and under a name that somebody gives."""

import os
import stat
from contextlib import suppress
from pathlib import Path

from dmrl.errors import UnsafeName


def refuse_no_text(path: Path) -> None:
    """Nothing, if every library can be given a path: it is text, and holds no NUL.

    File systems take any bytes. What writes tables, figures and logs of a training takes text, and
    some of it fails in the middle of the work.

    Raises
    ------
    UnsafeName
        If one cannot.
    """
    name = str(path)
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        raise UnsafeName(
            f"{name[:80]} is no text, and not every program reads it. Rename it"
        ) from None
    if "\0" in name:
        raise UnsafeName(f"no file can be called {name[:80]!r}. Check the name")


def refuse_pipe(path: Path) -> None:
    """Nothing, if a path is a file or a folder, or nothing is there.

    Raises
    ------
    UnsafeName
        If it is a pipe, a socket or a device, or no path at all.
    """
    if "\0" in str(path):
        raise UnsafeName(f"no file can be called {str(path)[:80]!r}. Check the name")
    with suppress(OSError):  # who opens it says so
        mode = os.stat(str(path)).st_mode  # noqa: PTH116 - a bucket is not asked
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise UnsafeName(f"{path} is a pipe or a device, no file. Name a file")


def refuse_pipes(folder: Path) -> None:
    """Nothing, if a folder and its folders hold files and folders alone; or if it is a file.

    Archives can hold named pipes and devices. Who opens one waits for ever, or reads without end.

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
                # A link that leads nowhere cannot be opened, and is no harm.
                elif not (entry.is_file() or entry.is_dir()) and Path(entry.path).exists():
                    raise UnsafeName(f"{entry.path} is a pipe or a device, no file. Remove it")
