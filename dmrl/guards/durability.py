"""Bringing files to the disk, so that a power loss does not take them back."""

import os
import shutil
from pathlib import Path

from dmrl.guards.locks import UNSUPPORTED


def sync(path: Path) -> None:
    """Bring a file, or a folder with everything in it, to the disk.

    Raises
    ------
    OSError
        If the disk refuses.
    """
    if path.is_dir():
        for inner in sorted(path.iterdir()):
            if not inner.is_symlink():
                sync(inner)
    sync_one(path)


def sync_one(path: Path) -> None:
    """Bring a file to the disk, or the names in a folder."""
    held = os.open(path, os.O_RDONLY)
    try:
        os.fsync(held)
    except OSError as e:
        if e.errno not in UNSUPPORTED:
            raise
    finally:
        os.close(held)


def empty(folder: Path) -> None:
    """Remove everything in a folder; links in it, not what they lead to."""
    for inner in folder.iterdir():
        if inner.is_dir() and not inner.is_symlink():
            shutil.rmtree(inner)
        else:
            inner.unlink(missing_ok=True)
