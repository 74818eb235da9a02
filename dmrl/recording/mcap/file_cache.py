"""Cache the parsed parts of the latest files in memory, as long as the files stay the same."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from dmrl.recording.mcap.file import BoundedReader, FileIdentity, identify_file

CACHED_AGE_MIN_NS, CACHE_ENTRIES_MAX = 1_000_000_000, 12
"""Age from which the time stamp of a file is trusted, nanoseconds; and entries of the cache."""
_CACHE: dict[tuple[Path, str], tuple[FileIdentity, Any]] = {}
Made = TypeVar("Made")


def get_cached(kind: str, stream: BoundedReader, make: Callable[[], Made]) -> Made:
    """Return the result for a file from the cache, or make it with ``make``.

    A result is valid while inode, size and modification time are the same. Local files that are
    less than a second old are not cached: a later write might leave the same time stamp.
    """
    status = stream.status
    stamp = identify_file(stream)
    key = stream.path, kind
    if key in _CACHE and _CACHE[key][0] == stamp:
        cached: Made = _CACHE[key][1]
        return cached
    cached = make()
    # Files in a bucket are identified by a tag of their content, so their age does not matter.
    if stream.remote_stream is not None or time.time_ns() - status.st_mtime_ns > CACHED_AGE_MIN_NS:
        while len(_CACHE) >= CACHE_ENTRIES_MAX:
            del _CACHE[next(iter(_CACHE))]
        _CACHE[key] = stamp, cached
    return cached
