"""Ctrl-C, SIGTERM and SIGHUP: end at once, or set an event that a loop checks.

An exception could come at any line, do harm there, or be lost.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

TERMINATION_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Signals that end a command. Windows has no SIGHUP."""
NOTHING_WRITTEN = "stopped. No new output has its final name; earlier ones are unchanged"

Handler = Callable[[int, FrameType | None], None]


def handle_signals(handler: Handler) -> None:
    """Install a handler of all termination signals, but those that the parent ignores (nohup)."""
    for number in TERMINATION_SIGNALS:
        if not _is_ignored(number):
            signal.signal(number, handler)


def _is_ignored(number: signal.Signals) -> bool:
    return signal.getsignal(number) is signal.SIG_IGN


def end_on_signal(describe: Callable[[], str] = lambda: NOTHING_WRITTEN) -> None:
    """End the process at once when a signal comes, with one line and its exit status.

    For times when an exception would be lost or turned into another: while modules are imported,
    and after the work.
    """

    def end(number: int, _: FrameType | None) -> None:
        os.write(2, f"dmrl: {describe()}\n".encode(errors="backslashreplace"))
        os._exit(128 + number)

    handle_signals(end)


def is_importing(frame: FrameType | None) -> bool:
    """Return whether a frame runs inside an import."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


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
    heard = [n for n in TERMINATION_SIGNALS if n is signal.SIGINT or not _is_ignored(n)]
    before = {number: signal.signal(number, lambda *_: ended.set()) for number in heard}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def block_ctrl_c() -> Iterator[None]:
    """Hold Ctrl-C back until the block ends; processes started in it never hear it.

    A terminal sends it to all of them, and Python prints a traceback where it comes before any code
    of ours runs. The process that starts them hears it, and ends them.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker  # noqa: PLC0415 - every command loads this file

    resource_tracker.ensure_running()  # its start, with the first process, ends a block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
