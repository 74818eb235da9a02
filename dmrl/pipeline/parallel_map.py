"""A parallel map: one function over many items, in processes.

For arrays in and out. Stages on many recordings are jobs with names of files, see
`dmrl.pipeline.process_pool`.
"""

import multiprocessing
import os
import threading
import traceback
from collections.abc import Callable, Generator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from dmrl.errors import SettingError
from dmrl.pipeline.process_pool import ONE_THREAD
from dmrl.terminal.signals import block_ctrl_c

Item = TypeVar("Item")
Made = TypeVar("Made")
ITEMS_AHEAD = 2
"""Items per process that may start before the first result is taken."""


def parallel_map(
    function: Callable[[Item], Made], items: Sequence[Item], workers: int
) -> Generator[Made]:
    """Yield ``function`` of every item, in order; ends its processes when it is closed early.

    Each process has a pipe of its own, so a process that is killed within a result closes it. A
    ``ProcessPoolExecutor`` would wait for the rest of the result forever.

    Parameters
    ----------
    function
        Function of a module, or a ``partial`` of one: new processes find it by its name.
    items
        Items that can be pickled.
    workers
        Most processes. 1: no process is started.

    Raises
    ------
    SettingError
        If a process was killed, for lack of memory perhaps.
    """
    workers = min(workers, len(items))
    if workers <= 1:
        yield from map(function, items)
        return
    crew: dict[Connection, BaseProcess] = {}
    try:
        for _ in range(workers):
            _start_worker(function, crew)
        yield from _iter_in_order(items, list(crew))
    finally:
        for process in crew.values():
            process.terminate()
        for pipe, process in crew.items():
            process.join()
            pipe.close()


def _start_worker(function: Callable[[Item], Made], crew: dict[Connection, BaseProcess]) -> None:
    context = multiprocessing.get_context("spawn")  # a fork would copy threads half-way
    here, there = context.Pipe()
    process = context.Process(target=_run_worker, args=(there,), daemon=True)
    with block_ctrl_c():
        process.start()
    crew[here] = process
    there.close()
    here.send(function)  # its imports run after the process is limited to one core


def _iter_in_order(items: Sequence[Any], idle: list[Connection]) -> Generator[Any]:
    """Yield results in order; processes take an item each, not far ahead of the consumer."""
    most, begun = ITEMS_AHEAD * len(idle), 0
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
                    "a process ended, for lack of memory perhaps. Try fewer --workers"
                ) from None
        good, made = answers.pop(k)
        if not good:
            raise made
        yield made


def _run_worker(pipe: Connection) -> None:
    """Run items in a new process: on one core, no longer than its parent lives."""
    os.environ.update(ONE_THREAD)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    function = pipe.recv()
    while True:
        item = pipe.recv()
        try:
            answer: tuple[bool, Any] = True, function(item)
        except Exception as error:  # raised in the caller, at this item's turn
            error.add_note(traceback.format_exc())
            answer = False, error
        pipe.send(answer)


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)
