"""Files and folders that one process takes for itself, by a lock that dies with it."""

import errno
import fcntl
import os
import time
from contextlib import suppress
from pathlib import Path

from dmrl.errors import BusyOutput, OutputError

PATIENCE_S = 0.25
"""How long a lock is waited for: another process may just be looking whether it is held."""
UNSUPPORTED = (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS, errno.ENOLCK, errno.EBADF)
"""What a file system says that knows no locks, or cannot sync a folder."""


def refuse_locked(path: Path) -> None:
    """Nothing, if no living process has taken ``path``.

    Raises
    ------
    OutputError
        If one has.
    """
    with suppress(OSError):  # nothing there, or nothing that could be locked
        held = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            _lock(held, path)
        finally:
            os.close(held)


def take_file(partial: Path) -> int:
    """Descriptor of a new file that is locked by this process."""
    while True:
        try:
            held = os.open(partial, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            _remove_left_over(partial)
            continue
        try:
            if _locked_still(held, partial):
                return held
        except KeyboardInterrupt:
            partial.unlink(missing_ok=True)
            raise


def take_folder(partial: Path) -> int:
    """Descriptor of a folder, new or left over, that is locked by this process."""
    while True:
        with suppress(FileExistsError):
            partial.mkdir()
        try:
            held = os.open(partial, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        except FileNotFoundError:
            continue  # finished by another process just now
        except NotADirectoryError:
            raise OutputError(f"{partial} is in the way, and no folder. Remove it") from None
        except OSError:
            with suppress(OSError):
                partial.rmdir()  # if it is ours it is empty
            raise
        if _locked_still(held, partial):
            return held


def _locked_still(held: int, partial: Path) -> bool:
    """Whether the lock is ours and on what has the name; else the descriptor is closed."""
    try:
        _lock(held, partial)
    except BaseException:
        os.close(held)
        raise
    if is_held(partial, held):
        return True
    os.close(held)
    return False


def _remove_left_over(partial: Path) -> None:
    """Remove what a killed process left. Not emptied: it may have got another name since."""
    try:
        held = os.open(partial, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        return
    except OSError as e:
        if e.errno == errno.ELOOP:
            raise OutputError(f"{partial} is in the way, a symbolic link. Remove it") from None
        raise
    if _locked_still(held, partial):
        try:
            if partial.is_dir():
                raise OutputError(f"{partial} is in the way, a folder. Remove it")
            partial.unlink()
        finally:
            os.close(held)


def _lock(held: int, partial: Path) -> None:
    """Lock an open file or folder until it is closed or this process dies.

    A file system without locks lets everybody through; see docs/reliability.md.
    """
    until = time.monotonic() + PATIENCE_S
    while True:
        try:
            return fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > until:
                raise _busy(held, partial) from None
            time.sleep(PATIENCE_S / 10)
        except OSError as e:
            if e.errno not in UNSUPPORTED:
                raise
            return None


def _busy(held: int, partial: Path) -> BusyOutput:
    owner = _owner(held)
    number = "" if owner is None else f", process {owner}"
    return BusyOutput(
        f"{partial.with_suffix('')} is being written by another dmrl{number}. Name another output"
    )


def _owner(held: int) -> int | None:
    """Number of the process that holds the lock, where the system tells."""
    found = os.fstat(held)
    device = f"{os.major(found.st_dev):02x}:{os.minor(found.st_dev):02x}"
    place = f"{device}:{found.st_ino}"
    with suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/locks").read_text(encoding="ascii").splitlines():
            words = line.split()
            if words[1] == "FLOCK" and words[5] == place:
                return int(words[4])
    return None


def is_held(path: Path, held: int) -> bool:
    """Whether the name is that of the open file or folder."""
    try:
        return os.path.samestat(os.lstat(path), os.fstat(held))
    except OSError:
        return False
