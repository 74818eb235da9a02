"""Ctrl-C, SIGTERM and SIGHUP as an event that a loop asks for.

Not as an exception: that comes at any line, where it can do harm or be lost.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def ended_by_signal(ended: threading.Event) -> Iterator[None]:
    """Set when the user wants an end, as long as the block lasts.

    An exception amid a write would spoil the file, and one in a destructor Python drops.

    Parameters
    ----------
    ended
        Looked at often by what the block does.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    deaf = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN  # nohup
    before = {
        number: signal.signal(number, lambda *_: ended.set())
        for number in ENDING
        if not (deaf and number is signal.SIGHUP)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
