"""What a foreign file may take while a library reads it, held by the system itself.

Sizes that a file states can be false, and libraries believe them. Where dmrl does not unpack by
its own hands, the system refuses what goes beyond the budget.
"""

import re
import resource
from contextlib import suppress
from pathlib import Path

from dmrl.guards import limits

_HELD = re.compile(r"VmData:\s*(\d+) kB")


class Bounded:
    """Blocks in which this process gets no more memory than ``size`` bytes of a file explain.

    Mapped files do not count. Nor can a file be written that is larger, as by a library that
    unpacks into the temporary folder. All threads are held, so blocks should only parse. Where the
    system does not tell what a process holds (macOS) memory is not bounded.

    Parameters
    ----------
    size
        Of the file, bytes.

    Raises
    ------
    MemoryError, OSError
        From the block, or what the library in it makes of it.
    """

    def __init__(self, size: int) -> None:
        most = limits.memory_bytes(size)
        self._bounds = {resource.RLIMIT_FSIZE: most}
        with suppress(OSError):
            if found := _HELD.search(Path("/proc/self/status").read_text(encoding="ascii")):
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


def size_of(path: Path) -> int:
    """Bytes of a file, or of the files in a folder and its folders.

    Raises
    ------
    OSError
        If it is not there.
    """
    if not path.is_dir():
        return path.stat().st_size
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
