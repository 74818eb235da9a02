"""Exit of a command: every error becomes one line on standard error and an exit status.

=========================  ======  ==========================================================
event                      status  line
=========================  ======  ==========================================================
an error of the user's     1       the error, with the way out
a refusal of the system    1       the file and the system's words
a bug of dmrl              1       the error, and the file that holds its traceback
a bad command line         2       what is wrong with it
SIGINT, as by Ctrl-C       130     what stands under its final name
SIGTERM                    143     the same
SIGHUP                     129     the same, if anybody still listens
=========================  ======  ==========================================================

With ``DMRL_DEBUG`` set, errors that are not the user's keep their traceback.
"""

import _thread
import io
import os
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FrameType

from dmrl import atomic_output
from dmrl.errors import DmrlError, SettingError, describe_error, to_one_line
from dmrl.guards.safe_names import truncate_middle
from dmrl.guards.temporary_folder import find_system_folder
from dmrl.terminal.signals import NOTHING_WRITTEN, TERMINATION_SIGNALS, handle_signals, is_importing

RETRY_S = 0.02
"""Time between two looks whether an import has ended, seconds."""


class Interrupted(KeyboardInterrupt):
    """A signal asks for the end of the command."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def open_standard_streams() -> None:
    """Open streams 0, 1 and 2 if they are closed: the next file would get their numbers.

    A closed standard output then refuses writes, as a full disk does.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR if number == 2 else os.O_RDONLY)  # takes the lowest
    if sys.stdout is None:
        sys.stdout = io.TextIOWrapper(io.FileIO(1, "w"), encoding="utf-8")
    if sys.stderr is None:
        sys.stderr = io.TextIOWrapper(io.FileIO(2, "w"), encoding="utf-8", line_buffering=True)


def install_signal_handlers() -> None:
    """Install handlers of the termination signals: one ends in order, a second one at once.

    An exception inside an import would be turned into another error. A signal there ends the
    process at once if nothing was written so far; else it waits until the import has ended.
    """

    def stop(number: int, frame: FrameType | None) -> None:
        if is_importing(frame):
            if not atomic_output.has_begun():
                _print_error(NOTHING_WRITTEN)
                os._exit(128 + number)
            again = threading.Timer(RETRY_S, _thread.interrupt_main, [number])
            again.daemon = True
            again.start()
            return
        for ending in TERMINATION_SIGNALS:
            signal.signal(ending, signal.SIG_DFL)
        raise Interrupted(number)

    handle_signals(stop)


def run_to_status(work: Callable[[], object]) -> int:
    """Run a command, flush its output, and return the exit status."""
    status = _run_guarded(work)
    try:
        sys.stdout.flush()
    except OSError as e:
        # The interpreter would try once more, and say so with a traceback.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        if not status and not isinstance(e, BrokenPipeError):
            return _print_error(describe_error(e) or _report_bug(e))
        return status or 1
    return status


def _run_guarded(work: Callable[[], object]) -> int:
    try:
        _refuse_removed_folder()
        work()
    except SystemExit as e:
        return e.code if isinstance(e.code, int) else int(e.code is not None)
    except DmrlError as e:
        return _print_error(str(e))
    except KeyboardInterrupt as e:
        return _print_error(describe_interrupt(), 128 + getattr(e, "number", signal.SIGINT))
    except BrokenPipeError:
        return 1  # the reader of our output, such as `head`, closed the pipe
    except Exception as e:
        if os.environ.get("DMRL_DEBUG"):
            raise
        return _print_error(describe_error(e) or _report_bug(e))
    return 0


def _refuse_removed_folder() -> None:
    """Raise SettingError if the current folder was removed: libraries would abort."""
    try:
        Path.cwd()
    except FileNotFoundError:
        raise SettingError("the folder you are in was removed. Go to another: cd") from None


def _print_error(text: str, status: int = 1) -> int:
    with suppress(OSError):
        sys.stderr.write(f"dmrl: {truncate_middle(to_one_line(text))}\n")
    return status


def describe_interrupt() -> str:
    """Return the line about an interrupt: which outputs are complete."""
    try:
        whole = atomic_output.list_finished_outputs()
    except (DmrlError, OSError) as e:  # outputs may lie where nobody answers any more
        return f"stopped. What has its final name is not known: {e}"
    if whole:
        return f"stopped. Whole: {', '.join(map(str, whole))}; no other new output has its name"
    return NOTHING_WRITTEN


def _report_bug(error: Exception) -> str:
    """Return the line for an unexpected error, and write its traceback to a file."""
    kind = f"{type(error).__name__}: {str(error)[:200]}".rstrip(": ")
    text = "".join(traceback.format_exception(error))
    try:
        folder = find_system_folder()
        held, path = tempfile.mkstemp(prefix="dmrl-error-", suffix=".txt", dir=folder)
        with os.fdopen(held, "w", encoding="utf-8", errors="backslashreplace") as stream:
            stream.write(f"dmrl {' '.join(sys.argv[1:])}\n\n{text}")
    except OSError:
        return f"internal error, {kind}. Run it again with DMRL_DEBUG=1 and report what it prints"
    return f"internal error, {kind}. Please report it with its traceback, which is in {path}"
