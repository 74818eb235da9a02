"""One function of many things, in processes: for a stage whose own work is many alike parts.

Stages on many recordings are jobs with names of files in and out, see `dmrl.pipeline.process_pool`. Here
arrays go in and come out.
"""

import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from dmrl.errors import SettingError
from dmrl.pipeline.process_pool import ONE_THREAD

Item = TypeVar("Item")
Made = TypeVar("Made")
AHEAD = 2
"""Items for each process that may be begun before the first of them is taken."""


def spread(
    function: Callable[[Item], Made], items: Sequence[Item], workers: int
) -> Generator[Made]:
    """``function`` of every item, in their order; closed early, it ends its processes.

    Each process has a pipe of its own, whose other end nobody else holds: one that is killed
    within an answer closes it. A ``ProcessPoolExecutor`` waits for the rest of the answer for ever.

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
    crew: dict[Connection, BaseProcess] = {}
    try:
        for _ in range(workers):
            _begin(function, crew)
        yield from _in_order(items, list(crew))
    finally:
        for process in crew.values():
            process.terminate()
        for pipe, process in crew.items():
            process.join()
            pipe.close()


def _begin(function: Callable[[Item], Made], crew: dict[Connection, BaseProcess]) -> None:
    context = multiprocessing.get_context("spawn")  # a fork would copy threads half-way
    here, there = context.Pipe()
    process = context.Process(target=_work, args=(there,), daemon=True)
    process.start()
    crew[here] = process
    there.close()
    here.send(function)  # what it needs is loaded once the process has its one core


def _in_order(items: Sequence[Any], idle: list[Connection]) -> Generator[Any]:
    """What processes make of the items; an item each, and not far ahead of who takes them."""
    most, begun = AHEAD * len(idle), 0
    busy: dict[Connection, int] = {}
    answers: dict[int, tuple[bool, Any]] = {}
    for k in range(len(items)):
        while k not in answers:
            try:
                while idle and begun < min(k + most, len(items)):
                    idle[-1].send(items[begun])
                    busy[idle.pop()] = begun
                    begun += 1
                for pipe in wait(list(busy)):
                    assert isinstance(pipe, Connection)
                    answers[busy[pipe]] = pipe.recv()
                    idle.append(pipe)
                    del busy[pipe]
            except (EOFError, ConnectionError):
                raise SettingError(
                    "a process that was at work is gone, for want of memory perhaps. "
                    "Try fewer --workers"
                ) from None
        good, made = answers.pop(k)
        if not good:
            raise made
        yield made


def _work(pipe: Connection) -> None:
    """In a new process, before NumPy is loaded: one core, and no longer than its parent."""
    os.environ.update(ONE_THREAD)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the parent ends us
    threading.Thread(target=_end_with_parent, daemon=True).start()
    function = pipe.recv()
    while True:
        item = pipe.recv()
        try:
            answer: tuple[bool, Any] = True, function(item)
        except Exception as error:  # the caller's own, when its turn comes
            error.add_note(traceback.format_exc())
            answer = False, error
        pipe.send(answer)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)
