"""Threads that run until they are stopped."""

import threading
from collections.abc import Sequence


class StoppableThread(threading.Thread):
    """Thread that runs until it is stopped, or its process ends."""

    def __init__(self, name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._stop_wanted = threading.Event()

    def stop(self) -> None:
        """Request the thread to end; `join` waits for it."""
        self._stop_wanted.set()


def stop_all(threads: Sequence[StoppableThread]) -> None:
    """Stop all threads, then wait for each: they end at the same time."""
    for thread in threads:
        thread.stop()
    for thread in threads:
        if thread.is_alive():
            thread.join(timeout=10.0)
