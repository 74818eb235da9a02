"""Write outputs locally and upload them when they are complete.

A file is uploaded by one request, or by a multipart upload that is completed at its end. A folder
contains a mark until its last file is uploaded.
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
    """Raise StorageError unless the bucket of a path exists and can be written."""
    if path.scheme.startswith("http"):
        raise StorageError(f"{path}: web servers are read only. Name a bucket, or a folder here")
    with told(str(path)):
        there = system(path.scheme).exists(path.bucket.key)
    if not there:
        raise StorageError(f"{path}: there is no such bucket. Check the name")


@contextmanager
def uploaded_file(path: Remote) -> Iterator[Path]:
    """Yield a local path to write to, and upload the file if the block ends without an error.

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
    """Yield a local folder to write in; upload it if the block ends without an error.

    Files that a killed process had uploaded are removed first.

    Raises
    ------
    StorageError
        If the server cannot be reached, or refuses. Uploaded files are then removed.
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
    """Yield a local folder, and upload its files into an existing one, ``last`` as the last.

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
