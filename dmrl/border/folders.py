"""What stands in a folder of a stranger."""

import os
from pathlib import Path

from dmrl.errors import UnsafeName


def refuse_pipes(folder: Path) -> None:
    """Nothing, if a folder and its folders hold files and folders alone; or if it is no folder.

    Archives can hold named pipes and devices. Who opens one waits for ever, or reads without end.

    Raises
    ------
    UnsafeName
        If there is one.
    OSError
        If a folder cannot be read.
    """
    to_do = [str(folder)] if os.path.isdir(str(folder)) else []  # noqa: PTH112 - a bucket's is none
    while to_do:
        with os.scandir(to_do.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    to_do.append(entry.path)
                # A link that leads nowhere cannot be opened, and is no harm.
                elif not (entry.is_file() or entry.is_dir()) and Path(entry.path).exists():
                    raise UnsafeName(f"{entry.path} is a pipe or a device, no file. Remove it")
