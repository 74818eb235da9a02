"""Flush files to the disk, so that they survive a power loss."""

import os
import shutil
from pathlib import Path

from dmrl.guards.locks import UNSUPPORTED_ERRNOS


def sync(path: Path) -> None:
    """Flush a file, or a folder with everything in it, to the disk.

    Raises
    ------
    OSError
        If the disk reports an error.
    """
    if path.is_dir():
        for inner in sorted(path.iterdir()):
            if not inner.is_symlink():
                sync(inner)
    sync_entry(path)


def sync_entry(path: Path) -> None:
    """Flush a file, or the list of names in a folder, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as e:
        if e.errno not in UNSUPPORTED_ERRNOS:
            raise
    finally:
        os.close(descriptor)


def clear_folder(folder: Path) -> None:
    """Remove everything in a folder. Links are removed, not their targets."""
    for inner in folder.iterdir():
        if inner.is_dir() and not inner.is_symlink():
            shutil.rmtree(inner)
        else:
            inner.unlink(missing_ok=True)
