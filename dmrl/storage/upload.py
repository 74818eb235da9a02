"""Outputs made here and uploaded when they are whole.

A file comes by one request, or by a multipart upload that is completed at its end. A folder has a
mark in it until its last file is there.
"""

import hashlib
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from dmrl.errors import StorageError
from dmrl.guards.safe_names import inside
from dmrl.storage.remote import METADATA, UNFINISHED, Remote
from dmrl.storage.system import system, told


def require_bucket(path: Remote) -> None:
    """Nothing, if the bucket of a path is there.

    Raises
    ------
    StorageError
        If not, or if nobody can write there.
    """
    if path.scheme.startswith("http"):
        raise StorageError(f"{path}: web servers are read only. Name a bucket, or a folder here")
    with told(str(path)):
        there = system(path.scheme).exists(path.bucket.key)
    if not there:
        raise StorageError(f"{path}: there is no such bucket. Check the name")


@contextmanager
def uploaded_file(path: Remote) -> Iterator[Path]:
    """A path here to write to; the file is uploaded when the block ends without an error.

    Raises
    ------
    StorageError
        If the server cannot be reached, or refuses.
    """
    with tempfile.TemporaryDirectory(prefix="dmrl-") as folder:
        here = inside(Path(folder), path.name, f"{path}: its name")
        yield here
        _put(here, path)


@contextmanager
def uploaded_folder(path: Remote) -> Iterator[Path]:
    """A folder here to write in; it is uploaded when the block ends without an error.

    What a process that was killed had uploaded is removed first.

    Raises
    ------
    StorageError
        If the server cannot be reached, or refuses; then nothing is left there.
    """
    with tempfile.TemporaryDirectory(prefix="dmrl-") as folder:
        here = inside(Path(folder), path.name, f"{path}: its name")
        here.mkdir()
        yield here
        mark = path / UNFINISHED
        with told(str(path)):
            path.remove_all()
            system(path.scheme).pipe_file(mark.key, b"")
        try:
            for file in sorted(one for one in here.rglob("*") if one.is_file()):
                _put(file, path / file.relative_to(here).as_posix())
        except BaseException:
            with suppress(StorageError, OSError):
                path.remove_all()
            raise
        mark.unlink()


@contextmanager
def added_files(path: Remote, last: str) -> Iterator[Path]:
    """A folder here to write in; its files are uploaded into one that is there, ``last`` last.

    Raises
    ------
    StorageError
        If the server cannot be reached, or refuses.
    """
    with tempfile.TemporaryDirectory(prefix="dmrl-") as folder:
        here = inside(Path(folder), path.name, f"{path}: its name")
        here.mkdir()
        yield here
        files = [one.relative_to(here) for one in here.rglob("*") if one.is_file()]
        for file in sorted(files, key=lambda one: (one == Path(last), one)):
            _put(here / file, path / file.as_posix())


def _put(here: Path, path: Remote) -> None:
    with here.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    more: dict[str, Any] = {"Metadata": {METADATA: digest}} if path.scheme == "s3" else {}
    with told(str(path)):
        system(path.scheme).put_file(str(here), path.key, **more)
