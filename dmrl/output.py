"""Outputs that appear under their name only when they are whole.

A killed process leaves ``<name>.partial`` behind and never ``<name>``.
"""

import errno
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dmrl.errors import OutputError


def partial_of(path: Path) -> Path:
    """``<name>.partial`` beside ``path``."""
    return path.with_name(path.name + ".partial")


def refuse_existing(path: Path) -> None:
    """Nothing, if ``path`` is free to be written.

    Raises
    ------
    OutputError
        If something is there already, or its folder is not.
    """
    if path.exists() or path.is_symlink():
        raise OutputError(
            f"{path} exists. Outputs are never overwritten; remove it or name another"
        )
    if not path.parent.is_dir():
        raise OutputError(
            f"no folder {path.parent} to write {path.name} in. Try: mkdir -p {path.parent}"
        )


def as_output_error(path: Path, error: OSError) -> OutputError:
    """The one-line error for a write to ``path`` that the system refused."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return OutputError(f"no space left for {path}. Free some, or write to another disk")
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
        If ``path`` exists, or the system refuses a write.
    """
    refuse_existing(path)
    partial = partial_of(path)
    try:
        yield partial
        partial.replace(path)
    except OSError as e:
        if e.filename not in (None, str(partial)):
            raise
        raise as_output_error(path, e) from e
    finally:
        if not keep_on_error:
            partial.unlink(missing_ok=True)


@contextmanager
def partial_folder(path: Path, *, keep_on_error: bool = False) -> Iterator[Path]:
    """Folder to write in; it becomes ``path`` when the block ends without an error.

    Parameters
    ----------
    path
        The final folder.
    keep_on_error
        Leave, and on the next call reuse, the partial folder: for work that can be resumed.

    Raises
    ------
    OutputError
        If ``path`` exists, or the disk is full.
    """
    refuse_existing(path)
    partial = partial_of(path)
    if partial.exists() and not keep_on_error:
        shutil.rmtree(partial)
    try:
        partial.mkdir(exist_ok=True)
        yield partial
        partial.rename(path)
    except BaseException as e:
        if not keep_on_error:
            shutil.rmtree(partial, ignore_errors=True)
        if isinstance(e, OSError) and (
            e.errno in (errno.ENOSPC, errno.EDQUOT) or str(e.filename).startswith(str(partial))
        ):
            raise as_output_error(path, e) from e
        raise
