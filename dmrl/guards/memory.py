"""Limit the memory that a library uses to read an untrusted file.

Sizes that a file states can be false, and libraries allocate them. Where dmrl does not decompress
itself, the operating system enforces the limit.
"""

import ctypes
import re
from contextlib import suppress
from pathlib import Path

from dmrl.guards import limits
from dmrl.guards.posix import resource

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's ``mallopt``, from malloc.h."""
_VM_DATA = re.compile(r"VmData:\s*(\d+) kB")


class MemoryLimit:
    """Limit the memory of this process within a block, by the size of the file that is read.

    Mapped files do not count. Written files have the same limit, as a library may unpack into the
    temporary folder. The limit applies to all threads, so blocks should only parse. On systems
    that do not report the memory of a process (macOS) it is not limited.

    Parameters
    ----------
    size
        Size of the file, bytes.

    Raises
    ------
    MemoryError, OSError
        From the block, or another error that the library turns them into.
    """

    def __init__(self, size: int) -> None:
        most = limits.max_memory_bytes(size)
        self._bounds = {resource.RLIMIT_FSIZE: most}
        with suppress(OSError):
            if found := _VM_DATA.search(Path("/proc/self/status").read_text(encoding="ascii")):
                self._bounds[resource.RLIMIT_DATA] = most + 1024 * int(found[1])
        self._before = {kind: resource.getrlimit(kind) for kind in self._bounds}

    def __enter__(self) -> None:
        for kind, most in self._bounds.items():
            soft, hard = self._before[kind]
            known = [b for b in (soft, hard, most) if b != resource.RLIM_INFINITY]
            resource.setrlimit(kind, (min(known), hard))

    def __exit__(self, *_: object) -> None:
        for kind, before in self._before.items():
            resource.setrlimit(kind, before)


def return_large_blocks() -> None:
    """Let the C library give blocks of 4 MB and more back to the system when they are freed.

    It would keep blocks of up to 32 MB, and 4K images in several threads then take 240 MB more.
    """
    _set_allocator(M_MMAP_THRESHOLD, 4 << 20)


def keep_freed_memory(most_bytes: int) -> None:
    """Let the C library keep up to so many bytes that are freed from now on.

    Memory that was freed before goes back to the system. Otherwise the library returns large
    arrays, and each new one faults in its pages again: a third of the time of linear algebra on
    arrays of megabytes, 4 to 8 % of a training step.
    """
    return_freed_memory()
    _set_allocator(M_TRIM_THRESHOLD, most_bytes)
    _set_allocator(M_MMAP_THRESHOLD, most_bytes)


def return_freed_memory() -> None:
    """Give freed memory back to the system: decoding leaves many small blocks among others."""
    with suppress(AttributeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


def _set_allocator(parameter: int, value: int) -> None:
    with suppress(AttributeError):  # another C library
        ctypes.CDLL(None).mallopt(parameter, value)


def measure_size(path: Path) -> int:
    """Return the size of a file, or of all files in a folder, bytes.

    Raises
    ------
    OSError
        If it does not exist.
    """
    if not path.is_dir():
        return path.stat().st_size
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
