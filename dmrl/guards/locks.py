"""Lock files and folders for one process, with locks that end with the process."""

import errno
import os
import time
from contextlib import suppress
from pathlib import Path

from dmrl.errors import BusyOutput, OutputError
from dmrl.guards.posix import O_DIRECTORY, O_NOFOLLOW, O_NONBLOCK, fcntl

LOCK_WAIT_S = 0.25
"""Time to wait for a lock. Another process may be testing it at this moment."""
UNSUPPORTED_ERRNOS = (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS, errno.ENOLCK, errno.EBADF)
"""Error numbers of file systems without locks, or that cannot sync a folder."""


def refuse_locked(path: Path) -> None:
    """Raise OutputError if a living process has locked ``path``."""
    with suppress(OSError):  # nothing exists, or it cannot be locked
        descriptor = os.open(path, os.O_RDONLY | O_NOFOLLOW | O_NONBLOCK)
        try:
            _lock(descriptor, path)
        finally:
            os.close(descriptor)


def take_file(partial: Path) -> int:
    """Create a file locked by this process, and return its descriptor."""
    while True:
        try:
            descriptor = os.open(partial, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            _remove_left_over(partial)
            continue
        try:
            if _lock_if_same(descriptor, partial):
                return descriptor
        except KeyboardInterrupt:
            partial.unlink(missing_ok=True)
            raise


def take_folder(partial: Path) -> int:
    """Lock a folder, new or left over, and return its descriptor."""
    while True:
        with suppress(FileExistsError):
            partial.mkdir()
        try:
            descriptor = os.open(partial, os.O_RDONLY | O_DIRECTORY | O_NOFOLLOW)
        except FileNotFoundError:
            continue  # finished by another process just now
        except NotADirectoryError:
            raise OutputError(f"{partial} exists and is not a folder. Remove it") from None
        except OSError:
            with suppress(OSError):
                partial.rmdir()  # a folder that was just created is empty
            raise
        if _lock_if_same(descriptor, partial):
            return descriptor


def _lock_if_same(descriptor: int, partial: Path) -> bool:
    """Lock the descriptor; return whether it still has the name, else close it."""
    try:
        _lock(descriptor, partial)
    except BaseException:
        os.close(descriptor)
        raise
    if is_same_file(partial, descriptor):
        return True
    os.close(descriptor)
    return False


def _remove_left_over(partial: Path) -> None:
    """Remove a file of a killed process. It is not emptied: it may have another name by now."""
    try:
        descriptor = os.open(partial, os.O_RDONLY | O_NOFOLLOW | O_NONBLOCK)
    except FileNotFoundError:
        return
    except OSError as e:
        if e.errno == errno.ELOOP:
            raise OutputError(f"{partial} exists and is a symbolic link. Remove it") from None
        raise
    if _lock_if_same(descriptor, partial):
        try:
            if partial.is_dir():
                raise OutputError(f"{partial} exists and is a folder. Remove it")
            partial.unlink()
        finally:
            os.close(descriptor)


def _lock(descriptor: int, partial: Path) -> None:
    """Lock an open file or folder until it is closed or this process ends.

    On a file system without locks this always succeeds; see docs/reliability.md.
    """
    until = time.monotonic() + LOCK_WAIT_S
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() > until:
                raise _busy_error(descriptor, partial) from None
            time.sleep(LOCK_WAIT_S / 10)
        except OSError as e:
            if e.errno not in UNSUPPORTED_ERRNOS:
                raise
            return


def _busy_error(descriptor: int, partial: Path) -> BusyOutput:
    owner = _find_owner(descriptor)
    number = "" if owner is None else f", process {owner}"
    return BusyOutput(
        f"{partial.with_suffix('')} is being written by another dmrl{number}. Name another output"
    )


def _find_owner(descriptor: int) -> int | None:
    """Return the id of the process with the lock, if the system lists it."""
    found = os.fstat(descriptor)
    device = f"{os.major(found.st_dev):02x}:{os.minor(found.st_dev):02x}"
    place = f"{device}:{found.st_ino}"
    with suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/locks").read_text(encoding="ascii").splitlines():
            words = line.split()
            if words[1] == "FLOCK" and words[5] == place:
                return int(words[4])
    return None


def is_same_file(path: Path, descriptor: int) -> bool:
    """Return whether the path is that of the open file or folder."""
    try:
        return os.path.samestat(os.lstat(path), os.fstat(descriptor))
    except OSError:
        return False
