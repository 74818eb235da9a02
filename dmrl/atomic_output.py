"""Write outputs atomically: each appears under its name only when it is complete.

A killed process leaves ``<name>.partial`` behind and never ``<name>``. While it runs it holds a
lock on ``<name>.partial``, which the system releases when it ends. A locked file is being written,
an unlocked one is left over. The final name is linked, never replaced, after all data have
reached the disk.
"""

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from dmrl.errors import FullDisk, OutputError
from dmrl.guards.durability import clear_folder, sync, sync_entry
from dmrl.guards.locks import is_same_file, refuse_locked, take_file, take_folder
from dmrl.guards.paths import require_text_path
from dmrl.storage import RemotePath, upload_file, upload_folder, upload_into_folder
from dmrl.storage.upload import require_bucket

PARTIAL_SUFFIX = ".partial"
NAME_BYTES_MAX = 255 - len(PARTIAL_SUFFIX)
"""Length of an output's name, bytes. File systems allow 255, and ``.partial`` is added to it."""

_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK)
_started_outputs: list[Path] = []
_ended_outputs: list[Path] = []


def to_partial_path(path: Path) -> Path:
    """Return ``<name>.partial`` next to ``path``."""
    return path.with_name(path.name + PARTIAL_SUFFIX)


def register_output(path: Path) -> None:
    """Register an output that another process writes for this one."""
    _started_outputs.append(path)


def has_begun() -> bool:
    """Return whether this process has begun an output."""
    return bool(_started_outputs)


def list_finished_outputs() -> list[Path]:
    """Return the outputs of this process that are complete and have their final name."""
    return [path for path in _started_outputs if path.exists()]


def count_ended_outputs() -> int:
    """Return how many outputs of this process have ended; inputs may change afterwards."""
    return len(_ended_outputs)


def refuse_existing(path: Path) -> None:
    """Raise OutputError if the path exists or cannot be written.

    Raises
    ------
    OutputError, UnsafeName
        If the path exists, its folder does not, its name is too long or not text, or another
        process is writing it.
    """
    _refuse_existing_name(path)
    if not isinstance(path, RemotePath):
        refuse_locked(to_partial_path(path))


def _refuse_existing_name(path: Path) -> None:
    require_text_path(path)
    if len(os.fsencode(path.name)) > NAME_BYTES_MAX:
        raise _name_too_long_error(path)
    try:
        if isinstance(path, RemotePath):
            require_bucket(path)
        exists = path.exists() or path.is_symlink()
        folder_missing = not isinstance(path, RemotePath) and not path.parent.is_dir()
    except OSError as e:
        raise as_output_error(path, e) from e
    if exists:
        raise OutputError(
            f"{path} exists. Outputs are never overwritten; remove it or name another"
        )
    if folder_missing:
        raise OutputError(
            f"no folder {path.parent} to write {path.name} in. Try: mkdir -p {path.parent}"
        )


def _name_too_long_error(path: Path) -> OutputError:
    return OutputError(
        f"the name {path.name[:40]}... is too long. Give one of {NAME_BYTES_MAX} bytes at most"
    )


def as_output_error(path: Path, error: OSError) -> OutputError:
    """Return the one-line error for a write to ``path`` that the system refused."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return FullDisk(f"no space left for {path}. Free some, or write to another disk")
    if error.errno == errno.ENAMETOOLONG:
        return _name_too_long_error(path)
    return OutputError(f"cannot write {path}: {error.strerror or error}. Choose another place")


@contextmanager
def atomic_file(path: Path, *, keep_on_error: bool = False) -> Iterator[Path]:
    """Yield a path to write to; it becomes ``path`` if the block ends without an error.

    Parameters
    ----------
    path
        The final file.
    keep_on_error
        Keep the partial file after an error, for work that can be resumed.

    Raises
    ------
    OutputError
        If ``path`` exists, another process is writing it, or the system refuses a write.
    """
    refuse_existing(path)
    with _write_partial(path, _FILE, fresh=True, keep_on_error=keep_on_error) as partial:
        yield partial


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Yield a path to write to; it replaces ``path`` if the block ends without an error.

    Only for the dataset card, which is rewritten in place and may be edited by hand meanwhile.

    Raises
    ------
    OutputError
        If another process is writing it, or the system refuses a write.
    """
    with _write_partial(path, _REPLACED_FILE) as partial:
        yield partial


@contextmanager
def atomic_folder(
    path: Path, *, keep_on_error: bool = False, resume: bool = False
) -> Iterator[Path]:
    """Yield a folder to write in; it becomes ``path`` if the block ends without an error.

    Parameters
    ----------
    path
        The final folder.
    keep_on_error
        Keep the partial folder after an error, for work that can be resumed.
    resume
        Continue in the existing partial folder. False: start with an empty one.

    Raises
    ------
    OutputError
        If ``path`` exists, another process is writing it, or the system refuses a write.
    """
    refuse_existing(path)
    with _write_partial(path, _FOLDER, fresh=True, keep_on_error=keep_on_error) as partial:
        if not resume and not isinstance(path, RemotePath):
            clear_folder(partial)
        yield partial


