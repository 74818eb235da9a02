"""Outputs that appear under their name only when they are whole, each written by one process.

A killed process leaves ``<name>.partial`` behind and never ``<name>``. While it lives it holds a
lock on ``<name>.partial``, which the system takes back when it dies: what is locked is being
written, what is not is left over. The final name is linked, never replaced, after everything has
reached the disk.
"""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dmrl.errors import FullDisk, OutputError
from dmrl.guards.durability import empty, sync, sync_one
from dmrl.guards.locks import is_held, refuse_locked, take_file, take_folder
from dmrl.guards.paths import refuse_no_text
from dmrl.storage import Remote, added_files, uploaded_file, uploaded_folder
from dmrl.storage.upload import require_bucket

SUFFIX = ".partial"
MOST_NAME_BYTES = 255 - len(SUFFIX)
"""Of an output's name: file systems take 255, and the unfinished one is called longer."""

_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK)
_begun: list[Path] = []
_ended: list[Path] = []


def partial_of(path: Path) -> Path:
    """``<name>.partial`` beside ``path``."""
    return path.with_name(path.name + SUFFIX)


def note(path: Path) -> None:
    """Note an output that another process makes for this one, for `standing`."""
    _begun.append(path)


def standing() -> list[Path]:
    """Outputs of this process that are whole and stand under their final name."""
    return [path for path in _begun if path.exists()]


def outputs_done() -> int:
    """How many outputs of this process are done with, whole or not; inputs may change then."""
    return len(_ended)


def refuse_existing(path: Path) -> None:
    """Nothing, if ``path`` is free to be written.

    Raises
    ------
    OutputError, UnsafeName
        If something is there already, its folder is not, its name is too long or no text, or
        another process is writing it.
    """
    _refuse_taken(path)
    if not isinstance(path, Remote):
        refuse_locked(partial_of(path))


def _refuse_taken(path: Path) -> None:
    refuse_no_text(path)
    if len(os.fsencode(path.name)) > MOST_NAME_BYTES:
        raise _name_too_long(path)
    try:
        if isinstance(path, Remote):
            require_bucket(path)
        taken = path.exists() or path.is_symlink()
        homeless = not isinstance(path, Remote) and not path.parent.is_dir()
    except OSError as e:
        raise as_output_error(path, e) from e
    if taken:
        raise OutputError(
            f"{path} exists. Outputs are never overwritten; remove it or name another"
        )
    if homeless:
        raise OutputError(
            f"no folder {path.parent} to write {path.name} in. Try: mkdir -p {path.parent}"
        )


def _name_too_long(path: Path) -> OutputError:
    return OutputError(
        f"the name {path.name[:40]}... is too long. Give one of {MOST_NAME_BYTES} bytes at most"
    )


