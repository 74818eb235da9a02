"""Prefetching of results in threads. Image decoding releases the GIL."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")


def ahead(
    function: Callable[[Item], Made], items: Iterable[Item], threads: int, *, held: int = 8
) -> Iterator[Made]:
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
    waiting: deque[Future[Made]] = deque()
    pool = ThreadPoolExecutor(threads)
    try:
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) > threads * held:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