@contextmanager
def extend_folder(path: Path, last: str) -> Iterator[Path]:
    """Yield a folder to write in; its files move into the existing ``path`` at the end.

    The files are flushed to the disk and moved one by one. Their validity must depend on the file
    ``last``: a killed process may have moved some of the others, but not that one.

    Parameters
    ----------
    path
        An existing folder.
    last
        Name of the file that is moved after all others.

    Raises
    ------
    OutputError
        If another process is writing it, or the system refuses a write.
    """

    def move(partial: Path, path: Path) -> None:
        _move_files(partial, path, last)

    kind = _Kind(True, move, lambda remote: upload_into_folder(remote, last))
    with _write_partial(path, kind) as partial:
        if not isinstance(path, RemotePath):
            clear_folder(partial)
        yield partial


class _Kind(NamedTuple):
    """Kind of output: file or folder, how it gets its name, and how it is uploaded to a bucket."""

    is_folder: bool
    publish: Callable[[Path, Path], object]
    upload: Callable[[Any], AbstractContextManager[Path]]


@contextmanager
def _write_partial(
    path: Path, kind: _Kind, *, fresh: bool = False, keep_on_error: bool = False
) -> Iterator[Path]:
    """Yield the partial path of an output; publish it if the block ends without an error.

    Parameters
    ----------
    path
        The final path.
    kind
        How to write it.
    fresh
        The name must be free, and the output is registered.
    keep_on_error
        Keep the partial path after an error.
    """
    if isinstance(path, RemotePath):
        _started_outputs.extend([path] * fresh)
        try:
            with kind.upload(path) as local:
                yield local
        finally:
            _ended_outputs.extend([path] * fresh)
        return
    partial, keep, descriptor = to_partial_path(path), keep_on_error, None
    with _translate_errors(path, partial):
        try:
            # Inside try: Ctrl-C can come between any two lines.
            descriptor = take_folder(partial) if kind.is_folder else take_file(partial)
            if fresh:
                _register_output(path, partial)
            yield partial
            sync(partial)
            kind.publish(partial, path)
        except _NameTaken:
            keep = True
            raise
        finally:
            if descriptor is not None:
                if not keep or is_same_file(path, descriptor):
                    shutil.rmtree(partial, ignore_errors=True)  # an error would hide another
                    with suppress(OSError):
                        partial.unlink(missing_ok=True)
                with suppress(OSError):  # what is written was synced; the lock goes in any case
                    os.close(descriptor)
                _ended_outputs.extend([path] * fresh)


def _move_files(partial: Path, path: Path, last: str) -> None:
    files = [one.relative_to(partial) for one in sorted(partial.rglob("*")) if one.is_file()]
    for file in files:
        if file != Path(last):
            (path / file).parent.mkdir(parents=True, exist_ok=True)
            (partial / file).replace(path / file)
    for folder in {above for file in files for above in (path / file).parents}:
        if folder.is_relative_to(path):
            sync_entry(folder)
    if files:
        (partial / last).replace(path / last)
        sync_entry(path)


def _register_output(path: Path, partial: Path) -> None:
    """Register an output, unless another process has just finished one of that name."""
    try:
        _refuse_existing_name(path)
    except OutputError:
        with suppress(OSError):  # the new file; a folder only if it is empty
            partial.rmdir() if partial.is_dir() else partial.unlink()
        raise
    _started_outputs.append(path)


@contextmanager
def _translate_errors(path: Path, partial: Path) -> Iterator[None]:
    """Turn system errors of this output into one line; pass on those of other files."""
    try:
        yield
    except OSError as e:
        named = str(e.filename or partial)
        mine = named == str(path) or Path(named).is_relative_to(partial)
        if not mine or isinstance(e, ConnectionError | BrokenPipeError | TimeoutError):
            raise
        if e.errno in (None, errno.ENOENT) and not partial.exists():
            raise OutputError(f"{partial} was removed while it was written. Run it again") from e
        raise as_output_error(path, e) from e


class _NameTaken(OutputError):
    """The output's name was taken while it was written."""

    def __init__(self, partial: Path, path: Path) -> None:
        super().__init__(
            f"{path} was created by another program meanwhile. The output is {partial}: rename it"
        )


def _publish_file(partial: Path, path: Path) -> None:
    """Give a complete file its name, which must be free."""
    try:
        os.link(partial, path)
    except FileExistsError:
        raise _NameTaken(partial, path) from None
    except OSError as e:
        if e.errno not in _NO_LINKS:
            raise
        _refuse_existing_name(path)  # FAT has no links: check, then rename
        partial.rename(path)
    try:
        sync_entry(path.parent)
    except BaseException:
        path.unlink()  # it might be lost in a power loss, so remove it
        raise


def _replace(partial: Path, path: Path) -> None:
    """Give a complete file its name, in place of the file that has it."""
    partial.replace(path)
    sync_entry(path.parent)


def _publish_folder(partial: Path, path: Path) -> None:
    """Give a complete folder its name; the system refuses if that is taken."""
    try:
        partial.rename(path)
    except OSError as e:
        if e.errno in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR):
            raise _NameTaken(partial, path) from None
        raise
    try:
        sync_entry(path.parent)
    except BaseException:
        path.rename(partial)
        raise


_FILE = _Kind(False, _publish_file, upload_file)
_REPLACED_FILE = _Kind(False, _replace, upload_file)
_FOLDER = _Kind(True, _publish_folder, upload_folder)
