"""Files that are mapped into memory, and must not be cut while they are.

A read beyond the end of a file that was cut ends the process with SIGBUS and no word. Readers
therefore ask for the size before they read. If the file is cut during a read, the signal's handler
prints the line.
"""

import ctypes
import os
import signal
import sys
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path

from dmrl.errors import DatasetError


class MappedFile:
    """A file with the size that it had when it was mapped.

    Parameters
    ----------
    path
        The file.

    Raises
    ------
    OSError
        If it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        found = path.stat()
        self._file, self._size = (found.st_dev, found.st_ino), found.st_size
        _MAPPED[path] = self
        _install_handler()

    def is_cut(self) -> bool:
        """Return whether the file is shorter than when it was mapped; another file is not."""
        try:
            found = self.path.stat()
        except OSError:
            return False  # it was removed: the mapping keeps its content
        return (found.st_dev, found.st_ino) == self._file and found.st_size < self._size


_MAPPED: dict[Path, MappedFile] = {}
"""Files of this process; views of a mapping may outlive the dataset that they came from."""
CUT = "shard {} was cut short while it was read. Make the dataset again, or copy it whole"


def require_whole(files: Iterable[MappedFile]) -> None:
    """Raise DatasetError if a file was cut after it was mapped."""
    for file in files:
        if file.is_cut():
            raise DatasetError(CUT.format(file.path))


@cache
def _install_handler() -> object:
    """Install the handler of SIGBUS; Python's own would run only after the read, hence never."""
    if not hasattr(signal, "SIGBUS"):
        return None
    handler = ctypes.CFUNCTYPE(None, ctypes.c_int)(_report_and_exit)
    with suppress(AttributeError, OSError):
        library = ctypes.CDLL(None)
        library.signal.restype, library.signal.argtypes = (
            ctypes.c_void_p,
            [ctypes.c_int, handler.__class__],
        )
        library.signal(signal.SIGBUS, handler)
    return handler  # the cache keeps it alive


def _report_and_exit(number: int) -> None:
    for file in list(_MAPPED.values()):
        if file.is_cut():
            os.write(2, f"dmrl: {CUT.format(file.path)}\n".encode())
            os._exit(1)
    sys.stderr.flush()
    signal.signal(number, signal.SIG_DFL)  # the read is repeated and ends the process
