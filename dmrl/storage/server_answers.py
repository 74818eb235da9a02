"""Read answers of servers, which are not trusted: only the requested bytes, within a time limit."""

import asyncio
import re
from typing import Any

from aiohttp import ClientTimeout

from dmrl.errors import StorageError

PATIENCE_S, SLOWEST_BPS = 30.0, 50_000
"""Timeout of an answer: a fixed part, seconds, and a minimum rate, bytes per second."""
CONTENT_RANGE = re.compile(r"bytes (\d+)-(\d+)/(?:\d+|\*)")


async def read_up_to(stream: Any, size: int, url: str) -> bytes:
    """Read ``size`` bytes of an answer, or all if there are fewer.

    Raises
    ------
    StorageError
        If the server is too slow.
    """
    parts, left = [], size
    try:
        async with asyncio.timeout(compute_patience_s(size)):
            while left and (data := await stream.read(left)):
                parts.append(data)
                left -= len(data)
    except TimeoutError:
        raise slow_server_error(url) from None
    return b"".join(parts)


async def read_range(stream: Any, content_range: str, start: int, end: int, url: str) -> bytes:
    """Return the bytes from ``start`` to ``end``, as the answer to a request for them.

    Raises
    ------
    StorageError
        If the server sends another range, or is too slow.
    """
    found = CONTENT_RANGE.fullmatch(content_range)
    data = await read_up_to(stream, end - start, url)
    if not found or int(found[1]) != start or len(data) != end - start:
        raise wrong_bytes_error(url)
    return data


def compute_patience_s(size: int) -> float:
    """Return the time for an answer of this size, seconds."""
    return PATIENCE_S + size / SLOWEST_BPS


def build_timeout(size: int) -> ClientTimeout:
    """Return the timeout of an answer of this size."""
    return ClientTimeout(total=compute_patience_s(size))


def slow_server_error(url: str) -> StorageError:
    """Return the error for an answer that does not end in time."""
    return StorageError(f"{url}: the server is too slow. Try later, or copy the file")


def wrong_bytes_error(url: str) -> StorageError:
    """Return the error for an answer of other bytes."""
    return StorageError(
        f"{url}: the server sent other bytes than requested. Copy the file, and check it"
    )


def changed_error(url: str) -> StorageError:
    """Return the error for a file that was replaced between two reads."""
    return StorageError(f"{url} changed while it was read. Run it again")
