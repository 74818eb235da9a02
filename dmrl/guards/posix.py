"""Locks, limits and flags that only POSIX systems have, with stand-ins for other systems.

Where locks are missing, locking fails as on a file system without locks: two processes can then
write one output. Where limits are missing, none is set.
"""

import errno
import os
from types import SimpleNamespace
from typing import Any

fcntl: Any
resource: Any


def _refuse_lock(*_: object) -> None:
    raise OSError(errno.ENOSYS, "this system has no locks of files")


try:
    import fcntl

    HAS_LOCKS = True
except ImportError:
    HAS_LOCKS = False
    fcntl = SimpleNamespace(flock=_refuse_lock, LOCK_EX=0, LOCK_SH=0, LOCK_NB=0, LOCK_UN=0)
try:
    import resource
except ImportError:
    resource = SimpleNamespace(
        RLIMIT_AS=0,
        RLIMIT_CORE=5,
        RLIMIT_CPU=1,
        RLIMIT_DATA=2,
        RLIMIT_FSIZE=3,
        RLIMIT_NOFILE=4,
        RLIM_INFINITY=-1,
        getrlimit=lambda _: (-1, -1),
        setrlimit=lambda *_: None,
    )
O_CLOEXEC, O_DIRECTORY, O_NOFOLLOW, O_NONBLOCK = (
    getattr(os, name, 0) for name in ("O_CLOEXEC", "O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK")
)


def getuid() -> int:
    """Return the number of the user; 0, which owns all files, where users have none."""
    return int(getattr(os, "getuid", int)())


def count_cores() -> int:
    """Return the number of cores that this process may use; all cores on macOS and Windows."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