def as_output_error(path: Path, error: OSError) -> OutputError:
    """The one-line error for a write to ``path`` that the system refused."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return FullDisk(f"no space left for {path}. Free some, or write to another disk")
    if error.errno == errno.ENAMETOOLONG:
        return _name_too_long(path)
    return OutputError(f"cannot write {path}: {error.strerror or error}. Choose another place")


@contextmanager
def partial_file(path: Path, *, keep_on_error: bool = False) -> Iterator[Path]:
    """Path to write to; it becomes ``path`` when the block ends without an error.

    Parameters
    ----------
    path
        The final file.
    keep_on_error
        Leave the partial file: for work that can be resumed.

    Raises
    ------
    OutputError
        If ``path`` exists, another process is writing it, or the system refuses a write.
    """
    refuse_existing(path)
    if isinstance(path, Remote):
        with _noted(path), uploaded_file(path) as here:
            yield here
        return
    partial = partial_of(path)
    with _refusals(path, partial):
        held, kept = None, keep_on_error
        try:
            held = take_file(partial)  # in here, as Ctrl-C comes between any two lines
            _begin(path, partial)
            yield partial
            sync(partial)
            _link(partial, path)
        except _CameBetween:
            kept = True
            raise
        finally:
            if held is not None:
                if not kept or is_held(path, held):
                    with suppress(OSError):  # it would hide the error that brought us here
                        partial.unlink(missing_ok=True)
                os.close(held)
                _ended.append(path)


@contextmanager
def rewritten_file(path: Path) -> Iterator[Path]:
    """Path to write to; it takes the place of ``path``, which may be edited by hand meanwhile.

    For the one file that is written again where it stands, a dataset's card.

    Raises
    ------
    OutputError
        If another process is writing it, or the system refuses a write.
    """
    if isinstance(path, Remote):
        with uploaded_file(path) as here:
            yield here
        return
    partial = partial_of(path)
    with _refusals(path, partial):
        held = take_file(partial)
        try:
            yield partial
            sync(partial)
            partial.replace(path)
            sync_one(path.parent)
        finally:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
            os.close(held)


@contextmanager
def partial_folder(
    path: Path, *, keep_on_error: bool = False, resume: bool = False
) -> Iterator[Path]:
    """Folder to write in; it becomes ``path`` when the block ends without an error.

    Parameters
    ----------
    path
        The final folder.
    keep_on_error
        Leave the partial folder: for work that can be resumed.
    resume
        Go on in the partial folder that is there. Else it begins empty.

    Raises
    ------
    OutputError
        If ``path`` exists, another process is writing it, or the system refuses a write.
    """
    refuse_existing(path)
    if isinstance(path, Remote):
        with _noted(path), uploaded_folder(path) as here:
            yield here
        return
    partial = partial_of(path)
    with _refusals(path, partial):
        held, kept = take_folder(partial), keep_on_error
        try:
            _begin(path, partial)
            if not resume:
                empty(partial)
            yield partial
            sync(partial)
            _rename(partial, path)
        except _CameBetween:
            kept = True
            raise
        finally:
            if not kept:
                shutil.rmtree(partial, ignore_errors=True)
            os.close(held)
            _ended.append(path)


@contextmanager
def grown_folder(path: Path, last: str) -> Iterator[Path]:
    """Folder to write in; its files go into ``path``, which is there, when the block ends well.

    They are brought to the disk and moved one by one, so what they are to others must hang on one
    of them: a process that is killed leaves some of the others, and not that one.

    Parameters
    ----------
    path
        A folder.
    last
        Name of the file that is moved after all others.

    Raises
    ------
    OutputError
        If another process is writing it, or the system refuses a write.
    """
    if isinstance(path, Remote):
        with added_files(path, last) as here:
            yield here
        return
    partial = partial_of(path)
    with _refusals(path, partial):
        held = take_folder(partial)
        try:
            empty(partial)
            yield partial
            sync(partial)
            _move(partial, path, last)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
            os.close(held)


def _move(partial: Path, path: Path, last: str) -> None:
    files = [one.relative_to(partial) for one in sorted(partial.rglob("*")) if one.is_file()]
    for file in files:
        if file != Path(last):
            (path / file).parent.mkdir(parents=True, exist_ok=True)
            (partial / file).replace(path / file)
    for folder in {above for file in files for above in (path / file).parents}:
        if folder.is_relative_to(path):
            sync_one(folder)
    if files:
        (partial / last).replace(path / last)
        sync_one(path)


@contextmanager
def _noted(path: Path) -> Iterator[None]:
    """An output in a bucket, which is begun here and done with when the block ends."""
    _begun.append(path)
    try:
        yield
    finally:
        _ended.append(path)


def _begin(path: Path, partial: Path) -> None:
    """Note an output that is now ours, unless another process has just finished it."""
    try:
        _refuse_taken(path)
    except OutputError:
        with suppress(OSError):  # ours is new; a folder is left if anything is in it
            partial.rmdir() if partial.is_dir() else partial.unlink()
        raise
    _begun.append(path)


@contextmanager
def _refusals(path: Path, partial: Path) -> Iterator[None]:
    """What the system says against a write, as one line; errors of other files pass."""
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


class _CameBetween(OutputError):
    """Somebody else has made what we were about to name."""

    def __init__(self, partial: Path, path: Path) -> None:
        super().__init__(
            f"{path} came into being while it was written. What was written is {partial}: rename it"
        )


def _link(partial: Path, path: Path) -> None:
    """Give a whole file its name, which must be free."""
    try:
        os.link(partial, path)
    except FileExistsError:
        raise _CameBetween(partial, path) from None
    except OSError as e:
        if e.errno not in _NO_LINKS:
            raise
        _refuse_taken(path)  # FAT has no links: looked at, then renamed
        partial.rename(path)
    try:
        sync_one(path.parent)
    except BaseException:
        path.unlink()  # not sure to be there after a power loss, so not there at all
        raise


def _rename(partial: Path, path: Path) -> None:
    """Give a whole folder its name; the system refuses if a file or a folder with files has it."""
    try:
        partial.rename(path)
    except OSError as e:
        if e.errno in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR):
            raise _CameBetween(partial, path) from None
        raise
    try:
        sync_one(path.parent)
    except BaseException:
        path.rename(partial)
        raise
