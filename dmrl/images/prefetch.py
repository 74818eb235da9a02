"""Prefetching of results in threads. Image decoding releases the GIL."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Output = TypeVar("Output")


def map_ahead(
    function: Callable[[Item], Output], items: Iterable[Item], threads: int, *, max_waiting: int = 8
) -> Iterator[Output]:
    """Yield ``function`` of every item, in their order, computed ahead in threads.

    Parameters
    ----------
    function
        Function of one item. Its exceptions are raised in the order of the items.
    items
        Read one by one, in the caller's thread.
    threads
        Number of threads.
    max_waiting
        Results waiting per thread, at most. Bounds the memory.
    """
    waiting: deque[Future[Output]] = deque()
    pool = ThreadPoolExecutor(threads)
    try:
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) > threads * max_waiting:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
