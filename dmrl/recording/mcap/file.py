"""Open an MCAP file: check its magic bytes, and forbid reads beyond its end."""

import io
import os
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from mcap.stream_reader import CRCValidationError

from dmrl.atomic_output import count_ended_outputs
from dmrl.errors import RecordingError, suggest
from dmrl.storage import RemotePath
from dmrl.storage.remote_stream import BUFFER_BYTES
from dmrl.storage.shared_file import open_raw

MAGIC = b"\x89MCAP0\r\n"
RECORD_STRUCT = struct.Struct("<BQ")  # opcode, length
FOOTER_STRUCT = struct.Struct("<BQQQI")  # opcode, length, summary start, summary offset start, CRC
DEFINITIONS: dict[int, type[Schema] | type[Channel]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
}
CORRUPTION_ERRORS = (
    McapError,
    CRCValidationError,
    struct.error,
    OSError,
    MemoryError,
    ValueError,
    LookupError,
    OverflowError,
)
"""Errors that the mcap package raises on corrupt lengths and strings."""

MAX_NAMED = 3
"""Largest number of recordings that an error names."""
NAME_A_RECORDING = "Name a .mcap file"


class BudgetError(McapError):
    """A file exceeds a limit of `dmrl.guards.limits`. The text says how."""


class BoundedReader(io.BufferedReader):
    """A file that raises on reads beyond its end, so that a corrupt length reserves no memory.

    Attributes
    ----------
    path
        The file.
    remote_stream
        Stream of a file in a bucket; None for a local file.
    size
        Size of the file, bytes.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.remote_stream = path.open_ranges() if isinstance(path, RemotePath) else None
        if self.remote_stream is None:
            super().__init__(open_raw(path))
        else:
            super().__init__(self.remote_stream, BUFFER_BYTES)
        self.status = os.fstat(self.fileno()) if self.remote_stream is None else path.stat()
        self.size = self.seek(0, io.SEEK_END)
        self.seek(0)

    def expect_reads(self, places: Sequence[tuple[int, int]]) -> None:
        """Register the next reads, in order. A remote file then fetches many ranges at a time.

        Parameters
        ----------
        places
            Start and size of each read, bytes.
        """
        if self.remote_stream is not None:
            self.remote_stream.expect_reads(places)

    def read(self, size: int | None = -1, /) -> bytes:
        """Read exactly ``size`` bytes.

        Raises
        ------
        McapError
            If the file ends before that.
        """
        if size is not None and size > self.size - self.tell():
            raise McapError(f"a record at byte {self.tell()} runs beyond the end")
        if (
            self.remote_stream is not None
            and size
            and self.remote_stream.should_fetch(self.tell(), size)
        ):
            data = self.remote_stream.fetch(self.tell(), size)
            self.seek(len(data), io.SEEK_CUR)
            return data
        return super().read(size)


@contextmanager
def open_mcap(path: Path) -> Iterator[BoundedReader]:
    """Open a file for reading, and check that it starts and ends as an MCAP file.

    Raises
    ------
    RecordingError
        If it is absent, not MCAP or truncated, or a read in the block meets corrupt data.
    """
    if not path.is_file():
        if path.is_dir():
            raise RecordingError(f"{path} is a folder, not a recording. {name_recordings(path)}")
        if path.exists():  # opening a pipe waits for its other end
            raise RecordingError(f"{path} is not a regular file. Save it to one first")
    try:
        with BoundedReader(path) as stream:
            _refuse_changed(stream)
            _check_magic(stream)
            yield stream
    except FileNotFoundError:
        beside = {one.name: one for one in _list_recordings(path.parent)}
        raise RecordingError(
            f"no recording {path}. {suggest(path.name, beside, 'Check the name')}"
        ) from None
    except PermissionError:
        raise RecordingError(f"{path} cannot be read. Check its permissions") from None
    except BudgetError as e:
        raise over_budget_error(path, e) from e
    except CORRUPTION_ERRORS as e:
        raise corrupt_error(path, e) from e


def _list_recordings(folder: Path) -> list[Path]:
    """Return the recordings in a folder; in a bucket, none: listing it takes time."""
    return [] if isinstance(folder, RemotePath) else sorted(folder.glob("*.mcap"))


def name_recordings(folder: Path) -> str:
    """Return the way out where a folder stands in place of a recording: the first ones in it."""
    found = [str(one) for one in _list_recordings(folder)]
    more = ["..."] * (len(found) > MAX_NAMED)
    return f"Name one in it: {', '.join(found[:MAX_NAMED] + more)}" if found else NAME_A_RECORDING


FileIdentity = tuple[int, int, int]
_HASHED_INPUTS: dict[Path, tuple[int, FileIdentity]] = {}


def identify_file(stream: BoundedReader) -> FileIdentity:
    """Return what tells a file from another, or from itself after a change."""
    status = stream.status
    return status.st_ino, status.st_size, status.st_mtime_ns


def expect_unchanged(path: Path) -> None:
    """Make later opens of a recording fail if the file has changed.

    Called when its hash enters a provenance record, so that the data belong to that hash. Holds
    until this process has finished its next output.
    """
    with BoundedReader(path) as stream:
        _HASHED_INPUTS[path] = count_ended_outputs(), identify_file(stream)


def _refuse_changed(stream: BoundedReader) -> None:
    when, stamp = _HASHED_INPUTS.get(stream.path, (-1, None))
    if when == count_ended_outputs() and stamp != identify_file(stream):
        raise RecordingError(f"{stream.path} was changed while it was read. Run it again")


def corrupt_error(path: Path, cause: object) -> RecordingError:
    """Build the error for a file that starts as a recording but is corrupt."""
    return RecordingError(
        f"{path} is damaged ({cause or type(cause).__name__}). "
        f"Try: dmrl recover {path} recovered.mcap"
    )


def over_budget_error(path: Path, what: object) -> RecordingError:
    """Build the error for a file that exceeds a limit of `dmrl.guards.limits`."""
    return RecordingError(
        f"{path}: {what}, over the limit. If you trust the file, rewrite it with smaller chunks"
    )


def _check_magic(stream: BoundedReader) -> None:
    path = stream.path
    start = stream.read(min(len(MAGIC), stream.size))
    if not start:
        raise RecordingError(f"{path} is empty. Make it again")
    if start != MAGIC:
        way_out = f"To import another format: dmrl convert {path} OUT.mcap"
        if path.suffix == ".mcap":  # by which dmrl convert takes it for MCAP too
            way_out = (
                "If it is of another kind, rename it, such as .csv; then dmrl convert takes it"
            )
        raise RecordingError(f"{path} is not an MCAP file: it begins with {start!r}. {way_out}")
    stream.seek(max(0, stream.size - len(MAGIC)))
    if stream.size < 2 * len(MAGIC) or stream.read() != MAGIC:
        raise RecordingError(
            f"{path} is cut short: its writer may have died. "
            f"Try: dmrl recover {path} recovered.mcap"
        )
    stream.seek(0)
