"""Give each command a temporary folder of its own, and remove it whatever happens.

Compilers, Ray, Blender and viewers leave files in the system's temporary folder. A command
therefore points them to a locked folder there. It removes the folder at its end; the next command
removes those whose owner was killed.
"""

import atexit
import os
import shutil
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

from dmrl.guards.locks import is_same_file
from dmrl.guards.posix import HAS_LOCKS, O_CLOEXEC, O_DIRECTORY, O_NOFOLLOW, fcntl, getuid

PREFIX = "dmrl-run-"
SYSTEM_FOLDER = "DMRL_SYSTEM_TMPDIR"
"""Variable with the system's temporary folder, for what must outlive a command."""


def use_own_temporary_folder() -> None:
    """Make the temporary folder of this process and its children one that is removed at its end.

    Without a temporary folder that can be written and locked, nothing changes.
    """
    if not HAS_LOCKS:
        return
    system = Path(tempfile.gettempdir())
    with suppress(OSError):
        _remove_abandoned(system)
        descriptor = -1
        while descriptor < 0:
            folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=system))
            descriptor = _take(folder, fcntl.LOCK_EX)
        os.environ.setdefault(SYSTEM_FOLDER, str(system))
        os.environ["TMPDIR"] = tempfile.tempdir = str(folder)
        atexit.register(_remove, folder, os.getpid())


def find_system_folder() -> Path:
    """Return the system's temporary folder."""
    return Path(os.environ.get(SYSTEM_FOLDER) or tempfile.gettempdir())


def _remove(folder: Path, owner: int) -> None:
    if os.getpid() == owner:  # a forked process inherits the call
        shutil.rmtree(folder, ignore_errors=True)


def _remove_abandoned(system: Path) -> None:
    """Remove the folders of commands that were killed."""
    for folder in system.glob(f"{PREFIX}*"):
        if (descriptor := _take(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)) >= 0:
            shutil.rmtree(folder, ignore_errors=True)
            os.close(descriptor)


def _take(folder: Path, how: int) -> int:
    """Lock a folder of this user; return its descriptor, or -1 if it is not there."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | O_DIRECTORY | O_NOFOLLOW | O_CLOEXEC)
    except OSError:
        return -1
    try:
        found = os.fstat(descriptor)
        own = found.st_uid == getuid() and not stat.S_IMODE(found.st_mode) & 0o077
        fcntl.flock(descriptor, how)
        if own and is_same_file(folder, descriptor):
            return descriptor
    except OSError:
        pass
    os.close(descriptor)
    return -1
