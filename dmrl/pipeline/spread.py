"""One function of many things, in processes: for a stage whose own work is many alike parts.

Stages on many recordings are jobs with names of files in and out, see `dmrl.pipeline.crew`. Here
arrays go in and come out.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from typing import TypeVar

from dmrl.errors import SettingError
from dmrl.pipeline.crew import ONE_THREAD

Item = TypeVar("Item")
Made = TypeVar("Made")


def spread(
    function: Callable[[Item], Made], items: Sequence[Item], workers: int
) -> Generator[Made]:
    """``function`` of every item, in their order; closed early, it ends its processes.

    Parameters
    ----------
    function
        That a module names, or a ``partial`` of one: new processes find it by its name.
    items
        What can be pickled.
    workers
        Processes, at most. 1: none, it is done here.

    Raises
    ------
    SettingError
        If a process was killed, as a system that is short of memory does.
    """
    workers = min(workers, len(items))
    if workers <= 1:
        yield from map(function, items)
        return
    context = multiprocessing.get_context("spawn")  # a fork would copy threads half-way
    before = multiprocessing.active_children()
    pool = ProcessPoolExecutor(workers, context, _begin)
    done = False
    try:
        yield from pool.map(function, items)
        done = True
    except BrokenProcessPool:
        raise SettingError(
            "a process that was at work is gone, for want of memory perhaps. Try fewer --workers"
        ) from None
    finally:
        if not done:  # nobody wants what they work on: shutting down would wait for it
            for process in set(multiprocessing.active_children()) - set(before):
                process.terminate()
        pool.shutdown(cancel_futures=True)


def _begin() -> None:
    """In a new process, before NumPy is loaded: one core, and no longer than its parent."""
    os.environ.update(ONE_THREAD)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the parent ends us
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)
