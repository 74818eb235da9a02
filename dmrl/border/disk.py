"""Bringing files to the disk, so that a power loss does not take them back."""

import os
from pathlib import Path

from dmrl.border.locking import UNSUPPORTED


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
