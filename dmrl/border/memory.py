"""Memory that a foreign file may take while a library reads it, held by the system itself.

Sizes that a file states can be false, and libraries believe them. Where dmrl does not unpack by
its own hands, the system refuses what goes beyond the budget.
"""

import re
import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dmrl.border import limits

_HELD = re.compile(r"VmData:\s*(\d+) kB")


@contextmanager
def bounded(size: int) -> Iterator[None]:
    """While the block lasts, this process gets no more memory than ``size`` bytes explain.

    Mapped files do not count. Holds for all threads, so for blocks that parse and end. Without
    effect where the system does not tell what a process holds (macOS).

    Raises
    ------
    MemoryError
        From the block, or what the library in it makes of it.
    """
    found = None
    with suppress(OSError):
        found = _HELD.search(Path("/proc/self/status").read_text(encoding="ascii"))
    if found is None:
        yield
        return
    before = resource.getrlimit(resource.RLIMIT_DATA)
    most = 1024 * int(found[1]) + limits.memory_bytes(size)
    try:
        resource.setrlimit(resource.RLIMIT_DATA, (_least(most, *before), before[1]))
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _least(*bounds: int) -> int:
    return min(b for b in bounds if b != resource.RLIM_INFINITY)
