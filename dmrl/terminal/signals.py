"""Ctrl-C, SIGTERM and SIGHUP as an event that a loop checks.

An exception could come at any line, do harm there, or be lost.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

TERMINATION_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def set_on_signal(ended: threading.Event) -> Iterator[None]:
    """Set an event on these signals, as long as the block lasts.

    An exception within a write would damage the file, and Python drops one in a destructor.

    Parameters
    ----------
    ended
        Event that the block checks often.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ignores_hangup = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN  # nohup
    before = {
        number: signal.signal(number, lambda *_: ended.set())
        for number in TERMINATION_SIGNALS
        if not (ignores_hangup and number is signal.SIGHUP)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
