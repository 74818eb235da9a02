"""Where a command ends: every error becomes one line on standard error and an exit status.

=========================  ======  ==========================================================
what happened              status  what is said
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

import io
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FrameType

from dmrl import atomic_output
from dmrl.errors import DmrlError, SettingError, one_line, words_of
from dmrl.guards.safe_names import without_middle

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Stopped(KeyboardInterrupt):
    """The user, or the system, wants an end."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def open_standard_streams() -> None:
    """Give 0, 1 and 2 to what they are for: a closed one would be given to the next file opened.

    A closed standard output then refuses what is written to it, as a full one does.
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


def end_by_signals() -> None:
    """Let SIGINT, SIGTERM and SIGHUP end the command in order; a second one ends it at once."""

    def stop(number: int, _: FrameType | None) -> None:
        for ending in ENDING:
            signal.signal(ending, signal.SIG_DFL)
        raise Stopped(number)

    for number in ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, stop)


def status_of(work: Callable[[], object]) -> int:
    """Exit status of a command, once everything is said and written."""
    status = _guarded(work)
    try:
        sys.stdout.flush()
    except OSError as e:
        # The interpreter would try once more, and say so with a traceback.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        if not status and not isinstance(e, BrokenPipeError):
            return _end(words_of(e) or _bug(e))
        return status or 1
    return status


def _guarded(work: Callable[[], object]) -> int:
    try:
        _refuse_removed_folder()
        work()
    except SystemExit as e:
        return e.code if isinstance(e.code, int) else int(e.code is not None)
    except DmrlError as e:
        return _end(str(e))
    except KeyboardInterrupt as e:
        return _end(_stopped(), 128 + getattr(e, "number", signal.SIGINT))
    except BrokenPipeError:
        return 1  # the reader of our output, such as `head`, has gone: nobody is left to tell
    except Exception as e:
        if os.environ.get("DMRL_DEBUG"):
            raise
        return _end(words_of(e) or _bug(e))
    return 0


def _refuse_removed_folder() -> None:
    """Nothing, if the process is in a folder that is there: libraries abort where it is not."""
    try:
        Path.cwd()
    except FileNotFoundError:
        raise SettingError("the folder you are in was removed. Go to another: cd") from None


def _end(text: str, status: int = 1) -> int:
    with suppress(OSError):
        sys.stderr.write(f"dmrl: {without_middle(one_line(text))}\n")
    return status


def _stopped() -> str:
    try:
        whole = atomic_output.standing()
    except (DmrlError, OSError) as e:  # outputs may lie where nobody answers any more
        return f"stopped. What has its final name is not known: {e}"
    if whole:
        return f"stopped. Whole: {', '.join(map(str, whole))}; nothing else has its final name"
    return "stopped. Nothing stands under its final name"


def _bug(error: Exception) -> str:
    """What is said of an error that nobody foresaw; its traceback goes to a file."""
    kind = f"{type(error).__name__}: {str(error)[:200]}".rstrip(": ")
    text = "".join(traceback.format_exception(error))
    try:
        held, path = tempfile.mkstemp(prefix="dmrl-error-", suffix=".txt")
        with os.fdopen(held, "w", encoding="utf-8", errors="backslashreplace") as stream:
            stream.write(f"dmrl {' '.join(sys.argv[1:])}\n\n{text}")
    except OSError:
        return f"internal error, {kind}. Run it again with DMRL_DEBUG=1 and report what it prints"
    return f"internal error, {kind}. Please report it with its traceback, which is in {path}"
