"""Pictures worked on before they are needed, in threads: decoding lets other threads run."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")


def ahead(
    function: Callable[[Item], Made], items: Iterable[Item], threads: int, *, held: int = 8
) -> Iterator[Made]:
    """``function`` of every item, in their order, computed in threads before it is asked for.

    Parameters
    ----------
    function
        Of one item. What it raises is raised when its turn has come.
    items
        Taken one by one, in the caller's thread.
    threads
        How many.
    held
        Results of a thread that wait to be taken, at most: what bounds the memory.
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
